//! Tests of the commands with `--board qemu`, which run the controller as firmware. Only `cargo
//! xtask firmware test` runs them, because they need QEMU and the images.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "all of it is a test"
)]

use std::fs;
use std::io::{self, BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

/// How the lines of a run begin that name its emulators. Other lines may come before them.
const EMULATOR: &str = "emulator of ";
const OF_A: &str = "emulator of A: process ";

/// Longer than any run of these tests takes on a busy machine.
const WATCHDOG: Duration = Duration::from_secs(180);

fn tandem(arguments: &[&str], out: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem-lab"));
    command
        .args(["run", "--seed", "7", "--out"])
        .arg(out)
        .args(arguments)
        .stdout(Stdio::null())
        .stderr(Stdio::piped());
    command
}

/// Waits until the run ends. Fails if it does not end successfully.
fn end(mut run: Child) {
    let begin = Instant::now();
    let status = loop {
        if let Some(status) = run.try_wait().unwrap() {
            break status;
        }
        if begin.elapsed() > WATCHDOG {
            run.kill().unwrap();
            panic!("the run does not end");
        }
        std::thread::sleep(Duration::from_millis(20));
    };
    assert!(status.success(), "{status}");
}

fn metrics(out: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(out.join("metrics.json")).unwrap()).unwrap()
}

/// Returns the frames on the bus in order, without their time stamps.
fn frames(out: &Path) -> Vec<String> {
    let log = fs::read_to_string(out.join("candump.log")).unwrap();
    let frame = |line: &str| line.split_once(") ").unwrap().1.to_owned();
    log.lines().map(frame).collect()
}

/// Both systems drive in one machine, and a second run produces exactly the same frames.
fn drives_alike_each_time(chosen: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let outs: [PathBuf; 2] = ["first", "second"].map(|name| folder.path().join(name));
    for out in &outs {
        let arguments = ["--board", "qemu-one", "--duration", "2", "--quiet"];
        end(tandem(&arguments, out).args(chosen).spawn().unwrap());
    }
    let [first, second] = outs.each_ref().map(|out| frames(out));
    assert!(first.len() > 1_000, "only {} frames", first.len());
    assert_eq!(first, second);
    let metrics = metrics(&outs[0]);
    assert_eq!(metrics["complete"], true);
    assert_eq!(metrics["collisions"], 0);
    assert_eq!(metrics["takeovers"], Value::Array(vec![]));
}

#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn a_run_of_the_firmware_is_the_same_each_time() {
    drives_alike_each_time(&[]);
}

/// The image says for which machine it is.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn a_run_on_the_64_bit_machine_is_the_same_each_time() {
    let images = std::env::var("TANDEM_IMAGES").expect("cargo xtask firmware test sets it");
    drives_alike_each_time(&["--firmware", &format!("{images}/rv64-controller")]);
}

/// T-CHIP-5, T-RED-4: each system runs in its own emulator. When the master's is killed, B drives.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn the_other_emulator_takes_over_from_one_that_is_killed() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("report");
    let arguments = ["--board", "qemu", "--duration", "10"];
    let mut run = tandem(&arguments, &out).spawn().unwrap();
    let mut said = BufReader::new(run.stderr.take().unwrap()).lines();
    let of_a = |line: io::Result<String>| Some(line.unwrap().strip_prefix(OF_A)?.to_owned());
    let pid = said.find_map(of_a).expect("the run names its emulators");
    // B drives at the end, even if A is killed before it drives. Usually A drives first.
    std::thread::sleep(Duration::from_secs(3));
    let kill = Command::new("kill").args(["-9", &pid]).status().unwrap();
    assert!(kill.success(), "the emulator ended by itself");
    end(run);
    let metrics = metrics(&out);
    assert_eq!(metrics["complete"], true);
    assert_eq!(metrics["collisions"], 0);
    assert_eq!(metrics["two_masters_ms"], 0.0);
    let takeovers = metrics["takeovers"].as_array().unwrap();
    assert!(takeovers.len() <= 1, "{takeovers:?}");
    for takeover in takeovers {
        assert_eq!(takeover["to"], "B");
        assert_eq!(takeover["is_false"], false);
    }
    // If A was killed before it drove, B was the master from the start.
    let last = frames(&out);
    let control_of_b = "can0 0A1##";
    assert!(
        last.iter()
            .rev()
            .take(500)
            .any(|frame| frame.starts_with(control_of_b)),
        "B drives at the end: {:?}",
        last.last()
    );
}

/// D-2, D-3: an SoC in the time of the emulated machines hears the bus, and parks.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn an_soc_parks_the_vehicle_of_a_run() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("report");
    let network = ["--domain", "220", "--interface", "127.77.3.5", "--soc"];
    let drive = [
        "--board",
        "qemu",
        "--scenario",
        "parking",
        "--duration",
        "13",
    ];
    end(tandem(&[&drive[..], &network].concat(), &out)
        .spawn()
        .unwrap());
    let metrics = metrics(&out);
    assert_eq!(metrics["complete"], true);
    let soc = &metrics["soc"];
    assert_eq!(soc["parked"], true, "{soc}");
    // Of the three frames from before it joined, some may be gone when it asks for them.
    assert!(soc["lost"].as_u64().unwrap() <= 3, "{soc}");
}

/// Killing the run leaves no emulator behind, even before the firmware has begun.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn emulators_end_when_the_run_is_killed() {
    for after_ms in [0, 1_000] {
        let folder = tempfile::tempdir().unwrap();
        let arguments = ["--board", "qemu", "--duration", "60"];
        let mut run = tandem(&arguments, &folder.path().join("report"))
            .spawn()
            .unwrap();
        let said = BufReader::new(run.stderr.take().unwrap()).lines();
        let emulators = said
            .map(Result::unwrap)
            .filter(|line| line.starts_with(EMULATOR));
        let pid = |line: String| line.rsplit_once(' ').unwrap().1.parse::<u32>().unwrap();
        let pids: Vec<u32> = emulators.take(2).map(pid).collect();
        std::thread::sleep(Duration::from_millis(after_ms));
        let running = |pid: &u32| {
            let state = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
            state.contains("(qemu") && !state.contains(") Z ")
        };
        assert!(pids.iter().all(running), "{pids:?}");
        run.kill().unwrap();
        run.wait().unwrap();
        let begin = Instant::now();
        while pids.iter().any(running) {
            assert!(begin.elapsed() < WATCHDOG, "{pids:?} run on");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

/// U-1, U-3, U-5, T-BOOT-1: each emulated system gets release 2 over CAN while the other drives,
/// starts it from slot B and approves it. The master first hands over, so no control frame is
/// missing in the vehicle's log.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn both_emulated_systems_are_updated_while_they_drive() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("report");
    let scenario = [
        "--board",
        "qemu",
        "--scenario",
        "free-lane",
        "--duration",
        "160",
    ];
    let mut command = tandem(&scenario, &out);
    let run = command.args(["--reintegrate", "--update", "2"]).output();
    let run = run.unwrap();
    let said = String::from_utf8(run.stderr).unwrap();
    assert!(run.status.success(), "{said}");
    for system in ["A", "B"] {
        let taken = format!("{system} has taken the update");
        assert!(said.contains(&taken), "{taken}: {said}");
        let approved = format!("{system} runs release 2, approved");
        assert!(said.contains(&approved), "{approved}: {said}");
    }
    let metrics = metrics(&out);
    assert_eq!(metrics["complete"], true);
    assert_eq!(metrics["collisions"], 0);
    assert_eq!(metrics["two_masters_ms"], 0.0);
    let takeovers = metrics["takeovers"].as_array().unwrap();
    let [takeover] = &takeovers[..] else {
        panic!("one exchange of roles: {takeovers:?}");
    };
    assert_eq!(takeover["is_false"], false);
    // One control period, and one millisecond of the emulator.
    let gap = metrics["control_gap_max_ms"].as_f64().unwrap();
    assert!(gap <= 11.0, "{gap} ms");
}

/// T-BOOT-8 on an emulated machine, with the application in a separate file and a real jump.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn three_cores_of_the_firmware_send_what_was_downloaded() {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem-lab"));
    let output = command.args(["boot-demo", "--board", "qemu"]).output();
    let output = output.unwrap();
    let shown = String::from_utf8(output.stdout).unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    for frame in ["700#00", "701#01", "702#02"] {
        assert!(shown.contains(frame), "{frame} did not come: {shown}{said}");
    }
}

/// T-SYNC-4, T-LOCK-2, T-RED-2, T-RED-8: the thesis's experiments keep their bounds on firmware,
/// and every transfer of 4 bytes takes the same time.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn the_experiments_of_the_thesis_hold_on_firmware() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("thesis.json");
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem-lab"));
    command.args(["thesis", "--board", "qemu", "--json"]);
    let output = command.arg(&json).output().unwrap();
    let shown = String::from_utf8(output.stdout).unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{shown}{said}");
    let reported: Value = serde_json::from_str(&fs::read_to_string(json).unwrap()).unwrap();
    let here = |name: &str| {
        let rows = reported["results"].as_array().unwrap();
        let row = rows.iter().find(|row| row["name"] == name);
        row.unwrap_or_else(|| panic!("{name}: {reported:#}"))["here"].as_f64()
    };
    let ns = here("sync/4-bytes").unwrap();
    let each = format!("250 messages, 0 wrong; median {ns:.0} ns, worst {ns:.0} ns");
    assert!(ns > 0.0 && shown.contains(&each), "{shown}");
    assert_eq!(here("lock/counter"), Some(0.0));
    for name in ["start/skew", "takeover/reset", "takeover/power"] {
        assert!(here(name).is_some(), "{name}");
    }
}

/// T-RTOS-3: the picture shows the emulated outputs, and names the clock of the times.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn outputs_of_the_firmware_are_drawn() {
    let folder = tempfile::tempdir().unwrap();
    let svg = folder.path().join("outputs.svg");
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem-lab"));
    command.args(["rtos-demo", "--board", "qemu", "--svg"]);
    let output = command.arg(&svg).output().unwrap();
    let shown = String::from_utf8(output.stdout).unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    let svg = fs::read_to_string(svg).unwrap();
    for text in [&shown, &svg] {
        for part in ["60 ms: 60.00 ms", "40 ms: 40.00 ms", "20 ms: 20.00 ms"] {
            assert!(text.contains(part), "{part}: {text}");
        }
        assert!(text.contains("priority 3: 30.00 ms"), "{text}");
        assert!(text.contains("priority 2: preempted"), "{text}");
        assert!(text.contains("time (QEMU, riscv32)"), "{text}");
    }
}

fn chaos(arguments: &[&str]) -> (Option<i32>, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem-lab"));
    command.args(["chaos", "--board", "qemu"]).args(arguments);
    let output = command.output().unwrap();
    let reported = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    (output.status.code(), reported.concat())
}

/// Writes a file with one fault at time 0, and returns its path.
fn fault(folder: &Path, what: &str, of: &str) -> String {
    let file = folder.join("fault.toml");
    let text =
        format!("mended-at-ms = 300.0\n[[fault]]\nwhat = \"{what}\"\nof = \"{of}\"\nat-ms = 0.0\n");
    fs::write(&file, text).unwrap();
    file.into_os_string().into_string().unwrap()
}

/// In a campaign on firmware, each fault of the systems and of the wires between them stays within
/// its bound. If both systems lose power, no system drives, and the campaign reports that.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn faults_of_emulated_machines_are_judged() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("chaos.json");
    let arguments = ["--matrix", "--every", "167", "--json"];
    let (status, reported) = chaos(&[&arguments[..], &[json.to_str().unwrap()]].concat());
    assert_eq!(status, Some(0), "{reported}");
    let figures: Value = serde_json::from_str(&fs::read_to_string(json).unwrap()).unwrap();
    assert_eq!(
        (&figures["faults"], &figures["violations"]),
        (&6.into(), &0.into())
    );
    let of_master = |class: &&Value| class["name"] == "power-loss of the master";
    let classes = figures["classes"].as_array().unwrap();
    let gap = classes.iter().find(of_master).expect(&reported)["gap_max_ms"].as_f64();
    assert!(gap.is_some_and(|ms| ms > 9.0), "{reported}");
    let cut = fault(folder.path(), "network-cut", "both");
    let (status, reported) = chaos(&["--faults", &cut, "--count", "1"]);
    assert_eq!(status, Some(0), "{reported}");
    let both = fault(folder.path(), "power-loss", "both");
    let (status, reported) = chaos(&["--faults", &both, "--count", "1"]);
    assert_eq!(status, Some(1), "{reported}");
    assert!(reported.contains("no system drove for"), "{reported}");
    assert!(reported.contains("--board qemu --only 0"), "{reported}");
}

#[test]
fn what_emulated_machines_cannot_suffer_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = fault(folder.path(), "flash-lost", "a");
    let (status, reported) = chaos(&["--faults", &file]);
    assert_eq!(status, Some(2), "{reported}");
    assert!(
        reported.contains("flash-lost: emulated machines cannot suffer it"),
        "{reported}"
    );
}
