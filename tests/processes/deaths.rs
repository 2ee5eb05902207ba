//! Processes that are killed while the vehicle drives.

use rustix::process::Signal;
use serde_json::Value;

use crate::fixture::{Fixture, Run, kill, send};

/// Takeovers that were not because a busy machine held up a core.
fn takeovers(metrics: &Value) -> Vec<&Value> {
    let all = metrics["takeovers"].as_array().unwrap();
    all.iter()
        .filter(|takeover| takeover["held_up"] != true)
        .collect()
}

/// The other system drives on, after one takeover, and there were never two masters.
fn one_takeover(run: &mut Run, from: &str) {
    let metrics = run.metrics();
    let takeovers = takeovers(&metrics);
    assert_eq!(takeovers.len(), 1, "{metrics:#}");
    assert_eq!(takeovers[0]["from"], from, "{metrics:#}");
    assert_eq!(metrics["two_masters_ms"], 0.0, "{metrics:#}");
    assert_eq!(metrics["collisions"], 0, "{metrics:#}");
    assert_eq!(metrics["false_takeovers"], 0, "{metrics:#}");
    assert_eq!(
        metrics["leftovers"].as_array().map(Vec::len),
        Some(0),
        "{metrics:#}"
    );
}

/// T-CHIP-5, T-RED-4, T-RED-9: loss of power.
#[test]
fn the_vehicle_goes_on_when_the_supply_of_the_master_is_killed() {
    let fixture = Fixture::new();
    let mut run = fixture.run(&["--duration", "5"]);
    run.until_dual();
    let supply = run.master_supply();
    kill(supply.pid);
    one_takeover(&mut run, &supply.system.unwrap());
}

/// T-RED-3, T-RED-9: the heartbeats of a processor that is dead fail.
#[test]
fn the_vehicle_goes_on_when_any_core_of_the_master_is_killed() {
    let fixture = Fixture::new();
    for core in 0..3 {
        let mut run = fixture.run(&["--duration", "5"]);
        run.until_dual();
        let master = run.master_supply().system.unwrap();
        let victim = run.until("the core", |processes| {
            let is_it = |p: &&_| is_core(p, &master, core);
            processes.iter().find(is_it).map(|p| p.pid)
        });
        kill(victim);
        one_takeover(&mut run, &master);
    }
}

fn is_core(process: &crate::fixture::Process, system: &str, core: u64) -> bool {
    process.core == Some(core) && process.system.as_deref() == Some(system)
}

/// T-RED-9: a master that thaws after the other took over does not drive, not for one frame.
#[test]
fn a_master_that_was_frozen_does_not_come_back_as_a_second_one() {
    let fixture = Fixture::new();
    let mut run = fixture.run(&["--duration", "5"]);
    run.until_dual();
    let master = run.master_supply().system.unwrap();
    let victim = run.until("core 0", |processes| {
        processes
            .iter()
            .find(|p| is_core(p, &master, 0))
            .map(|p| p.pid)
    });
    send(victim, Signal::STOP);
    std::thread::sleep(std::time::Duration::from_millis(60));
    send(victim, Signal::CONT);
    let metrics = run.metrics();
    assert_eq!(metrics["two_masters_ms"], 0.0, "{metrics:#}");
    assert_eq!(metrics["takeovers"][0]["from"], master, "{metrics:#}");
    assert_eq!(metrics["collisions"], 0, "{metrics:#}");
}

#[test]
fn ctrl_c_stops_everything_and_leaves_nothing() {
    let fixture = Fixture::new();
    let mut run = fixture.run(&["--duration", "60"]);
    run.until_dual();
    send(run.launcher_pid(), Signal::INT);
    let status = run.end();
    assert_eq!(status.code(), Some(130), "{}", run.said());
    assert!(run.said().contains("no report"), "{}", run.said());
    run.until_vanished();
    assert!(run.files().is_empty(), "{:?}", run.files());
    assert!(fixture.names().is_empty(), "{:?}", fixture.names());
}

#[test]
fn the_start_after_everything_was_killed_works_and_nothing_is_left() {
    let fixture = Fixture::new();
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
    assert!(run.files().is_empty(), "{:?}", run.files());
    assert_eq!(fixture.names(), ["tandem-report"]);
}

#[test]
fn the_systems_drive_on_without_tandem_run_and_then_vanish() {
    let fixture = Fixture::new();
    let mut run = fixture.run(&["--duration", "3"]);
    run.until_dual();
    kill(run.launcher_pid());
    run.end();
    run.until_dual();
    run.until_vanished();
    // What a machine without namespaces keeps goes with the next start.
    fixture.run(&["--duration", "1"]).metrics();
    assert!(run.files().is_empty(), "{:?}", run.files());
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
    assert!(run.files().is_empty(), "{:?}", run.files());
}
