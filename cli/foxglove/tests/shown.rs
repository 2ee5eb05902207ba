//! Runs that are shown in Foxglove, read by the reader of PyPI's `mcap` and a WebSocket client in
//! Python. Skipped without them; with `TANDEM_REQUIRE_FOXGLOVE=1` they are required.
#![allow(
    clippy::unwrap_used,
    reason = "a test ends where something is not as it must be"
)]

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use serde_json::Value;
use tempfile::TempDir;

const ORACLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/oracle.py");
const LAYOUT: &str = include_str!("../layout.json");

/// The programs in a folder of their own, where `tandem` does not ask cargo to build the other.
struct Programs(TempDir);

impl Programs {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let built = Path::new(env!("CARGO_BIN_EXE_tandem-foxglove"));
        for name in ["tandem", "tandem-foxglove"] {
            let from = built.with_file_name(name);
            fs::copy(&from, folder.path().join(name))
                .unwrap_or_else(|error| panic!("{}: {error}", from.display()));
        }
        Self(folder)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn tandem(&self, words: &[&str]) -> Command {
        let mut command = Command::new(self.path("tandem"));
        command.args(words).current_dir(self.0.path());
        command.stdin(Stdio::null());
        command
    }
}

/// Ends its run if the test panics.
struct Run(Child);

impl Drop for Run {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn oracle(words: &[&str]) -> Option<Command> {
    let folder = std::env::var("TANDEM_FOXGLOVE").unwrap_or_default();
    let python = |words: &[&str]| {
        let mut command = Command::new("python3");
        command.args(words).env("PYTHONPATH", &folder);
        command
    };
    let imports = "import mcap, mcap_protobuf, websockets";
    let found = python(&["-c", imports]).output();
    if !found.is_ok_and(|output| output.status.success()) {
        let required = std::env::var_os("TANDEM_REQUIRE_FOXGLOVE").is_some_and(|it| it == "1");
        assert!(!required, "the oracles of Foxglove are missing");
        eprintln!("skipped: mcap, mcap-protobuf-support and websockets of PyPI are not installed");
        return None;
    }
    Some(python(&[&[ORACLE], words].concat()))
}

/// Returns what the oracle prints.
fn said_by(mut command: Command) -> Value {
    let output = command.output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Returns the topics that the layout shows.
fn topics_of_layout() -> Vec<String> {
    let layout: Value = serde_json::from_str(LAYOUT).unwrap();
    let mut topics = Vec::new();
    for panel in layout["configById"].as_object().unwrap().values() {
        let shown = panel["topics"].as_object().into_iter().flatten();
        topics.extend(shown.map(|(topic, _)| topic.clone()));
        let paths = panel["paths"].as_array().into_iter().flatten();
        let values = paths.map(|path| path["value"].as_str().unwrap());
        topics.extend(values.map(|it| it.split('.').next().unwrap().to_owned()));
        let one = [&panel["topicToRender"], &panel["topicPath"]];
        topics.extend(one.iter().filter_map(|it| it.as_str()).map(str::to_owned));
    }
    topics
}

/// A run with a takeover: a live client hears it while it drives, and the file has all of it. The
/// takeover in the file is the one in the report.
#[test]
fn a_run_with_a_takeover_is_shown_and_recorded() {
    let programs = Programs::new();
    let file = programs.path("run.mcap");
    let Some(read) = oracle(&["file", file.to_str().unwrap()]) else {
        return;
    };
    let words = "run --json --duration 12 --scenario free-lane --foxglove 0 --mcap run.mcap";
    let mut command = programs.tandem(&words.split(' ').collect::<Vec<_>>());
    let spawned = command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut run = Run(spawned.spawn().unwrap());
    let mut lines = BufReader::new(run.0.stderr.take().unwrap()).lines();
    let port = lines.find_map(|line| Some(line.unwrap().rsplit_once("localhost:")?.1.to_owned()));
    let port = port.expect("an address");
    // Otherwise the run blocks when the pipe is full.
    let rest = std::thread::spawn(move || lines.map_while(Result::ok).collect::<Vec<_>>());
    let live = said_by(oracle(&["live", &port]).unwrap());
    assert_eq!(live["channels"]["/tracks"], "foxglove.SceneUpdate");
    assert!(
        live["heard"]["/trajectory"].as_u64() > Some(100),
        "{live:#}"
    );
    assert!(live["heard"]["/roles"]["term"].is_u64(), "{live:#}");
    let pid = run.0.id().to_string();
    // The standby stands by within a second.
    std::thread::sleep(std::time::Duration::from_secs(2));
    let off = programs.tandem(&["power", "off", "A", "--run", &pid]);
    let off = { off }.output().unwrap();
    assert!(off.status.success(), "{off:?}");
    let metrics: Value = serde_json::from_reader(run.0.stdout.take().unwrap()).unwrap();
    run.0.wait().unwrap();
    let said = rest.join().unwrap();

    let found = said_by(read);
    let count = |topic: &str| found["channels"][topic][3].as_u64().unwrap_or(0);
    let lost = found["metadata"]["tandem"]["lost_samples"].as_str();
    assert!(lost.is_some(), "{found:#}");
    for (topic, schema) in [
        ("/tf", "foxglove.FrameTransform"),
        ("/vehicle/pose", "foxglove.PoseInFrame"),
        ("/vehicle/body", "foxglove.SceneUpdate"),
        ("/tracks", "foxglove.SceneUpdate"),
        ("/lanes", "foxglove.SceneUpdate"),
        ("/trajectory", "foxglove.SceneUpdate"),
        ("/log", "foxglove.Log"),
        ("/events", "foxglove.Event"),
        ("/vehicle", "tandem.Vehicle"),
        ("/scene", "tandem.Scene"),
        ("/roles", "tandem.Roles"),
        ("/gaps", "tandem.Gap"),
    ] {
        assert_eq!(found["channels"][topic][1], schema, "{topic}");
        assert!(count(topic) > 0, "{topic}: {:#}", found["channels"]);
    }
    for topic in topics_of_layout() {
        assert!(
            !found["channels"][&topic].is_null(),
            "the layout shows {topic}"
        );
    }
    assert_eq!(
        found["points"],
        serde_json::json!([41]),
        "samples of a trajectory"
    );
    let driven = found["driven_m"].as_f64().unwrap();
    let log = found["logs"].as_array().unwrap();
    let has = |words: &str| log.iter().any(|it| it.as_str().unwrap().contains(words));
    assert!(has("B core 0: takes over"), "{log:#?} {said:?}");
    if lost != Some("0") {
        eprintln!("the machine held the observer up: {lost:?} samples lost");
        return;
    }
    assert_eq!(count("/vehicle/pose"), count("/vehicle"));
    let of_report = metrics["distance_m"].as_f64();
    if let Some(of_report) = of_report {
        assert!((driven - of_report).abs() < 2.0, "{driven} {of_report}");
    }
    let gap = found["gap_max_ms"].as_f64().unwrap();
    let of_report = metrics["control_gap_max_ms"].as_f64().unwrap();
    assert!((gap - of_report).abs() < 0.01, "{gap} {of_report}");
    let takeovers = found["events"].as_array().unwrap().iter();
    let takeovers: Vec<_> = takeovers.filter(|it| it["event"] == "takeover").collect();
    let of_report = metrics["takeovers"].as_array().unwrap();
    assert_eq!(
        takeovers.len(),
        of_report.len(),
        "{takeovers:#?} {of_report:#?}"
    );
}

/// Returns the process id of the program that shows this run.
fn shown_by(run: &Run) -> Option<String> {
    let tasks = fs::read_dir(format!("/proc/{}/task", run.0.id())).unwrap();
    let children = tasks.map(|task| fs::read_to_string(task.unwrap().path().join("children")));
    let children: Vec<_> = children.map(Result::unwrap_or_default).collect();
    let of = |pid: &&str| {
        let line = fs::read_to_string(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        line.contains("tandem-foxglove")
    };
    let mut pids = children.iter().flat_map(|it| it.split_whitespace());
    pids.find(of).map(str::to_owned)
}

/// The run drives to its end if the program that shows it is killed, and says so.
#[test]
fn a_killed_program_disturbs_no_run() {
    let programs = Programs::new();
    let words = "run --json --duration 3 --scenario free-lane --mcap run.mcap --foxglove 0";
    let mut command = programs.tandem(&words.split(' ').collect::<Vec<_>>());
    let spawned = command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut run = Run(spawned.spawn().unwrap());
    let mut lines = BufReader::new(run.0.stderr.take().unwrap()).lines();
    let address = lines.find(|line| line.as_ref().unwrap().contains("localhost:"));
    assert!(address.is_some(), "no address");
    let pid = shown_by(&run).expect("a program that shows the run");
    let killed = Command::new("kill").args(["-9", &pid]).status().unwrap();
    assert!(killed.success());
    let rest: Vec<_> = lines.map_while(Result::ok).collect();
    let metrics: Value = serde_json::from_reader(run.0.stdout.take().unwrap()).unwrap();
    run.0.wait().unwrap();
    assert!(metrics["duration_s"].as_f64().unwrap() > 2.9, "{metrics:#}");
    assert_eq!(metrics["leftovers"], serde_json::json!([]));
    let says = |line: &String| line.contains("the program for Foxglove ended");
    assert!(rest.iter().any(says), "{rest:#?}");
}

/// A run of the firmware in emulated machines is recorded too.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn a_run_in_emulated_machines_is_recorded() {
    let programs = Programs::new();
    let built = Path::new(env!("CARGO_BIN_EXE_tandem-foxglove"));
    fs::copy(
        built.with_file_name("tandem-lab"),
        programs.path("tandem-lab"),
    )
    .unwrap();
    let images = built.parent().unwrap().with_file_name("firmware");
    let images = images.join("riscv32imac-unknown-none-elf/release");
    let images = std::env::var_os("TANDEM_IMAGES").map_or(images, PathBuf::from);
    let image = images.join("controller");
    let file = programs.path("run.mcap");
    let Some(read) = oracle(&["file", file.to_str().unwrap()]) else {
        return;
    };
    let words = "run --quiet --board qemu --duration 3 --mcap run.mcap --firmware";
    let mut command = programs.tandem(&words.split(' ').collect::<Vec<_>>());
    let output = command.arg(&image).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let found = said_by(read);
    // Its time is the emulator's: no machine can hold it up.
    let seconds = found["seconds"].as_f64().unwrap();
    assert!((3.0..4.0).contains(&seconds), "{found:#}");
    assert_eq!(found["points"], serde_json::json!([41]));
    assert!(found["driven_m"].as_f64().unwrap() > 50.0, "{found:#}");
}

/// What cannot be opened is refused before anything is started, and nothing is left.
#[test]
fn what_cannot_be_opened_is_refused() {
    let programs = Programs::new();
    fs::write(programs.path("notes.txt"), "my notes").unwrap();
    for (words, reason) in [
        ("run --mcap notes.txt", "no MCAP file"),
        ("run --mcap missing/run.mcap", "missing/run.mcap"),
        ("run --foxglove 1 --mcap new.mcap --scenario none", "none"),
        ("foxglove --mcap new.mcap", "no run is active"),
    ] {
        if words.starts_with("foxglove") && !is_idle(&programs) {
            continue;
        }
        let output = programs.tandem(&words.split(' ').collect::<Vec<_>>());
        let output = { output }.output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{words}: {said}");
        assert!(said.contains(reason), "{words}: {said}");
        assert!(!programs.path("new.mcap").exists(), "{words}");
    }
    assert_eq!(fs::read(programs.path("notes.txt")).unwrap(), b"my notes");
    assert!(!programs.path("tandem-report").exists());
}

/// Returns whether no run drives on this machine.
fn is_idle(programs: &Programs) -> bool {
    let listed = programs.tandem(&["ps", "--json"]).output().unwrap();
    serde_json::from_slice::<Vec<Value>>(&listed.stdout)
        .unwrap()
        .is_empty()
}

#[test]
fn the_help_has_the_exit_statuses() {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem-foxglove"));
    let output = command.args(["foxglove", "--help"]).output().unwrap();
    let help = String::from_utf8_lossy(&output.stdout);
    assert!(
        help.contains(tandem_page::command_line::EXIT_STATUS),
        "{help}"
    );
}
