//! One cell: a process in a network of its own, with further networks and links to them.

use std::cell::RefCell;
use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// Set in the process that runs a cell.
const INSIDE: &str = "TANDEM_PTP_INSIDE";
/// If it is 1, no cell may be skipped because linuxptp or tshark is not installed.
const REQUIRE: &str = "TANDEM_REQUIRE_LINUXPTP";
/// Time of measuring, s.
const SECONDS: &str = "TANDEM_PTP_SECONDS";
const WATCHDOG: Duration = Duration::from_secs(300);

/// A program that a cell needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Tool {
    /// Debian's package `linuxptp`.
    Ptp4l,
    /// Debian's package `tshark`.
    Tshark,
    /// `cargo install statime-linux --version 0.4.0 --locked`.
    Statime,
}

impl Tool {
    /// Returns the program; `TANDEM_STATIME` may name that of statime.
    pub(crate) fn program(self) -> PathBuf {
        match self {
            Self::Ptp4l => "ptp4l".into(),
            Self::Tshark => "tshark".into(),
            Self::Statime => {
                std::env::var_os("TANDEM_STATIME").map_or_else(|| "statime".into(), PathBuf::from)
            }
        }
    }

    fn is_missing(self) -> bool {
        let version = if self == Self::Statime {
            "--version"
        } else {
            "-v"
        };
        !works(Command::new(self.program()).arg(version))
    }
}

fn works(command: &mut Command) -> bool {
    command.output().is_ok_and(|output| output.status.success())
}

/// Runs a cell. Its test has this name.
pub(crate) fn cell(name: &str, tools: &[Tool], body: fn(&Bench)) {
    if std::env::var_os(INSIDE).is_some() {
        std::thread::spawn(|| {
            std::thread::sleep(WATCHDOG);
            println!("the watchdog ends it after {WATCHDOG:?}");
            std::process::exit(1);
        });
        body(&Bench::new());
        return;
    }
    let missing: Vec<_> = tools.iter().filter(|tool| tool.is_missing()).collect();
    let is_required = std::env::var_os(REQUIRE).is_some_and(|one| one == "1");
    let is_optional = missing == [&Tool::Statime];
    assert!(
        missing.is_empty() || is_optional || !is_required,
        "{name}: {REQUIRE} is 1: {missing:?}"
    );
    let namespaces = ["-rnpf", "--kill-child"];
    let has_networks = works(Command::new("unshare").args(namespaces).arg("true"));
    if !missing.is_empty() || !has_networks || !works(Command::new("ip").arg("-V")) {
        println!("SKIPPED: {name}: {missing:?} missing, networks: {has_networks}");
        return;
    }
    // When the first process of a namespace ends, the kernel ends all others in it.
    let output = Command::new("unshare")
        .args(namespaces)
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", name, "--nocapture"])
        .env(INSIDE, "1")
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    print!("{said}{}", String::from_utf8_lossy(&output.stderr));
    let has_passed = output.status.success() && said.contains("1 passed");
    assert!(has_passed, "{name}: {}", output.status);
}

/// What a program has written.
pub(crate) struct Log(PathBuf);

impl Log {
    pub(crate) fn read(&self) -> String {
        String::from_utf8_lossy(&std::fs::read(&self.0).unwrap()).into_owned()
    }
}

/// Networks 0, 1 and 2: that of this process and two more, each with a shell in it.
pub(crate) struct Bench {
    pub(crate) folder: tempfile::TempDir,
    /// How long the cell measures.
    pub(crate) seconds: u64,
    shells: [Child; 2],
    /// Numbers the files.
    files: RefCell<u32>,
}

impl Bench {
    fn new() -> Self {
        let seconds = std::env::var(SECONDS)
            .ok()
            .map_or(12, |it| it.parse().unwrap());
        let shell = || {
            let mut command = Command::new("unshare");
            command.args(["-n", "sh"]).stdin(Stdio::piped());
            command.spawn().unwrap()
        };
        let bench = Self {
            folder: tempfile::tempdir().unwrap(),
            seconds,
            shells: [shell(), shell()],
            files: RefCell::new(0),
        };
        // Their networks exist when they run something.
        bench.run(1, "true");
        bench.run(2, "true");
        bench
    }

    /// Returns the path of a new file.
    pub(crate) fn file(&self, name: &str) -> PathBuf {
        *self.files.borrow_mut() += 1;
        self.folder
            .path()
            .join(format!("{}-{name}", self.files.borrow()))
    }

    /// Runs a line of the shell in a network, to its end.
    pub(crate) fn run(&self, network: usize, line: &str) {
        let done = self.file("done");
        let path = done.display();
        self.start(
            network,
            &format!("{line}; echo $? > {path}.part; mv {path}.part {path}"),
            false,
        );
        while !done.exists() {
            std::thread::sleep(Duration::from_millis(5));
        }
        let status = std::fs::read_to_string(done).unwrap();
        assert_eq!(status.trim(), "0", "{line}");
    }

    fn start(&self, network: usize, line: &str, is_beside: bool) {
        let line = if is_beside {
            format!("{line} &\n")
        } else {
            format!("{line}\n")
        };
        match network.checked_sub(1) {
            None => {
                Command::new("sh")
                    .args(["-c", &line])
                    .spawn()
                    .unwrap()
                    .wait()
                    .unwrap();
            }
            Some(shell) => {
                let mut stdin = self.shells[shell].stdin.as_ref().unwrap();
                stdin.write_all(line.as_bytes()).unwrap();
            }
        }
    }

    /// Starts a program in a network; it ends with the cell.
    pub(crate) fn spawn(&self, network: usize, program: &Path, arguments: &[&str]) -> Log {
        let log = self.file("log");
        File::create(&log).unwrap();
        let line = format!(
            "{} {} < /dev/null > {} 2>&1",
            program.display(),
            arguments.join(" "),
            log.display()
        );
        self.start(network, &line, true);
        Log(log)
    }

    /// Links two networks by a pair of interfaces, which have the number of the network in their
    /// names. Returns their addresses; a manufacturer may give such: statime refuses others.
    pub(crate) fn link(&self, name: &str, left: usize, right: usize) -> [String; 2] {
        let pid = self.shells[right - 1].id();
        let tag = *self.files.borrow() % 100;
        let macs = [0, 1].map(|side| format!("00:1b:19:00:{side:02}:{tag:02}"));
        let [here, there] = &macs;
        self.run(
            left,
            &format!(
                "ip link add {name}{left} address {here} type veth peer name {name}{right} \
                 address {there} netns {pid} && ip link set {name}{left} up"
            ),
        );
        self.run(right, &format!("ip link set {name}{right} up"));
        macs
    }

    /// Waits until the programs have measured, and those with a time of their own have ended.
    pub(crate) fn wait(&self) {
        std::thread::sleep(Duration::from_secs(self.seconds + 3));
    }

    /// Prints a measured figure.
    #[allow(clippy::unused_self, reason = "a figure is one of a cell")]
    pub(crate) fn figure(&self, text: &str) {
        println!("\nFIGURE: {text}");
    }
}
