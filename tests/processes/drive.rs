//! Tests of runs without a disturbance.

use std::fs;

use serde_json::Value;

use crate::fixture::Fixture;
use crate::observers::until_driven;

/// T-CHIP-2, T-CHIP-7: core 0 runs on the kernel, and cores 1 and 2 run without a tick. One system
/// drives, the other does not transmit, the vehicle has no collision, and a report is written.
#[test]
fn a_short_drive_ends_with_a_report() {
    let fixture = Fixture::new();
    let mut run = fixture.run(&["--duration", "2", "--out", "report"]);
    let metrics = run.metrics();
    assert_eq!(metrics["scenario"], "cut-in");
    assert_eq!(metrics["complete"], true);
    let at_least = |name: &str, least: f64| metrics[name].as_f64().unwrap() >= least;
    assert!(at_least("control_frames", 1.0), "{metrics:#}");
    // The duration is from the first accepted frame to the last sample. Samples are 20 ms apart.
    assert!(at_least("duration_s", 1.9), "{metrics:#}");

    // Core 0 runs on the kernel, so the metrics contain its tick and its tasks.
    let of_core_0 = |list: &str, key: &str, name: &str| -> Value {
        let entries = metrics[list].as_array().unwrap().iter();
        let mut found = entries.filter(|entry| entry["core"] == 0 && entry[key] == name);
        found.next().unwrap_or_else(|| panic!("{name}")).clone()
    };
    let tick = of_core_0("interrupts", "interrupt", "tick");
    assert!(tick["count"].as_u64().unwrap() > 0, "{tick}");
    let interrupts = metrics["interrupts"].as_array().unwrap();
    let ticks_elsewhere = |of: &&Value| of["core"] != 0 && of["interrupt"] == "tick";
    assert_eq!(interrupts.iter().find(ticks_elsewhere), None);
    for (core, task) in [(1, "perception"), (2, "planning")] {
        let tasks = metrics["tasks"].as_array().unwrap().iter();
        let own: Vec<&Value> = tasks.filter(|of| of["core"] == core).collect();
        let named = own.iter().all(|of| of["task"] == task);
        assert!(named && !own.is_empty(), "{own:?}");
    }
    for name in [
        "heartbeat and roles",
        "monitoring",
        "control",
        "trajectory input",
        "status",
    ] {
        let task = of_core_0("tasks", "task", name);
        let free_bytes = task["stack_free_bytes"].as_u64().unwrap();
        assert!((1..64 << 10).contains(&free_bytes), "{task}");
        assert!(task["lock_held_max_ms"].as_f64().unwrap() > 0.0, "{task}");
    }

    let report = fixture.folder().join("report");
    let read = |name: &str| fs::read_to_string(report.join(name)).unwrap();
    assert_eq!(
        serde_json::from_str::<Value>(&read("metrics.json")).unwrap(),
        metrics
    );
    assert!(read("report.html").contains("<svg"));
    assert!(read("control-period.hgrm").contains("Total count"));
    assert!(read("chain.hgrm").contains("Total count"));
    let log = read("candump.log");
    // The bus assigns the time stamps, so they are in the order of the bus.
    let mut before = String::new();
    for line in log.lines() {
        let words: Vec<&str> = line.split(' ').collect();
        let [time, "can0", frame] = words[..] else {
            panic!("{line}");
        };
        assert!(time.starts_with('(') && frame.contains('#'), "{line}");
        assert!(*before <= *time, "{before} before {line}");
        time.clone_into(&mut before);
    }
    assert!(log.contains(" 0A0##"), "control frames of A");
    assert!(log.contains(" 0B1##"), "status frames of B");
    assert_eq!(fixture.names(), ["report"]);
    run.until_vanished();
    run.left_nothing();
}

#[test]
fn a_second_run_beside_the_first_is_none_of_its_business() {
    let fixture = Fixture::new();
    let first = fixture.run(&["--duration", "60", "--out", "first", "--timing", "desktop"]);
    first.until_dual();
    let second = fixture.run(&["--duration", "60", "--out", "second", "--timing", "desktop"]);
    second.until_dual();
    for mut run in [second, first] {
        assert_eq!(run.processes().len(), 9);
        until_driven(&run);
        run.interrupt();
        run.left_nothing();
    }
}

#[test]
fn the_processes_are_listed_with_exactly_the_promised_names() {
    let fixture = Fixture::new();
    let run = fixture.run(&["--duration", "60"]);
    run.until_dual();
    let listed = fixture.output(&["ps", "--json"]);
    let listed: Vec<Value> = serde_json::from_slice(&listed.stdout).unwrap();
    for process in &listed {
        let mut names: Vec<&String> = process.as_object().unwrap().keys().collect();
        names.sort();
        assert_eq!(
            names,
            ["core", "cpu", "kind", "pid", "role", "run", "system"]
        );
    }
    let of_kind = |kind: &str| run.processes().iter().filter(|p| p.kind == kind).count();
    assert_eq!(
        [of_kind("supply"), of_kind("core"), of_kind("vehicle")],
        [2, 6, 1]
    );
}

#[test]
fn data_flash_is_kept_from_run_to_run_if_it_has_a_folder() {
    let fixture = Fixture::new();
    fs::create_dir(fixture.folder().join("flash")).unwrap();
    fixture
        .run(&["--duration", "0.5", "--dflash", "flash"])
        .metrics();
    let written = fs::read(fixture.folder().join("flash/A.dflash")).unwrap();
    assert!(
        written.iter().any(|byte| *byte != 0xFF),
        "the state was never written"
    );
    fixture
        .run(&["--duration", "0.5", "--dflash", "flash"])
        .metrics();
}

/// T-CHIP-4, U-1: a lost sensor causes a takeover request, whose delay is checked in virtual time.
#[test]
fn a_lost_sensor_is_a_takeover_request() {
    let fixture = Fixture::new();
    let fault = "radar-front:lost:0.5-60";
    let metrics = fixture
        .run(&[
            "--duration",
            "2",
            "--scenario",
            "free-lane",
            "--sensor-fault",
            fault,
        ])
        .metrics();
    let asked_s = metrics["takeover_asked_s"].as_f64();
    assert!(asked_s.is_some_and(|at_s| at_s >= 0.5), "{asked_s:?}");
}
