//! Processes that are killed while the vehicle drives.

use rustix::process::Signal;
use serde_json::Value;

use crate::fixture::{Fixture, Run, kill, send, unless_stalled};

/// How a vehicle got another driver: one takeover, on one of these signs. Its gap, as all others,
/// kept the bound of its cause, or a stall of the machine explains it; the verdict of the run has
/// seen to that. No frame of a second master, none too old, none damaged.
fn one_takeover(run: &mut Run, from: &str, signs: &[&str]) -> Value {
    let metrics = run.metrics();
    // A busy machine may hold up a core, which is replaced then.
    let takeovers = metrics["takeovers"].as_array().unwrap().iter();
    let takeovers: Vec<&Value> = takeovers.filter(|of| of["held_up"] != true).collect();
    assert_eq!(takeovers.len(), 1, "{metrics:#}");
    assert_eq!(takeovers[0]["from"], from, "{metrics:#}");
    let sign = takeovers[0]["cause"].as_str().unwrap();
    assert!(signs.contains(&sign), "{metrics:#}");
    kept_control(&metrics);
    metrics
}

/// What must hold of every run in which one system was left.
fn kept_control(metrics: &Value) {
    for name in [
        "collisions",
        "false_takeovers",
        "stale_frames",
        "invalid_frames",
    ] {
        assert_eq!(metrics[name], 0, "{name}: {metrics:#}");
    }
    assert_eq!(metrics["two_masters_ms"], 0.0, "{metrics:#}");
    let ms = |name: &str| metrics[name].as_f64().unwrap();
    assert!(
        ms("both_transmitted_ms") <= ms("hand_over_ms"),
        "{metrics:#}"
    );
    for gap in metrics["gaps"].as_array().unwrap() {
        let stalled = gap["stalled_ms"].as_f64().unwrap();
        assert!(gap["explained"] == true && stalled > 0.0, "{metrics:#}");
    }
    for takeover in metrics["takeovers"].as_array().unwrap() {
        let ms = |name: &str| takeover[name].as_f64().unwrap();
        let is_told = |gap: &Value| (gap["gap_ms"].as_f64().unwrap() - ms("gap_ms")).abs() < 1e-6;
        let told = metrics["gaps"].as_array().unwrap().iter().any(is_told);
        assert!(ms("gap_ms") <= ms("bound_ms") || told, "{metrics:#}");
    }
    assert_eq!(
        metrics["leftovers"].as_array().map(Vec::len),
        Some(0),
        "{metrics:#}"
    );
}

const POWER: &str = "power level fell and heartbeats ended";
const SILENT: &str = "heartbeats and control frames silent";
const UNHEARD: &str = "no control frame reaches the vehicle";
const RESIGNS: &str = "the master resigns";

/// T-CHIP-5, T-RED-4, T-RED-9: loss of power.
#[test]
fn the_vehicle_goes_on_when_the_supply_of_the_master_is_killed() {
    unless_stalled(|fixture| {
        let mut run = fixture.run(&["--duration", "5"]);
        run.until_dual();
        let supply = run.master_supply();
        kill(supply.pid);
        one_takeover(&mut run, &supply.system.unwrap(), &[POWER]);
    });
}

/// A run in which no system drives any more has failed, and says from when on.
#[test]
fn a_run_in_which_no_system_is_left_fails() {
    let fixture = Fixture::new();
    let mut run = fixture.run(&["--duration", "4"]);
    run.until_dual();
    for process in run.processes() {
        if process.kind == "supply" {
            kill(process.pid);
        }
    }
    assert_eq!(run.end().code(), Some(1), "{}", run.said());
    let said = run.said();
    assert!(said.contains("no system drove for"), "{said}");
    assert!(said.contains("up to the end of the run"), "{said}");
}

/// T-RED-4, T-RED-5, T-RED-9: a core of the master dies: its supply resets the system. A compute
/// core that dies leaves time to resign.
#[test]
fn the_vehicle_goes_on_when_any_core_of_the_master_is_killed() {
    for (core, signs) in [(0, &[POWER, SILENT][..]), (1, &[RESIGNS]), (2, &[RESIGNS])] {
        unless_stalled(|fixture| {
            let mut run = fixture.run(&["--duration", "5"]);
            run.until_dual();
            let master = run.master_supply().system.unwrap();
            let victim = run.until("the core", |processes| {
                let is_it = |p: &&_| is_core(p, &master, core);
                processes.iter().find(is_it).map(|p| p.pid)
            });
            kill(victim);
            one_takeover(&mut run, &master, signs);
        });
    }
}

fn is_core(process: &crate::fixture::Process, system: &str, core: u64) -> bool {
    process.core == Some(core) && process.system.as_deref() == Some(system)
}

/// T-RED-3, T-RED-9: a master whose core 0 stands still has power; the other takes over because its
/// heartbeats and frames ended. When it thaws, it does not drive, not for one frame.
#[test]
fn a_master_that_was_frozen_does_not_come_back_as_a_second_one() {
    unless_stalled(|fixture| {
        let mut run = fixture.run(&["--duration", "5"]);
        run.until_dual();
        let master = run.master_supply().system.unwrap();
        let victim = run.until("core 0", |processes| {
            processes
                .iter()
                .find(|p| is_core(p, &master, 0))
                .map(|p| p.pid)
        });
        // A new standby waits some milliseconds for the first heartbeat.
        std::thread::sleep(std::time::Duration::from_millis(200));
        send(victim, Signal::STOP);
        std::thread::sleep(std::time::Duration::from_millis(60));
        send(victim, Signal::CONT);
        let metrics = run.metrics();
        kept_control(&metrics);
        let takeover = &metrics["takeovers"][0];
        assert_eq!(takeover["from"], master, "{metrics:#}");
        // If its last report over the link is younger than its last frame, the vehicle's word may
        // come first.
        let cause = takeover["cause"].as_str().unwrap();
        assert!([SILENT, UNHEARD].contains(&cause), "{metrics:#}");
    });
}

/// The report of what was driven is all that is left.
#[test]
fn ctrl_c_stops_everything_and_leaves_the_report() {
    // Master and standby may come before the first control frame: that run has driven nothing.
    let mut tries = 0..5;
    let (fixture, run) = loop {
        let fixture = Fixture::new();
        let mut run = fixture.run(&["--duration", "60"]);
        run.until_dual();
        send(run.launcher_pid(), Signal::INT);
        let status = run.end();
        assert_eq!(status.code(), Some(130), "{}", run.said());
        run.until_vanished();
        run.left_nothing();
        if !run.said().contains("no report was written") {
            break (fixture, run);
        }
        assert!(fixture.names().is_empty(), "{:?}", fixture.names());
        assert!(tries.next().is_some(), "{}", run.said());
    };
    assert!(run.said().contains("what was driven"), "{}", run.said());
    assert_eq!(fixture.names(), ["tandem-report"]);
    let metrics = run.told();
    assert_eq!(metrics["complete"], false, "{metrics:#}");
    assert!(metrics["duration_s"].as_f64().unwrap() > 0.0, "{metrics:#}");
}

#[test]
fn the_start_after_everything_was_killed_works_and_nothing_is_left() {
    unless_stalled(|fixture| {
        let mut run = fixture.run(&["--duration", "60"]);
        run.until_dual();
        let victims = run.processes();
        assert_eq!(victims.len(), 9);
        kill(run.launcher_pid());
        for victim in victims {
            kill(victim.pid);
        }
        run.end();
        run.until_vanished();
        fixture.run(&["--duration", "1"]).metrics();
        run.left_nothing();
        assert_eq!(fixture.names(), ["tandem-report"]);
    });
}

#[test]
fn the_systems_drive_on_without_tandem_run_and_then_vanish() {
    unless_stalled(|fixture| {
        let mut run = fixture.run(&["--duration", "3"]);
        run.until_dual();
        kill(run.launcher_pid());
        run.end();
        run.until_dual();
        run.until_vanished();
        // On a machine without namespaces the next start removes what is left.
        fixture.run(&["--duration", "1"]).metrics();
        run.left_nothing();
    });
}

/// Nothing in the controller needs the vehicle's process to end well.
#[test]
fn a_run_whose_vehicle_was_killed_has_failed_and_leaves_nothing() {
    let fixture = Fixture::new();
    let mut run = fixture.run(&["--duration", "60", "--out", "cut-short"]);
    run.until_dual();
    let vehicle = run.until("the vehicle", |processes| {
        processes
            .iter()
            .find(|p| p.kind == "vehicle")
            .map(|p| p.pid)
    });
    kill(vehicle);
    assert_eq!(run.end().code(), Some(1), "{}", run.said());
    assert!(
        run.said().contains("did not reach its end"),
        "{}",
        run.said()
    );
    run.until_vanished();
    run.left_nothing();
}
