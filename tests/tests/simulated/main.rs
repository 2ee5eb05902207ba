//! Whole-controller tests in virtual time: both systems, six cores, one vehicle, no process.
#![allow(
    clippy::expect_used,
    clippy::print_stdout,
    reason = "a test may panic and print"
)]

mod download;
mod faults;
mod floods;
mod function;
mod held_up;
mod hung;
mod joins;
mod stale;
mod terms;
mod wrong;

use tandem_board::{CoreId, Duration, SystemId};
use tandem_cores::trace::Event;
use tandem_tests::drive::Drive;

const S: fn(u64) -> Duration = |seconds| Duration::from_ms(seconds * 1000);

fn print_story(drive: &Drive) {
    for (at, system, core, event) in &drive.events {
        let routine = matches!(event, Event::ControlCycle { .. } | Event::Chain { .. });
        if !routine {
            println!(
                "{:9.3} ms {system}{core} {event:?}",
                at.as_ns() as f64 / 1e6
            );
        }
    }
    for system in SystemId::ALL {
        let of = |kind: fn(&Event) -> bool| {
            drive
                .events
                .iter()
                .filter(|(_, s, _, e)| *s == system && kind(e))
                .count()
        };
        let chains = of(|event| matches!(event, Event::Chain { .. }));
        let cycles = of(|event| matches!(event, Event::ControlCycle { .. }));
        println!("{system}: {chains} chains, {cycles} control cycles");
    }
    let seen = drive.seen.borrow();
    println!("{:?}", seen.world.metrics());
    println!("{:?} gap max {:?}", drive.masters(), drive.gap_max());
}

/// T-CHIP-3, T-CHIP-4, T-CHIP-7: six cores drive a minute; one system transmits, and no frame is
/// late.
#[test]
fn both_systems_drive_and_only_the_master_transmits() {
    let mut drive = Drive::new("cut-in", 1);
    drive.run_for(S(60));
    print_story(&drive);
    assert_eq!(drive.collisions(), 0);
    assert_eq!(drive.masters(), [SystemId::A]);
    assert!(drive.seen.borrow().log.accepted().count() > 5900);
    assert!(drive.gap_max() <= Duration::from_ms(11));
    assert!(drive.takeovers().is_empty());
}

/// T-RED-4, T-RED-9: the master loses its supply; one takeover, a gap below 20 ms, no collision.
#[test]
fn the_standby_takes_over_when_the_master_loses_its_supply() {
    let mut drive = Drive::new("cut-in", 2);
    drive.run_for(S(20));
    drive.pair.power_off(SystemId::A);
    drive.run_for(S(40));
    print_story(&drive);
    assert_eq!(drive.takeovers().len(), 1);
    assert_eq!(drive.masters(), [SystemId::A, SystemId::B]);
    assert!(drive.gap_max() < Duration::from_ms(20));
    assert_eq!(drive.two_masters_ns(), 0);
    assert_eq!(drive.collisions(), 0);
}

/// T-RED-8: the master's processor dies and comes back as standby; then the other loses its supply.
#[test]
fn a_master_that_was_reset_comes_back_and_takes_over_in_turn() {
    let mut drive = Drive::new("slow-leader", 3);
    drive.run_for(S(15));
    drive.pair.kill_core(SystemId::A, CoreId::CONTROL);
    drive.run_for(S(15));
    drive.pair.power_off(SystemId::B);
    drive.run_for(S(20));
    print_story(&drive);
    assert_eq!(drive.masters(), [SystemId::A, SystemId::B, SystemId::A]);
    assert_eq!(drive.takeovers().len(), 2);
    assert!(drive.gap_max() < Duration::from_ms(20));
    assert_eq!(drive.collisions(), 0);
}

/// T-CHIP-6: a frozen master is reset by its watchdog, and thawing makes no second master.
#[test]
fn a_frozen_master_is_no_second_master_when_it_thaws() {
    let mut drive = Drive::new("free-lane", 4);
    drive.run_for(S(10));
    drive.pair.freeze(SystemId::A, Duration::from_ms(400));
    drive.run_for(S(10));
    print_story(&drive);
    assert_eq!(drive.masters(), [SystemId::A, SystemId::B]);
    assert_eq!(drive.two_masters_ns(), 0);
    assert!(drive.gap_max() < Duration::from_ms(25));
}

/// T-CHIP-3: a compute core that dies is noticed, its system resets, the other drives on.
#[test]
fn a_dead_compute_core_costs_the_mastership_and_not_the_drive() {
    for core in [CoreId::PERCEPTION, CoreId::PLANNING] {
        let mut drive = Drive::new("free-lane", 5);
        drive.run_for(S(10));
        drive.pair.kill_core(SystemId::A, core);
        drive.run_for(S(10));
        print_story(&drive);
        assert_eq!(drive.masters(), [SystemId::A, SystemId::B], "core {core}");
        assert!(drive.gap_max() < Duration::from_ms(20));
        assert_eq!(drive.collisions(), 0);
    }
}
