//! `tandem bench` as a person uses it: cut short, compared, and given impossible requests.
#![allow(clippy::unwrap_used, reason = "a test")]

#[path = "../../tests/json/schema.rs"]
mod schema;

use std::fs::{self, File};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::thread::sleep;
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tandem_page::command_line::EXIT_STATUS;
use tempfile::TempDir;

const PROGRAM: &str = env!("CARGO_BIN_EXE_tandem-bench");

/// A separate folder, and exclusive use of the machine's CPUs: two measurements at a time would
/// disturb each other.
struct Fixture {
    folder: TempDir,
    _turn: File,
}

impl Fixture {
    fn new() -> Self {
        let turn = File::create(Path::new(env!("CARGO_TARGET_TMPDIR")).join("turn.lock")).unwrap();
        turn.lock().unwrap();
        Self {
            folder: tempfile::tempdir().unwrap(),
            _turn: turn,
        }
    }

    fn folder(&self) -> &Path {
        self.folder.path()
    }

    fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::new(PROGRAM);
        command.args(args).current_dir(self.folder());
        command
    }

    fn output(&self, args: &[&str]) -> Output {
        self.command(args).output().unwrap()
    }

    fn names(&self) -> Vec<String> {
        let entries = fs::read_dir(self.folder()).unwrap();
        let name = |entry: fs::DirEntry| entry.file_name().into_string().unwrap();
        let mut names: Vec<String> = entries.map(|entry| name(entry.unwrap())).collect();
        names.sort();
        names
    }
}

/// Sends Ctrl-C (SIGINT) to the command only, not to the processes that it has started.
fn interrupt(child: &Child) {
    let pid = Pid::from_raw(i32::try_from(child.id()).unwrap()).unwrap();
    kill_process(pid, Signal::INT).unwrap();
}

/// A measurement that is cut short returns the figures so far, marks every output as cut short, and
/// can be compared.
#[test]
fn a_measurement_that_is_cut_short_gives_what_there_is() {
    let fixture = Fixture::new();
    let outputs = ["--json", "a.json", "--html", "a.html", "--hgrm", "h"];
    let mut command = fixture.command(&[&["lock"][..], &outputs].concat());
    let child = command
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // Enough time for some cases, even on a busy machine.
    sleep(Duration::from_secs(6));
    assert_eq!(
        fixture.names(),
        Vec::<String>::new(),
        "files before figures"
    );
    interrupt(&child);
    let output = child.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(130), "{said}");
    let table = String::from_utf8(output.stdout).unwrap();
    assert!(
        table.contains("free") && table.contains("interrupted"),
        "{table}"
    );
    let read = |name: &str| fs::read_to_string(fixture.folder().join(name)).unwrap();
    let results: Value = serde_json::from_str(&read("a.json")).unwrap();
    assert_eq!(results["interrupted"], true);
    assert!(read("a.html").contains("Interrupted"));
    let curve = read("h/lock-free.hgrm");
    assert!(curve.contains("1/(1-Percentile)") && curve.contains("Interrupted"));
}

/// A program compared with itself: both measure in turn. Two pairs are too few to show a change.
#[test]
fn a_program_compared_with_itself_has_not_changed() {
    let fixture = Fixture::new();
    let options = ["--pairs", "2", "--seconds", "1", "lock", "--json"];
    let output = fixture.output(&[&["compare", "--against", PROGRAM][..], &options].concat());
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{said}");
    schema::fits("bench-compare", &output.stdout);
    let comparison: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(comparison["pairs"], 2);
    let cases = comparison["cases"].as_array().unwrap();
    let free = cases
        .iter()
        .find(|case| case["name"] == "lock/free")
        .unwrap();
    assert!(free["p50"]["old_ns"].as_f64().unwrap() > 0.0);
    assert!(fixture.names().is_empty());
}

/// Without a file, the figures are all that stdout has. Their schema describes each of them.
#[test]
fn the_figures_go_to_stdout_and_fit_their_schema() {
    let fixture = Fixture::new();
    let output = fixture.output(&["--seconds", "1", "lock", "one-cpu", "--json"]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{said}");
    schema::fits("bench", &output.stdout);
    assert!(fixture.names().is_empty());
}

/// Each help text has the exit statuses.
#[test]
fn each_help_has_the_exit_statuses() {
    for words in [&["bench"][..], &["compare"], &["overruns"]] {
        let output = Fixture::new().output(&[words, &["--help"]].concat());
        let help = String::from_utf8(output.stdout).unwrap();
        assert!(help.contains(EXIT_STATUS), "{words:?}: {help}");
    }
}

/// Under SCHED_FIFO an end that spins keeps all others from its CPU. The measurement still ends
/// beside a load without that priority, and names the load.
#[test]
fn a_measurement_under_sched_fifo_ends() {
    let fixture = Fixture::new();
    let options = ["--realtime", "--load", "spin:2", "--seconds", "1"];
    let output = fixture.output(&[&options[..], &["--json", "a.json", "one-cpu", "lock"]].concat());
    let said = String::from_utf8_lossy(&output.stderr);
    if said.contains("SCHED_FIFO was refused") {
        return;
    }
    assert_eq!(output.status.code(), Some(0), "{said}");
    let table = String::from_utf8(output.stdout).unwrap();
    assert!(table.contains("background load: spin:2"), "{table}");
    let text = fs::read_to_string(fixture.folder().join("a.json")).unwrap();
    let results: Value = serde_json::from_str(&text).unwrap();
    assert_eq!(results["load"], "spin:2");
    assert_eq!(results["skipped"], Value::Array(Vec::new()));
}

/// E-1: an overrun is explained by a stall of the machine, or the command fails.
#[test]
fn overruns_are_explained_or_the_command_fails() {
    let output = Fixture::new().output(&["overruns", "--seconds", "2"]);
    let said = String::from_utf8_lossy(&output.stderr);
    let line = String::from_utf8(output.stdout).unwrap();
    let numbers: Vec<u32> = line.split(' ').filter_map(|it| it.parse().ok()).collect();
    let [activations, overruns, _, bare] = numbers[..] else {
        panic!("{line} {said}");
    };
    assert!(activations > 0 && bare <= overruns, "{line}");
    assert_eq!(output.status.code(), Some(i32::from(bare > 0)), "{said}");
}

/// An error is reported at once, with exit status 2, and leaves no files behind.
#[test]
fn a_benchmark_that_cannot_be_is_refused_at_once() {
    let fixture = Fixture::new();
    fs::write(fixture.folder().join("other.json"), "{}").unwrap();
    let before = fixture.names();
    for (args, word) in [
        (&["spni"][..], "possible values: spin"),
        (&["--json", "no/such/a.json"], "create it first"),
        (&["--json=."], "it is a folder"),
        (&["--html", "."], "name a file"),
        (&["--hgrm", "other.json"], "name a folder"),
        (&["--json=a", "--html", "./a"], "the same file"),
        (&["--load", "walk:2"], "spin and memory"),
        (&["--load", "spin:0"], "from 1 to 64"),
        (&["--cpus", "0,70000"], "name two of the CPUs"),
        (&["--cpus", "0,0"], "name two of the CPUs"),
        (&["--cpus", "0"], "name two of the CPUs"),
        (
            &["bench", "compare", "--against", "./none"],
            "cannot run ./none",
        ),
        (
            &["bench", "compare", "--against", "/bin/true", "lock"],
            "no `tandem` that can be compared",
        ),
        (&["bench", "compare", "--against", "/bin/false"], "failed"),
        (&["compare", "spin"], "--against"),
        (
            &["--quick", "compare", "--against", "."],
            "unexpected argument",
        ),
    ] {
        let output = fixture.output(args);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{args:?}: {said}");
        assert!(
            said.contains(word),
            "{args:?} does not say {word:?}: {said}"
        );
        assert_eq!(fixture.names(), before, "{args:?} has left something");
    }
}
