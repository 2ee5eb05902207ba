//! Tests the live page of a real run with clients that are not ours: Python's, and Chromium.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

#[path = "../../../tests/json/schema.rs"]
mod schema;

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStderr, Command, Output, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

const WEB: &str = env!("CARGO_BIN_EXE_tandem-web");
/// No run of these tests takes longer than this, even on a busy machine.
const WATCHDOG: Duration = Duration::from_secs(120);

/// Returns a folder with the programs, without sources, so that no cargo builds them.
fn programs() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let built = Path::new(WEB).with_file_name("tandem");
    assert!(
        built.exists(),
        "build the workspace: {} is missing",
        built.display()
    );
    for (from, name) in [(built.as_path(), "tandem"), (Path::new(WEB), "tandem-web")] {
        fs::copy(from, folder.path().join(name)).unwrap();
    }
    folder
}

/// A run with a page, from programs without sources, which no cargo builds. Dropping it ends both.
struct Run {
    process: Child,
    url: String,
    /// Kept open, so that the run may write.
    said: BufReader<ChildStderr>,
    folder: TempDir,
}

impl Run {
    fn start() -> Self {
        Self::of("--duration 110 --scenario free-lane", programs())
    }

    /// Starts a run with these arguments, by the programs in this folder.
    fn of(words: &str, folder: TempDir) -> Self {
        let mut process = Command::new(folder.path().join("tandem"))
            .args(["run", "--web", "--quiet"])
            .args(words.split(' '))
            .current_dir(folder.path())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut said = BufReader::new(process.stderr.take().unwrap());
        let mut line = String::new();
        said.read_line(&mut line).unwrap();
        let url = line.trim().strip_prefix("live page: ").map(str::to_owned);
        Self {
            process,
            url: url.unwrap_or_else(|| panic!("no address: {line}")),
            said,
            folder,
        }
    }

    fn port(&self) -> u16 {
        let (_, rest) = self.url.split_once("127.0.0.1:").unwrap();
        rest.split('/').next().unwrap().parse().unwrap()
    }

    /// Runs a client in Python with the address of the page.
    fn client(&self, script: &str, args: &[&Path]) {
        let script = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("tests")
            .join(script);
        let mut client = Command::new("python3");
        client.arg(script).arg(&self.url).args(args);
        let output = until_ended(client);
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{said}");
    }

    /// Ends the run by Ctrl-C. Checks that its page has ended with it. Returns what the run has
    /// said.
    fn interrupt(mut self) -> String {
        kill_process(Pid::from_child(&self.process), Signal::INT).unwrap();
        let mut said = String::new();
        self.said.read_to_string(&mut said).unwrap();
        let status = self.process.wait().unwrap();
        assert_eq!(status.code(), Some(130));
        assert!(TcpStream::connect((Ipv4Addr::LOCALHOST, self.port())).is_err());
        assert!(
            self.folder
                .path()
                .join("tandem-report/report.html")
                .exists()
        );
        said
    }

    /// Returns the process of the page.
    fn page(&self) -> Pid {
        let tasks = fs::read_dir(format!("/proc/{}/task", self.process.id())).unwrap();
        let children = tasks.map(|task| fs::read_to_string(task.unwrap().path().join("children")));
        let children: Vec<_> = children.map(Result::unwrap_or_default).collect();
        let is_page = |pid: &&str| {
            let line = fs::read_to_string(format!("/proc/{pid}/cmdline")).unwrap_or_default();
            line.contains("tandem-web")
        };
        let mut pids = children.iter().flat_map(|it| it.split_whitespace());
        let pid = pids.find(is_page).unwrap();
        Pid::from_raw(pid.parse().unwrap()).unwrap()
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        let _ = kill_process(Pid::from_child(&self.process), Signal::INT);
        let _ = self.process.wait();
    }
}

/// Runs a client to its end, or fails after [`WATCHDOG`].
fn until_ended(mut client: Command) -> Output {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("stderr");
    let mut child = client
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(File::create(&path).unwrap())
        .spawn()
        .unwrap();
    let begin = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        if begin.elapsed() > WATCHDOG {
            child.kill().unwrap();
        }
        std::thread::sleep(Duration::from_millis(20));
    };
    let stderr = fs::read(&path).unwrap();
    Output {
        status,
        stdout: Vec::new(),
        stderr,
    }
}

/// Returns true if these programs can be started. If not, the test is skipped; if the environment
/// variable `required` is 1, it fails.
fn has(programs: &[&str], required: &str) -> bool {
    let starts = |program: &&&str| {
        let output = Command::new(program).arg("--version").output();
        output.is_ok_and(|output| output.status.success())
    };
    let missing: Vec<_> = programs.iter().filter(|it| !starts(it)).collect();
    let is_required = std::env::var_os(required).is_some_and(|value| value == "1");
    assert!(
        missing.is_empty() || !is_required,
        "{missing:?} cannot be started"
    );
    if !missing.is_empty() {
        eprintln!("skipped: {missing:?} cannot be started");
    }
    missing.is_empty()
}

/// Requests without the token, of other sites and under other names are refused. With the token the
/// supply of the master is killed, and the stream shows the takeover.
#[test]
fn a_client_in_python_kills_the_master_and_sees_the_takeover() {
    if !has(&["python3"], "TANDEM_REQUIRE_ORACLES") {
        return;
    }
    let run = Run::start();
    run.client("client.py", &[]);
    run.interrupt();
}

/// A second page may be opened beside a run. With `--json` it says where, in a document of its
/// schema.
#[test]
fn the_address_of_a_page_beside_a_run_fits_its_schema() {
    let run = Run::start();
    let begin = Instant::now();
    let document = loop {
        assert!(begin.elapsed() < WATCHDOG, "no page");
        let mut page = Command::new(WEB)
            .args(["web", "--json", "--run", &run.process.id().to_string()])
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut line = String::new();
        let said = BufReader::new(page.stdout.take().unwrap()).read_line(&mut line);
        page.kill().unwrap();
        page.wait().unwrap();
        said.unwrap();
        // Until the run publishes, the program ends without a word.
        if !line.is_empty() {
            break line;
        }
        std::thread::sleep(Duration::from_millis(100));
    };
    schema::fits("web", document.as_bytes());
    run.interrupt();
}

/// A click on the page kills the master's supply, and the page shows the takeover.
/// `TANDEM_SCREENSHOT=FILE` keeps a picture of the page.
#[test]
fn a_click_in_chromium_kills_the_master_and_the_page_shows_the_takeover() {
    if !has(
        &["python3", "chromium", "chromedriver"],
        "TANDEM_REQUIRE_CHROMIUM",
    ) {
        return;
    }
    let run = Run::start();
    let kept = std::env::var_os("TANDEM_SCREENSHOT").map(PathBuf::from);
    let picture = kept.unwrap_or_else(|| run.folder.path().join("page.png"));
    run.client("browser.py", &[&picture]);
    assert!(fs::metadata(&picture).unwrap().len() > 10_000);
    run.interrupt();
}

/// Slow readers, floods of connections, guesses of the token and huge requests cost other readers
/// nothing, and the run neither: it drives on, also when its page is killed.
#[test]
fn an_attacker_disturbs_no_run() {
    if !has(&["python3"], "TANDEM_REQUIRE_ORACLES") {
        return;
    }
    let run = Run::start();
    run.client("attack.py", &[]);
    kill_process(run.page(), Signal::KILL).unwrap();
    let pid = run.process.id().to_string();
    let listed = || {
        let mut ps = Command::new(run.folder.path().join("tandem"));
        let output = ps.args(["ps", "--json"]).output().unwrap();
        String::from_utf8(output.stdout).unwrap()
    };
    while TcpStream::connect((Ipv4Addr::LOCALHOST, run.port())).is_ok() {
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(listed().contains("vehicle"), "{pid}: {}", listed());
    let said = run.interrupt();
    assert!(
        said.contains("the live page ended with signal: 9"),
        "{said}"
    );
}

/// The page shows a run in emulated machines too. Its hands say that they cannot reach it.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn a_run_in_emulated_machines_is_shown() {
    let folder = programs();
    let lab = Path::new(WEB).with_file_name("tandem-lab");
    fs::copy(&lab, folder.path().join("tandem-lab")).unwrap();
    let images = Path::new(WEB).parent().unwrap().with_file_name("firmware");
    let images = images.join("riscv32imac-unknown-none-elf/release");
    let images = std::env::var_os("TANDEM_IMAGES").map_or(images, PathBuf::from);
    let image = images.join("controller");
    let words = format!("--board qemu --duration 5 --firmware {}", image.display());
    let run = Run::of(&words, folder);
    let host = format!("127.0.0.1:{}", run.port());
    let ask = |request: String| {
        let mut server = TcpStream::connect((Ipv4Addr::LOCALHOST, run.port())).unwrap();
        server.write_all(request.as_bytes()).unwrap();
        let mut answer = String::new();
        server.read_to_string(&mut answer).unwrap();
        answer
    };
    let common = format!("Host: {host}\r\nConnection: close\r\n");
    while !ask(format!("GET /state HTTP/1.1\r\n{common}\r\n")).contains("\"obeyed\":\"") {
        std::thread::sleep(Duration::from_millis(20));
    }
    let (_, token) = run.url.split_once('#').unwrap();
    let body = r#"{"hand": "kill-supply", "system": "master"}"#;
    let answer = ask(format!(
        "POST /hands HTTP/1.1\r\n{common}Authorization: Bearer {token}\r\n\
         Content-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
        body.len()
    ));
    assert!(answer.contains(" 409 "), "{answer}");
    assert!(answer.contains("no processes on this machine"), "{answer}");
}

/// Bad input is refused with exit status 2, and no server is left.
#[test]
fn a_run_that_is_missing_and_a_port_that_is_in_use() {
    let output = |args: &[&str]| {
        let mut command = Command::new(WEB);
        command.arg("web").args(args);
        let output = until_ended(command);
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{said}");
        said
    };
    let said = output(&["--run", "no-such-run"]);
    assert!(said.contains("no run no-such-run is active"), "{said}");
    let taken = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    let programs = programs();
    let mut run = Command::new(programs.path().join("tandem"));
    run.args(["run", "--web", &port])
        .current_dir(programs.path());
    let output_of_run = until_ended(run);
    let said = String::from_utf8(output_of_run.stderr).unwrap();
    assert_eq!(output_of_run.status.code(), Some(2), "{said}");
    assert!(said.contains(&format!("--port {port}")), "{said}");
    assert!(!programs.path().join("tandem-report").exists());
    assert!(output(&["--port", "70000"]).contains("--port"));
}
