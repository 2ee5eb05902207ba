//! Hands on wires and power while a run drives.

use std::time::Duration;

use serde_json::Value;

use crate::fixture::{Fixture, Run};

/// `tandem` with these words, on this run.
fn hand(fixture: &Fixture, run: &Run, words: &[&str]) {
    let pid = run.launcher_pid().to_string();
    let output = fixture.output(&[words, &["--run", &pid]].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{words:?}: {said}");
}

/// Waits until the supplies of these systems show these roles, and no other supply is there.
fn until_roles(run: &Run, expected: &[(&str, &str)]) {
    run.until(&format!("{expected:?}"), |processes| {
        let supplies = processes.iter().filter(|process| process.kind == "supply");
        let roles: Vec<_> = supplies
            .map(|it| {
                (
                    it.system.as_deref().unwrap_or(""),
                    it.role.as_deref().unwrap_or(""),
                )
            })
            .collect();
        (roles == expected).then_some(())
    });
}

/// Never two masters, whatever else happened.
fn one_master(metrics: &Value) {
    for name in ["two_masters_ms", "both_transmitted_ms"] {
        assert_eq!(metrics[name], 0.0, "{metrics:#}");
    }
    assert_eq!(metrics["false_takeovers"], 0, "{metrics:#}");
}

/// T-RED-4, T-RED-5, T-RED-7: a system that has lost its power is switched on again in the same
/// run, and joins as the standby; then the other one loses its power, and it takes over.
#[test]
fn a_system_that_was_switched_off_is_switched_on_again_and_joins() {
    let fixture = Fixture::new();
    let mut run = fixture.run(&[
        "--duration",
        "110",
        "--scenario",
        "free-lane",
        "--reintegrate",
    ]);
    until_roles(&run, &[("A", "master"), ("B", "standby")]);
    hand(&fixture, &run, &["power", "off", "A"]);
    until_roles(&run, &[("B", "master")]);
    hand(&fixture, &run, &["power", "on", "A"]);
    until_roles(&run, &[("A", "standby"), ("B", "master")]);
    hand(&fixture, &run, &["power", "off", "B"]);
    until_roles(&run, &[("A", "master")]);
    hand(&fixture, &run, &["power", "on", "B"]);
    until_roles(&run, &[("A", "master"), ("B", "standby")]);
    let on = fixture.output(&["power", "on", "B", "--run", &run.launcher_pid().to_string()]);
    assert_eq!(on.status.code(), Some(1), "it is on already");
    let metrics = run.interrupt();
    one_master(&metrics);
    let drivers: Vec<_> = metrics["takeovers"].as_array().unwrap().iter().collect();
    let to: Vec<_> = drivers
        .iter()
        .map(|it| it["to"].as_str().unwrap())
        .collect();
    assert_eq!(to, ["B", "A"], "{metrics:#}");
    run.until_vanished();
    assert!(run.files().is_empty(), "{:?}", run.files());
}

/// What is cut: both ways of the heartbeat lines and of the power level, and the CAN of A and of B.
const WIRES: [&[&str]; 5] = [
    &["heartbeat-1"],
    &["heartbeat-2"],
    &["level"],
    &["can", "--from", "A"],
    &["can", "--from", "B"],
];

/// One row of the truth table, with processes: A drives, then this is cut.
fn row(cut: [bool; 5]) {
    let fixture = Fixture::new();
    let mut run = fixture.run(&["--duration", "60", "--scenario", "free-lane"]);
    until_roles(&run, &[("A", "master"), ("B", "standby")]);
    // One after the other: B's CAN before A's, or B would take over in between.
    for (wire, _) in WIRES.iter().zip(cut).rev().filter(|(_, cut)| *cut) {
        hand(&fixture, &run, &[&["cut"], *wire].concat());
    }
    std::thread::sleep(Duration::from_millis(1_500));
    let metrics = run.interrupt();
    one_master(&metrics);
    let takeovers = metrics["takeovers"].as_array().unwrap();
    // A machine that stalls is another matter: the report has the evidence.
    let takeovers = takeovers.iter().filter(|it| it["held_up"] == false);
    let to: Vec<_> = takeovers.map(|it| it["to"].as_str().unwrap()).collect();
    let [.., can_a, can_b] = cut;
    let expected: &[&str] = if can_a && !can_b { &["B"] } else { &[] };
    assert_eq!(to, expected, "{cut:?}\n{metrics:#}");
}

fn rows() -> impl Iterator<Item = [bool; 5]> {
    (0..32_u8).map(|bits| [0, 1, 2, 3, 4].map(|wire| bits >> wire & 1 == 1))
}

/// T-RED-9: three rows of the truth table: split brain, a deaf master beside it, and all but that.
#[test]
fn rows_of_the_truth_table_hold_with_processes() {
    row([true, true, false, false, false]);
    row([true, true, true, true, false]);
    row([false, false, true, true, false]);
}

/// T-RED-9: every row. `cargo nextest run -p tandem --test processes --run-ignored only truth`
#[test]
#[ignore = "takes minutes: a command that a person starts"]
fn every_row_of_the_truth_table_holds_with_processes() {
    rows().for_each(row);
}
