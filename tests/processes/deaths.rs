//! Tests that kill processes while the vehicle drives.

use rustix::process::Signal;

use crate::fixture::{Fixture, Run, kill, send};
use crate::observers::{until_driven, until_obeyed};

pub(crate) const POWER: &str = "power level fell and heartbeats ended";
pub(crate) const SILENT: &str = "heartbeats and control frames silent";
pub(crate) const UNHEARD: &str = "no control frame reaches the vehicle";
pub(crate) const RESIGNS: &str = "the master resigns";
/// The possible signs of a dead core 0. Which one is detected first depends on timing.
pub(crate) const GONE: &[&str] = &[POWER, SILENT, UNHEARD];

/// Waits for dual operation, and returns the system that drives.
pub(crate) fn dual_master(run: &Run) -> String {
    run.until_dual();
    until_driven(run);
    run.master_supply().system.unwrap()
}

/// Returns the other system.
pub(crate) const fn peer(system: &str) -> &'static str {
    if system.as_bytes()[0] == b'A' {
        "B"
    } else {
        "A"
    }
}

/// Waits until the vehicle obeys the other system, and ends the run. The cause of the takeover from
/// `master` must be one of these signs. The bounds of the gap are checked in virtual time.
fn is_replaced(run: &mut Run, master: &str, signs: &[&str]) {
    until_obeyed(run, peer(master));
    let metrics = run.interrupt();
    // If the machine holds up the new master, a later takeover follows. It is not judged here.
    let mut all = metrics["takeovers"].as_array().unwrap().iter();
    let takeover = all.find(|it| it["from"] == master).unwrap();
    let sign = takeover["cause"].as_str().unwrap();
    // A stall of the machine that was seen at that time silences a master that would have resigned.
    let is_stalled = takeover["held_up"] == true && GONE.contains(&sign);
    assert!(signs.contains(&sign) || is_stalled, "{metrics:#}");
}

/// T-CHIP-5, T-RED-4, T-RED-9: a power loss of the master causes a takeover.
#[test]
fn the_vehicle_goes_on_when_the_supply_of_the_master_is_killed() {
    let fixture = Fixture::new();
    let mut run = fixture.run(&["--duration", "60"]);
    let master = dual_master(&run);
    kill(run.master_supply().pid);
    is_replaced(&mut run, &master, GONE);
}

/// A run in which no system drives to the end fails, and reports when control was lost.
#[test]
fn a_run_in_which_no_system_is_left_fails() {
    let fixture = Fixture::new();
    let mut run = fixture.run(&["--duration", "2"]);
    dual_master(&run);
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

/// T-RED-4, T-RED-5, T-RED-9: when a core of the master dies, its supply resets the system. If a
/// compute core dies, the master still has time to resign.
#[test]
fn the_vehicle_goes_on_when_any_core_of_the_master_is_killed() {
    for (core, signs) in [(0, GONE), (1, &[RESIGNS]), (2, &[RESIGNS])] {
        let fixture = Fixture::new();
        let mut run = fixture.run(&["--duration", "60"]);
        let master = dual_master(&run);
        kill(run.core(&master, core));
        is_replaced(&mut run, &master, signs);
    }
}

/// T-RED-3, T-RED-9: a master whose core 0 is stopped has power. The standby takes over because
/// heartbeats and frames ended. The thawed old master does not drive, not even for one frame.
#[test]
fn a_master_that_was_frozen_does_not_come_back_as_a_second_one() {
    let fixture = Fixture::new();
    let mut run = fixture.run(&["--duration", "60"]);
    let master = dual_master(&run);
    let core_0 = run.core(&master, 0);
    send(core_0, Signal::STOP);
    // Longer than the other system waits, and shorter than the watchdog's timeout.
    std::thread::sleep(std::time::Duration::from_millis(60));
    send(core_0, Signal::CONT);
    is_replaced(&mut run, &master, &[SILENT, UNHEARD]);
}

/// After Ctrl-C only the report remains. It covers the drive up to that time.
#[test]
fn ctrl_c_stops_everything_and_leaves_the_report() {
    let fixture = Fixture::new();
    let mut run = fixture.run(&["--duration", "60"]);
    until_driven(&run);
    let metrics = run.interrupt();
    run.until_vanished();
    run.left_nothing();
    assert!(run.said().contains("what was driven"), "{}", run.said());
    assert_eq!(fixture.names(), ["tandem-report"]);
    assert_eq!(metrics["complete"], false, "{metrics:#}");
    assert!(metrics["duration_s"].as_f64().unwrap() > 0.0, "{metrics:#}");
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
    fixture.run(&["--duration", "0.2"]).metrics();
    run.left_nothing();
    assert_eq!(fixture.names(), ["tandem-report"]);
}

/// A run without `tandem run` drives on for a second, ends long before its scenario does, and
/// leaves the report that `tandem run` would have written.
#[test]
fn the_systems_drive_on_without_tandem_run_and_then_vanish() {
    let fixture = Fixture::new();
    let mut run = fixture.run(&["--duration", "600"]);
    run.until_dual();
    until_driven(&run);
    kill(run.launcher_pid());
    run.end();
    run.until_vanished();
    let report = fixture.folder().join("tandem-report");
    let metrics = std::fs::read(report.join("metrics.json")).unwrap();
    let metrics: serde_json::Value = serde_json::from_slice(&metrics).unwrap();
    assert_eq!(metrics["complete"], false, "{metrics:#}");
    let findings = metrics["verdict"]["findings"].as_array().unwrap();
    let cut_short = findings
        .iter()
        .find(|it| it["rule"] == "cut-short")
        .unwrap();
    let died_s = cut_short["at_s"].as_f64().unwrap();
    let driven_s = metrics["duration_s"].as_f64().unwrap();
    assert!(
        driven_s >= died_s + 0.9,
        "drove on: {died_s} s, {driven_s} s"
    );
    assert!(driven_s < 120.0, "{driven_s} s of 600 s");
    let page = std::fs::read_to_string(report.join("report.html")).unwrap();
    assert!(page.contains("was killed; the vehicle ends the run"));
    // On a machine without namespaces the next start removes the remaining files.
    fixture.run(&["--duration", "0.2"]).metrics();
    run.left_nothing();
}

/// All processes end even if the vehicle's process is killed, and the run fails.
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
