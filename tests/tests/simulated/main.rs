//! Tests of the whole controller in virtual time: six cores and a vehicle in one process.
#![allow(
    clippy::expect_used,
    clippy::print_stdout,
    reason = "a test may panic and print"
)]

mod ability;
mod both;
mod download;
mod faults;
mod floods;
mod forged;
mod function;
mod held_up;
mod hostile;
mod hung;
mod joins;
mod late;
mod mailboxes;
mod objects;
mod one_flow;
mod parking;
mod sections;
mod sources;
mod stale;
mod terms;
mod time;
mod topics;
mod values;
mod wrong;

use tandem_board::{CoreId, Duration, HardwareFault, Instant, RoleLamp, SystemId};
use tandem_bus::{Control, FrameTransmitter, ModeCode, RoleCode};
use tandem_cores::trace::Event;
use tandem_record::gap::both_transmitted_ms;
use tandem_record::run_log::ControlFrame;
use tandem_record::{description, takeovers};
use tandem_redundancy::{Evidence, FailureMode, Phase};
use tandem_sim::drive::Drive;

type TracedEvent = (Instant, SystemId, CoreId, Event);

const S: fn(u64) -> Duration = |seconds| Duration::from_ms(seconds * 1000);

fn print_story(drive: &Drive) {
    for (at, system, core, event) in &drive.events {
        if !description::is_routine(event) {
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

/// T-CHIP-3, T-CHIP-4, T-CHIP-7: six cores drive for a minute. Only one system transmits, and no
/// frame is late.
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
    // The bus carries no frame of the standby, not even one that the vehicle would reject.
    let seen = drive.seen.borrow();
    let chatters = |frame: &&ControlFrame| frame.system == SystemId::B;
    assert_eq!(seen.log.control.iter().find(chatters), None);
    assert_eq!(both_transmitted_ms(&seen.log), 0.0);
    // The standby still computes, as often as the master.
    let chains = |of: SystemId| {
        let of = |e: &&TracedEvent| e.1 == of && matches!(e.3, Event::Chain { .. });
        drive.events.iter().filter(of).count()
    };
    assert!(chains(SystemId::B) > 1_100 && chains(SystemId::A).abs_diff(chains(SystemId::B)) < 5);
}

/// T-RED-2: both systems begin dual operation at the same edge: their times and their first
/// control cycles after it differ by less than a heartbeat period (thesis: 572 µs).
#[test]
fn both_systems_start_in_step() {
    let mut drive = Drive::new("free-lane", 6);
    drive.run_for(S(4));
    let first = |of: SystemId, wanted: Phase| {
        let found = drive.events.iter().find_map(|(at, system, _, event)| {
            let is_it = matches!(event, Event::Phase { to, .. } if *to == wanted);
            (*system == of && is_it).then_some(*at)
        });
        found.expect("a phase")
    };
    let (a, b) = (
        first(SystemId::A, Phase::Master),
        first(SystemId::B, Phase::Standby),
    );
    let skew_us = a.as_ns().abs_diff(b.as_ns()) / 1_000;
    println!("the systems' times differ by {skew_us} us");
    assert!(skew_us < 1_000, "{skew_us} us");
    let cycle = |of: SystemId, from: Instant| {
        let found = drive.events.iter().find(|(at, system, _, event)| {
            *system == of && *at > from && matches!(event, Event::ControlCycle { .. })
        });
        found.expect("a cycle").0
    };
    let cycles = [cycle(SystemId::A, a.max(b)), cycle(SystemId::B, a.max(b))];
    let skew_us = cycles[0].as_ns().abs_diff(cycles[1].as_ns()) / 1_000;
    assert!(skew_us < 1_000, "{cycles:?}");
}

/// T-CHIP-7, T-RED-9: a second transmitter is detected although the vehicle fences its frames: a
/// standby that sends in an old term, and a forged master in a higher term.
#[test]
fn a_second_transmitter_is_found_although_the_vehicle_fences_it_off() {
    for above in [false, true] {
        let mut drive = Drive::new("free-lane", 7);
        drive.run_for(S(5));
        let term = drive.seen.borrow().log.accepted().last().map(|f| f.term);
        let term = term.expect("A drives");
        assert_eq!((drive.both_transmitted_ms(), term & 1), (0.0, 0));
        let mut transmitter = FrameTransmitter::new();
        for _ in 0..20 {
            let control = Control {
                role: RoleCode::Master,
                mode: ModeCode::L3,
                term: if above { term + 1 } else { term - 1 },
                ..Control::default()
            };
            stale::forge(&drive, &mut transmitter, control);
            drive.run_for(Duration::from_ms(10));
        }
        let both_ms = drive.both_transmitted_ms();
        drive.run_for(Duration::from_ms(300));
        let log = &drive.seen.borrow().log;
        let takeovers = takeovers(log);
        if above {
            // A receives the higher term and closes its output, although it has not failed.
            assert_eq!((both_ms, takeovers[0].to), (0.0, SystemId::B));
            assert!(
                takeovers[0].is_false && takeovers[0].cause.is_none(),
                "{takeovers:?}"
            );
        } else {
            assert!((180.0..220.0).contains(&both_ms), "{both_ms} ms");
            assert!(takeovers.is_empty(), "{takeovers:?}");
        }
        assert_eq!(log.mastership().two_masters_ns(), 0, "the fence holds");
    }
}

/// T-RED-4, T-RED-9: the master loses its supply: one takeover, a gap below 20 ms, no collision.
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

/// T-RED-8, T-RED-1: the master's processor dies and returns as standby; then the other system
/// loses its supply. Each takeover has its cause and keeps its bound, the old master is standby in
/// between, and the flash of both records what happened.
#[test]
fn a_master_that_was_reset_comes_back_and_takes_over_in_turn() {
    let mut drive = Drive::new("slow-leader", 3);
    drive.run_for(S(15));
    let before = SystemId::ALL.map(|of| drive.state_in_flash(of));
    assert_eq!(before.map(|state| state.is_master), [true, false]);
    drive.pair.kill_core(SystemId::A, CoreId::CONTROL);
    drive.run_for(S(15));
    assert_eq!(drive.pair.lamp(SystemId::A), Some(RoleLamp::Standby));
    let [a, b] = SystemId::ALL.map(|of| drive.state_in_flash(of));
    assert_eq!((a.is_master, b.is_master), (false, true));
    assert_eq!(a.abn_resets, before[0].abn_resets + 1);
    assert_eq!(a.total_resets, before[0].total_resets + 1);
    let resets = (before[1].abn_resets, before[1].total_resets);
    assert_eq!((b.abn_resets, b.total_resets), resets);
    assert!(b.term > before[0].term && !b.sys_failure && !a.sys_failure);

    drive.pair.power_off(SystemId::B);
    drive.run_for(S(20));
    print_story(&drive);
    assert_eq!(drive.masters(), [SystemId::A, SystemId::B, SystemId::A]);
    let takeovers = drive.takeovers();
    let causes: Vec<_> = takeovers.iter().map(|takeover| takeover.cause).collect();
    // A dead processor is silent before its supply resets it. A power loss is detected at once.
    assert_eq!(
        causes,
        [Some(Evidence::PeerSilent), Some(Evidence::PeerOff)]
    );
    let limits = tandem_cores::Config::rt().redundancy;
    let bounds = [
        limits.takeover_bound(),
        limits.level_limit() + limits.poll_interval,
    ];
    for (takeover, bound) in takeovers.iter().zip(bounds) {
        let detected_ms = takeover.detected_ms.expect("reported");
        assert!(detected_ms <= bound.as_ms_f64(), "{takeover:?}");
    }
    assert_eq!(drive.gaps_beyond(), []);
    assert_eq!(
        (drive.two_masters_ns(), drive.both_transmitted_ms()),
        (0, 0.0)
    );
    let a = drive.state_in_flash(SystemId::A);
    assert!(a.is_master && a.cpsys_failure && a.term > b.term);
    assert_eq!(drive.collisions(), 0);
}

/// T-CHIP-6, T-RED-6: the diagnosis register of the master's output driver reports a fault. The
/// other system drives, the master suspends itself, and its flash contains the reason. A fault in
/// only one poll has no effect.
#[test]
fn a_fault_of_the_output_driver_suspends_its_system() {
    for found in [HardwareFault::OpenLoad, HardwareFault::ShortCircuit] {
        let mut drive = Drive::new("free-lane", 8);
        drive.run_for(S(5));
        drive.pair.set_fault(SystemId::A, found, true);
        drive.run_for(Duration::from_ms(1));
        drive.pair.set_fault(SystemId::A, found, false);
        drive.run_for(S(1));
        assert_eq!(drive.masters(), [SystemId::A], "{found:?}");
        drive.pair.set_fault(SystemId::A, found, true);
        drive.run_for(S(2));
        assert_eq!(drive.masters(), [SystemId::A, SystemId::B], "{found:?}");
        let causes: Vec<_> = drive.takeovers().iter().map(|of| of.cause).collect();
        assert_eq!(causes, [Some(Evidence::MasterResigns)], "{found:?}");
        let state = drive.state_in_flash(SystemId::A);
        assert!(state.sys_failure, "{found:?}");
        assert_eq!(state.failure_mode, FailureMode::IoModule, "{found:?}");
        assert_eq!(drive.gaps_beyond(), [], "{found:?}");
        assert_eq!(drive.two_masters_ns(), 0);
    }
}

/// T-CHIP-6: the watchdog resets a frozen master, which does not drive when it thaws.
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

/// T-CHIP-3: a dead compute core is detected, its system resets, and the other system drives on.
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
