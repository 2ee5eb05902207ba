//! A slice of `cargo xtask campaign faults`.

use tandem_board::{Duration, SystemId};
use tandem_redundancy::Config;
use tandem_tests::faults::{Fault, Group, Kind, Sequence, Way};

/// Runs these sequences. Fails on what is not known to be violated.
fn try_all(group: Group, numbers: impl Iterator<Item = u64>) {
    let mut bad = vec![];
    for number in numbers {
        let sequence: Sequence = group.sequence(number);
        let verdict = sequence.try_run(Config::rt());
        if verdict
            .violations
            .iter()
            .any(|it| sequence.known(*it).is_none())
        {
            bad.push(format!("{sequence}: {verdict}"));
        }
    }
    assert!(
        bad.is_empty(),
        "{} violated:\n{}",
        bad.len(),
        bad.join("\n")
    );
}

/// T-RED-4, T-RED-8, T-RED-9: single faults keep the bound of their row; in the end the vehicle
/// obeys a system that believes to be master.
#[test]
fn single_faults_keep_their_bounds() {
    let count = Group::Single.count().expect("a finite group");
    try_all(Group::Single, (0..count).step_by(19));
}

/// T-RED-9: two faults within one system never cost control for longer than the bound.
#[test]
fn two_faults_within_one_system_are_contained() {
    let count = Group::Pair.count().expect("a finite group");
    try_all(Group::Pair, (0..count).step_by(491));
}

/// T-RED-9: whatever has failed in both systems, in the end one of them drives.
#[test]
fn in_the_end_the_vehicle_obeys_a_master() {
    try_all(Group::Random, 0..200);
}

/// T-RED-6: the transmitter of the standby is dead and the vehicle pauses for longer than an open
/// circuit takes: the master hears no frame at all, and the standby only the master's. Core 0
/// counts third parties only, so neither calls the bus alive, and the master drives on.
#[test]
fn frames_of_the_other_system_do_not_make_a_bus_alive() {
    let fault = |kind, way, at_ms, lasts| Fault {
        kind,
        way,
        at: Duration::from_ms(at_ms),
        lasts,
    };
    let pause = Some(Duration::from_ms(400));
    let sequence = Sequence {
        group: Group::Random,
        number: 0,
        faults: vec![
            fault(Kind::Mute, Way::From(SystemId::B), 0, None),
            fault(Kind::VehicleSilent, Way::From(SystemId::A), 300, pause),
        ],
        from_power_on: false,
        span: Duration::from_ms(1_500),
    };
    let verdict = sequence.try_run(Config::rt());
    assert!(verdict.violations.is_empty(), "{verdict}");
    assert!(verdict.changes == 0, "{verdict}");
    assert!(verdict.gap <= Duration::from_ms(12), "{verdict}");
}
