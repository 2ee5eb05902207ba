//! Faults of wires and power while a run drives.

use std::time::Duration;

use serde_json::Value;

use crate::fixture::{Fixture, Run, unless_stalled};

/// `tandem` with these words, on this run.
fn inject(fixture: &Fixture, run: &Run, words: &[&str]) {
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

/// A run that lasts until a test has done with it, once A drives and B stands by.
fn long_run(fixture: &Fixture) -> Run {
    let arguments = [
        "--duration",
        "110",
        "--scenario",
        "free-lane",
        "--reintegrate",
    ];
    let run = fixture.run(&arguments);
    until_roles(&run, &[("A", "master"), ("B", "standby")]);
    run
}

/// The systems that took over, in order.
fn drivers_of(metrics: &Value) -> Vec<&str> {
    let takeovers = metrics["takeovers"].as_array().unwrap().iter();
    takeovers.map(|it| it["to"].as_str().unwrap()).collect()
}

/// Waits until this system is the master.
fn until_drives(run: &Run, system: &str) {
    run.until(&format!("{system} drives"), |processes| {
        let drives = processes
            .iter()
            .any(|it| it.system.as_deref() == Some(system) && it.role.as_deref() == Some("master"));
        drives.then_some(())
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
    unless_stalled(|fixture| {
        let mut run = long_run(fixture);
        inject(fixture, &run, &["power", "off", "A"]);
        until_roles(&run, &[("B", "master")]);
        inject(fixture, &run, &["power", "on", "A"]);
        until_roles(&run, &[("A", "standby"), ("B", "master")]);
        inject(fixture, &run, &["power", "off", "B"]);
        until_roles(&run, &[("A", "master")]);
        inject(fixture, &run, &["power", "on", "B"]);
        until_roles(&run, &[("A", "master"), ("B", "standby")]);
        let on = fixture.output(&["power", "on", "B", "--run", &run.launcher_pid().to_string()]);
        assert_eq!(on.status.code(), Some(1), "it is on already");
        let metrics = run.interrupt();
        one_master(&metrics);
        assert_eq!(drivers_of(&metrics), ["B", "A"], "{metrics:#}");
        run.until_vanished();
        run.left_nothing();
    });
}

/// T-CHIP-6, T-RED-6: a low rail of the master's supply, and then the bus destroys what the other
/// one sends. Each time the other one drives, and what is mended comes back; the report says why.
#[test]
fn faults_of_the_hardware_are_made_and_mended_by_hand() {
    unless_stalled(|fixture| {
        let mut run = long_run(fixture);
        inject(fixture, &run, &["fault", "undervoltage", "A"]);
        until_drives(&run, "B");
        inject(fixture, &run, &["fault", "undervoltage", "A", "--mend"]);
        until_roles(&run, &[("A", "standby"), ("B", "master")]);
        inject(fixture, &run, &["fault", "bus-off", "B"]);
        until_drives(&run, "A");
        inject(fixture, &run, &["fault", "bus-off", "B", "--mend"]);
        until_roles(&run, &[("A", "master"), ("B", "standby")]);
        let metrics = run.interrupt();
        one_master(&metrics);
        assert_eq!(drivers_of(&metrics), ["B", "A"], "{metrics:#}");
        let report = fixture.folder().join("tandem-report/report.html");
        let report = std::fs::read_to_string(report).unwrap();
        assert!(report.contains("low rail of the supply"));
        // How often before core 0 looks depends on the machine.
        let told = |times| report.contains(&format!("bus-off {times} time(s)"));
        assert!((1..5).any(told));
    });
}

/// What is cut: both ways of the heartbeat lines and of the power level, and the CAN of A and of B.
const WIRES: [&[&str]; 5] = [
    &["heartbeat-1"],
    &["heartbeat-2"],
    &["level"],
    &["can", "--from", "A"],
    &["can", "--from", "B"],
];
const TABLE: &str = include_str!("../../docs/redundancy.md");
/// One row of the truth table.
struct Row {
    cut: [bool; 5],
    /// Roles of A and B after 2 s.
    roles: [String; 2],
    /// Whom the vehicle obeys; and then, when A has lost its power, or B.
    obeyed: Option<String>,
    then_obeyed: [Option<String>; 2],
}

/// The table of the docs, which the model of the redundancy has written.
fn rows() -> Vec<Row> {
    let (_, table) = TABLE.split_once("<!-- truth:begin -->").unwrap();
    let (table, _) = table.split_once("<!-- truth:end -->").unwrap();
    let rows = table.lines().filter(|line| line.starts_with('|')).skip(2);
    let of_row = |line: &str| {
        let cells: Vec<_> = line.split('|').skip(1).map(str::trim).collect();
        let system = |cell: &str| {
            let (system, _) = cell.split_once(',').unwrap_or((cell, ""));
            (system != "nobody").then(|| system.to_owned())
        };
        Row {
            cut: [0, 1, 2, 3, 4].map(|wire| cells[wire] == "cut"),
            roles: [5, 6].map(|cell| cells[cell].to_owned()),
            obeyed: system(cells[7]),
            then_obeyed: [9, 10].map(|cell| system(cells[cell])),
        }
    };
    rows.map(of_row).collect()
}

/// The roles of both systems as a person sees them: a master that has no standby is degraded.
fn shown_roles(fixture: &Fixture, run: &Run) -> [String; 2] {
    let shown = String::from_utf8(fixture.output(&["ps"]).stdout).unwrap();
    let of_run = format!("tandem-{}-", run.launcher_pid());
    ["A", "B"].map(|system| {
        let is_it = |words: &Vec<&str>| {
            words.len() > 4 && words[1..3] == ["supply", system] && shown_run(words, &of_run)
        };
        let mut lines = shown.lines().map(|line| line.split_whitespace().collect());
        let words = lines.find(is_it);
        words.map_or_else(String::new, |words| {
            let degraded = if words[5] == "(degraded)" {
                "degraded "
            } else {
                ""
            };
            format!("{degraded}{}", words[4])
        })
    })
}

fn shown_run(words: &[&str], name: &str) -> bool {
    words.last().is_some_and(|run| run.starts_with(name))
}

/// One row of the truth table, with processes: A drives, then this is cut. With `off` that system
/// loses its power then, else the roles are compared after 2 s.
fn holds(row: &Row, off: Option<usize>) {
    unless_stalled(|fixture| row_holds(fixture, row, off));
}

fn row_holds(fixture: &Fixture, row: &Row, off: Option<usize>) {
    let mut run = fixture.run(&["--duration", "60", "--scenario", "free-lane"]);
    until_roles(&run, &[("A", "master"), ("B", "standby")]);
    // One after the other: B's CAN before A's, or B would take over in between.
    for (wire, _) in WIRES.iter().zip(row.cut).rev().filter(|(_, cut)| *cut) {
        inject(fixture, &run, &[&["cut"], *wire].concat());
    }
    let mut obeyed = vec![&row.obeyed];
    let mut roles = row.roles.clone();
    match off {
        Some(system) => {
            std::thread::sleep(Duration::from_millis(100));
            inject(fixture, &run, &["power", "off", ["A", "B"][system]]);
            std::thread::sleep(Duration::from_millis(500));
            obeyed.push(&row.then_obeyed[system]);
        }
        None => {
            std::thread::sleep(Duration::from_secs(2));
            roles = shown_roles(fixture, &run);
        }
    }
    let metrics = run.interrupt();
    one_master(&metrics);
    let mut drives = vec!["A"];
    for system in obeyed.iter().copied().flatten() {
        if !drives.ends_with(&[system]) {
            drives.push(system);
        }
    }
    let takeovers = metrics["takeovers"].as_array().unwrap().iter();
    let to = takeovers.map(|it| it["to"].as_str().unwrap());
    let drove: Vec<_> = std::iter::once("A").chain(to).collect();
    // No system drives: to the end, and for no other time without a stall that explains it.
    let gaps = metrics["gaps"].as_array().unwrap().iter();
    let gaps: Vec<_> = gaps
        .filter(|gap| gap["explained"] == false)
        .map(|gap| gap["ended_by"].as_str().unwrap())
        .collect();
    let is_none_left = obeyed.last().is_some_and(|last| last.is_none());
    let open = vec!["the end of the run"; usize::from(is_none_left)];
    // A system without CAN that does not drive resets itself again and again, and suspends.
    let is_told = |system: usize| {
        let (shown, told) = (&roles[system], &row.roles[system]);
        let resets = row.cut[3 + system] && told == "standby" && !shown.contains("master");
        shown == told || resets
    };
    let holds = (drove, gaps) == (drives, open) && is_told(0) && is_told(1);
    assert!(holds, "{:?}, {off:?} off: {roles:?}\n{metrics:#}", row.cut);
}

/// T-RED-9: three rows of the truth table: split brain, a deaf master beside it, and all but that.
#[test]
fn rows_of_the_truth_table_hold_with_processes() {
    let rows = rows();
    assert_eq!(rows.len(), 32);
    for (cut, off) in [
        ([true, true, false, false, false], Some(0)),
        ([true, true, true, true, false], None),
        ([false, false, true, true, false], Some(1)),
    ] {
        let row = rows.iter().find(|row| row.cut == cut).unwrap();
        holds(row, off);
    }
}

/// T-RED-9: every row, and then each system without power. `cargo nextest run -p tandem --test
/// processes --run-ignored only truth`
#[test]
#[ignore = "takes minutes: a command that a person starts"]
fn every_row_of_the_truth_table_holds_with_processes() {
    for row in rows() {
        for off in [None, Some(0), Some(1)] {
            holds(&row, off);
            println!("{:?}, {off:?} off: as the table says", row.cut);
        }
    }
}
