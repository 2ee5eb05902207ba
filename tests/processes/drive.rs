//! Runs without a disturbance.

use std::fs;

use serde_json::Value;

use crate::fixture::{Fixture, unless_stalled};

fn takeovers(metrics: &Value) -> &[Value] {
    metrics["takeovers"].as_array().unwrap()
}

/// T-CHIP-2, T-CHIP-7: core 0 runs on the kernel and cores 1 and 2 without a tick; one system
/// drives, the other does not transmit, the vehicle comes to no harm; and the report is there.
#[test]
fn a_short_drive_ends_with_a_report() {
    unless_stalled(|fixture| {
        let mut run = fixture.run(&["--duration", "5", "--out", "report"]);
        let metrics = run.metrics();
        assert_eq!(metrics["scenario"], "cut-in");
        assert_eq!(metrics["collisions"], 0);
        assert_eq!(metrics["two_masters_ms"], 0.0);
        assert_eq!(metrics["both_transmitted_ms"], 0.0, "{metrics:#}");
        assert_eq!(metrics["stale_frames"], 0, "{metrics:#}");
        for gap in metrics["gaps"].as_array().unwrap() {
            assert_eq!(gap["explained"], true, "{metrics:#}");
        }
        assert_eq!(metrics["leftovers"].as_array().map(Vec::len), Some(0));
        assert!(
            metrics["control_frames"].as_u64().unwrap() > 400,
            "{metrics:#}"
        );
        assert!(
            (metrics["duration_s"].as_f64().unwrap() - 5.0).abs() < 0.5,
            "{metrics:#}"
        );
        // A core of a busy machine may be held up; there is no other reason to take over.
        assert!(
            takeovers(&metrics)
                .iter()
                .all(|takeover| takeover["held_up"] == true),
            "{metrics:#}"
        );

        // Core 0 runs on the kernel, whose tick and tasks tell of themselves.
        let of_core_0 = |list: &str, key: &str, name: &str| -> Value {
            let entries = metrics[list].as_array().unwrap().iter();
            let mut found = entries.filter(|entry| entry["core"] == 0 && entry[key] == name);
            found.next().unwrap_or_else(|| panic!("{name}")).clone()
        };
        let tick = of_core_0("interrupts", "interrupt", "tick");
        assert!(tick["count"].as_u64().unwrap() > 1000, "{tick}");
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
        // Stamped by the bus, so in the order of the bus.
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
    });
}

#[test]
fn a_second_run_beside_the_first_is_none_of_its_business() {
    let fixture = Fixture::new();
    let first = fixture.run(&["--duration", "6", "--out", "first", "--timing", "desktop"]);
    first.until_dual();
    let second = fixture.run(&["--duration", "2", "--out", "second", "--timing", "desktop"]);
    second.until_dual();
    assert_eq!(first.processes().len(), 9);
    assert_eq!(second.processes().len(), 9);
    for mut run in [second, first] {
        // How long each stands still without real-time priority is the machine's matter.
        assert!(matches!(run.end().code(), Some(0 | 1)), "{}", run.said());
        let metrics = run.told();
        assert_eq!(metrics["collisions"], 0);
        assert_eq!(metrics["two_masters_ms"], 0.0);
        assert_eq!(
            metrics["leftovers"].as_array().map(Vec::len),
            Some(0),
            "{metrics:#}"
        );
    }
}

#[test]
fn the_processes_are_listed_with_exactly_the_promised_names() {
    unless_stalled(|fixture| {
        let mut run = fixture.run(&["--duration", "2"]);
        run.until_dual();
        let listed = fixture.output(&["ps", "--json"]);
        let listed: Vec<Value> = serde_json::from_slice(&listed.stdout).unwrap();
        for process in &listed {
            let mut names: Vec<&String> = process.as_object().unwrap().keys().collect();
            names.sort();
            assert_eq!(names, ["core", "cpu", "kind", "pid", "role", "system"]);
        }
        let of_kind = |kind: &str| run.processes().iter().filter(|p| p.kind == kind).count();
        assert_eq!(
            [of_kind("supply"), of_kind("core"), of_kind("vehicle")],
            [2, 6, 1]
        );
        run.metrics();
    });
}

#[test]
fn data_flash_is_kept_from_run_to_run_if_it_has_a_folder() {
    unless_stalled(|fixture| {
        fs::create_dir(fixture.folder().join("flash")).unwrap();
        fixture
            .run(&["--duration", "1", "--dflash", "flash"])
            .metrics();
        let written = fs::read(fixture.folder().join("flash/A.dflash")).unwrap();
        assert!(
            written.iter().any(|byte| *byte != 0xFF),
            "the state was never written"
        );
        fixture
            .run(&["--duration", "1", "--dflash", "flash"])
            .metrics();
    });
}

/// T-CHIP-4, U-1: a sensor that says nothing is missed within half a second.
#[test]
fn a_lost_sensor_is_a_takeover_request() {
    unless_stalled(|fixture| {
        let fault = "radar-front:lost:0.5-60";
        let run = [
            "--duration",
            "2",
            "--scenario",
            "free-lane",
            "--sensor-fault",
            fault,
        ];
        let metrics = fixture.run(&run).metrics();
        let asked_s = metrics["takeover_asked_s"].as_f64();
        assert!(
            asked_s.is_some_and(|at| (0.5..1.0).contains(&at)),
            "{asked_s:?}"
        );
    });
}
