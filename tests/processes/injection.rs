//! Tests of faults of wires and power while a run drives.

use std::time::Duration;

use serde_json::Value;

use crate::deaths::{dual_master, peer};
use crate::fixture::{Fixture, Run, takeovers};
use crate::observers::until_obeyed;

/// Runs `tandem` with these arguments on this run.
pub(crate) fn inject(fixture: &Fixture, run: &Run, words: &[&str]) {
    let pid = run.launcher_pid().to_string();
    let output = fixture.output(&[words, &["--run", &pid]].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{words:?}: {said}");
}

/// Waits until the supplies of these systems show these roles, and no other supply exists.
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

/// Starts a run that lasts longer than its test.
fn long_run(fixture: &Fixture) -> Run {
    fixture.run(&[
        "--duration",
        "110",
        "--scenario",
        "free-lane",
        "--reintegrate",
    ])
}

/// The report names each fault that a person injected, and each end of one.
#[test]
fn the_report_names_what_was_done_to_the_run() {
    let fixture = Fixture::new();
    let mut run = long_run(&fixture);
    let master = dual_master(&run);
    let standby = peer(&master);
    let hands = |hands: &[&[&str]]| {
        for words in hands {
            inject(&fixture, &run, words);
            // The vehicle looks at what it tells at least every 10 ms.
            std::thread::sleep(Duration::from_millis(100));
        }
    };
    hands(&[
        &["cut", "link", "--from", &master],
        &["mend", "link"],
        &["fault", "hang", standby],
    ]);
    run.until_dual();
    hands(&[&["power", "off", standby], &["power", "on", standby]]);
    run.until_dual();
    hands(&[
        &["fault", "open-load", standby],
        &["fault", "open-load", standby, "--mend"],
    ]);
    run.interrupt();
    let page = std::fs::read_to_string(fixture.folder().join("tandem-report/report.html"));
    let page = page.unwrap();
    for (system, told) in [
        (&*master, "its wire link is cut"),
        (&*master, "its wire link is mended"),
        (standby, "fault begins: open load of an output driver"),
        (standby, "fault ends: open load of an output driver"),
        (standby, "its core 0 is stopped for 100 ms"),
        (standby, "its power is switched off"),
        (standby, "its power is switched on"),
    ] {
        let row = format!("<td>hand on {system}</td><td>{told}</td>");
        assert!(page.contains(&row), "{row}");
    }
    let lost = "is without power: its supply has ended";
    assert!(page.contains(lost), "{lost}");
}

/// Returns the systems that took over, in order.
fn drivers_of(metrics: &Value) -> Vec<&str> {
    let all = takeovers(metrics).into_iter();
    all.map(|it| it["to"].as_str().unwrap()).collect()
}

/// T-RED-4, T-RED-5, T-RED-7: a system that has lost its power is switched on again in the same
/// run, and joins as standby. Then the other system loses its power, and the joined one takes over.
#[test]
fn a_system_that_was_switched_off_is_switched_on_again_and_joins() {
    let fixture = Fixture::new();
    let mut run = long_run(&fixture);
    let mut drivers = vec![];
    for _ in 0..2 {
        let master = dual_master(&run);
        inject(&fixture, &run, &["power", "off", &master]);
        until_roles(&run, &[(peer(&master), "master")]);
        until_obeyed(&run, peer(&master));
        inject(&fixture, &run, &["power", "on", &master]);
        drivers.push(peer(&master));
    }
    run.until_dual();
    let on = fixture.output(&["power", "on", "B", "--run", &run.launcher_pid().to_string()]);
    assert_eq!(on.status.code(), Some(1), "it is on already");
    let metrics = run.interrupt();
    assert_eq!(drivers_of(&metrics), drivers, "{metrics:#}");
    run.until_vanished();
    run.left_nothing();
}

/// T-CHIP-6, T-RED-6: a supply rail of the master is low; later the bus destroys the next master's
/// frames. Each time the standby takes over, a repaired system joins, and the report names the
/// cause.
#[test]
fn faults_of_the_hardware_are_injected_and_repaired() {
    let fixture = Fixture::new();
    let mut run = long_run(&fixture);
    let mut drivers = vec![];
    for fault in ["undervoltage", "bus-off"] {
        let master = dual_master(&run);
        inject(&fixture, &run, &["fault", fault, &master]);
        until_obeyed(&run, peer(&master));
        inject(&fixture, &run, &["fault", fault, &master, "--mend"]);
        drivers.push(peer(&master));
    }
    // If the bus is repaired after the last attempt, its system stays suspended.
    run.until("a standby, or one system suspended", |processes| {
        let has = |role| processes.iter().any(|it| it.role.as_deref() == Some(role));
        (has("standby") || has("suspended")).then_some(())
    });
    let metrics = run.interrupt();
    assert_eq!(drivers_of(&metrics), drivers, "{metrics:#}");
    let report = fixture.folder().join("tandem-report/report.html");
    let report = std::fs::read_to_string(report).unwrap();
    assert!(report.contains("low rail of the supply"));
    assert!(report.contains("bus-off "));
}

/// The cuts: both directions of the heartbeat and power level lines, and the CAN of A and of B.
const WIRES: [&[&str]; 5] = [
    &["heartbeat-1"],
    &["heartbeat-2"],
    &["level"],
    &["can", "--from", "A"],
    &["can", "--from", "B"],
];
/// After this time every system has detected the cuts, and a lack of control counts as a gap.
const SETTLED: Duration = Duration::from_millis(500);
const TABLE: &str = include_str!("../../docs/redundancy.md");
/// One row of the truth table.
struct Row {
    cut: [bool; 5],
    /// Roles of A and B after both have detected the cuts.
    roles: [String; 2],
    /// The system that the vehicle obeys; `then_obeyed`: the same after a power loss of A, or B.
    obeyed: Option<String>,
    then_obeyed: [Option<String>; 2],
}

/// Returns the rows of the table in the docs. The model of the redundancy writes that table.
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

/// Returns the roles of both systems in `tandem ps`. A master without a standby is degraded.
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

/// Checks one row of the truth table with processes: A drives, then the wires of the row are cut.
/// If `off` is set, that system then loses its power.
fn holds(row: &Row, off: Option<usize>) {
    row_holds(&Fixture::new(), row, off);
}

fn row_holds(fixture: &Fixture, row: &Row, off: Option<usize>) {
    let mut run = fixture.run(&["--duration", "110", "--scenario", "free-lane"]);
    until_roles(&run, &[("A", "master"), ("B", "standby")]);
    until_obeyed(&run, "A");
    // Cut one wire after the other, B's CAN before A's. Otherwise B would take over in between.
    for (wire, _) in WIRES.iter().zip(row.cut).rev().filter(|(_, cut)| *cut) {
        inject(fixture, &run, &[&["cut"], *wire].concat());
    }
    // Wait until the systems have detected the cuts: until then, the old roles could match.
    std::thread::sleep(SETTLED);
    run.until(&format!("{:?} cut: {:?}", row.cut, row.roles), |_| {
        let shown = shown_roles(fixture, &run);
        // A system without CAN that does not drive resets itself repeatedly, and then suspends.
        let is_as_told = |system: usize| {
            let (shown, reported) = (&shown[system], &row.roles[system]);
            let resets = row.cut[3 + system] && reported == "standby" && !shown.contains("master");
            shown == reported || resets
        };
        (is_as_told(0) && is_as_told(1)).then_some(())
    });
    let mut obeyed = vec![&row.obeyed];
    if let Some(system) = off {
        inject(fixture, &run, &["power", "off", ["A", "B"][system]]);
        obeyed.push(&row.then_obeyed[system]);
    }
    match obeyed.last().copied().unwrap() {
        Some(system) => until_obeyed(&run, system),
        None => std::thread::sleep(SETTLED),
    }
    let metrics = run.interrupt();
    let mut drives = vec!["A"];
    for system in obeyed.iter().copied().flatten() {
        if !drives.ends_with(&[system]) {
            drives.push(system);
        }
    }
    let drove: Vec<_> = std::iter::once("A").chain(drivers_of(&metrics)).collect();
    assert_eq!(drove, drives, "{:?}, {off:?} off: {metrics:#}", row.cut);
    let mut gaps = metrics["gaps"].as_array().unwrap().iter();
    let is_open = gaps.any(|gap| gap["ended_by"] == "the end of the run");
    let is_none_left = obeyed.last().is_some_and(|last| last.is_none());
    assert_eq!(
        is_open, is_none_left,
        "{:?}, {off:?} off: {metrics:#}",
        row.cut
    );
}

/// T-RED-9: three rows of the truth table hold, for three different sets of cut wires.
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

/// T-RED-9: every row, first with both systems and then without one of them. `cargo nextest run -p
/// tandem --test processes --run-ignored only truth`
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
