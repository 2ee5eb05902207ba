//! Tests that the simulator's judge detects when a machine, or its log, breaks a rule.

use super::*;
use crate::bench::{Around, Profile};
use std::collections::BTreeSet;
use tandem_board::{CanFrame, CanId, Channel, HardwareFault, Network as _};
use tandem_board_sim::Wire;
use tandem_bus::Message;
use tandem_faults::{Fault, Group, Kind, Way, just};
use tandem_redundancy::Config;
use tandem_vehicle::gate::Ruling;

const A: SystemId = SystemId::A;
const B: SystemId = SystemId::B;

/// Returns a bench in which both systems have been in step for a second and A drives.
fn dual(around: Around) -> Bench {
    let profile = Profile {
        around,
        ..Config::rt().into()
    };
    let mut bench = Bench::dual(profile, 1, false);
    bench.pair.run_for(Duration::from_ms(1_000));
    bench
}

/// Returns the rules that the judge finds broken in the last 800 ms, in which there was no fault.
fn broken(bench: &Bench) -> Vec<Rule> {
    let now = bench.pair.now();
    let begin = Instant::from_ns(now.as_ns() - 800_000_000);
    let bound = Some(Duration::from_ms(20));
    bench.judge(&[], [begin, now], bound).violations
}

/// Returns the rules that are broken after this change.
fn broken_by(around: Around, change: impl FnOnce(&mut Bench)) -> Vec<Rule> {
    let mut bench = dual(around);
    change(&mut bench);
    broken(&bench)
}

fn ago_ns(bench: &Bench, ms: u64) -> u64 {
    bench.pair.now().as_ns() - ms * 1_000_000
}

/// Returns a frame of the standby, in the term of the master.
fn of_standby(bench: &Bench) -> Acceptance {
    Acceptance {
        system: 1,
        ..*bench.vehicle.borrow().accepted.last().unwrap()
    }
}

#[test]
fn a_sound_machine_breaks_no_rule() {
    for around in [Around::Core0, Around::CLOSED_LOOP] {
        assert_eq!(broken_by(around, |_| ()), []);
        assert_eq!(dual(around).judge_roles(true), []);
    }
}

#[test]
fn a_pause_of_the_control_frames_is_a_gap() {
    let rules = broken_by(Around::Core0, |bench| {
        let pause = ago_ns(bench, 600)..ago_ns(bench, 560);
        let mut vehicle = bench.vehicle.borrow_mut();
        vehicle.accepted.retain(|it| !pause.contains(&it.at_ns));
    });
    assert_eq!(rules, [Rule::Gap]);
}

#[test]
fn frames_of_a_system_that_is_no_master_are_found() {
    let rules = broken_by(Around::Core0, |bench| {
        bench.vehicle.borrow_mut().chatters = true;
    });
    assert_eq!(rules, [Rule::Chatters]);
}

#[test]
fn a_record_that_no_fault_destroyed_is_missed() {
    let rules = broken_by(Around::Core0, |bench| {
        bench.pair.edit_flash(B, |bytes| bytes.fill(0xFF));
    });
    assert_eq!(rules, [Rule::StateLost]);
}

#[test]
fn a_flash_that_is_programmed_too_often_is_found() {
    let rules = broken_by(Around::Core0, |bench| {
        bench.pair.edit_flash(B, |bytes| {
            let slots = bytes[..FLASH_SECTOR_BYTES as usize].chunks_mut(SystemState::BYTES);
            let unused = slots.filter(|slot| slot.iter().all(|byte| *byte == 0xFF));
            // Write one byte of each slot: a torn record.
            unused.take(13).for_each(|slot| slot[0] = 0);
        });
    });
    assert_eq!(rules, [Rule::FlashWorn]);
}

/// Returns the control frame with a constant angle, a left curve of about 700 m radius, and without
/// braking.
fn steered_left(frame: &CanFrame) -> CanFrame {
    let frame = crate::outside::steered(frame, |_| 0.004);
    let CanId::Standard(id) = frame.id() else {
        return frame;
    };
    let mut data = frame.data().to_vec();
    let _other_frame = Message::alter(id.into(), &mut data, "Acceleration", |_| 0.0);
    CanFrame::new(frame.id(), true, &data).expect("as long as before")
}

#[test]
fn a_vehicle_that_is_steered_out_of_its_lane_is_found() {
    let rules = broken_by(Around::CLOSED_LOOP, |bench| {
        // Change the frames of both systems, so that neither can take over and correct the error.
        for system in SystemId::ALL {
            bench.pair.tamper(system, Some(steered_left));
        }
        bench.pair.run_for(Duration::from_ms(6_000));
    });
    for rule in [Rule::LeftLane, Rule::LateralError] {
        assert!(rules.contains(&rule), "{rules:?}");
    }
}

#[test]
fn a_vehicle_too_close_to_the_one_in_front_is_found() {
    let rules = broken_by(Around::CLOSED_LOOP, |bench| {
        bench.vehicle.borrow_mut().headway_s = 1.59;
    });
    assert_eq!(rules, [Rule::TooClose]);
}

#[test]
fn a_vehicle_that_obeys_no_system_is_found() {
    let rules = broken_by(Around::Core0, |bench| {
        bench.pair.cut(Wire::Can, A);
        bench.pair.cut(Wire::Can, B);
        bench.pair.run_for(Duration::from_ms(25));
    });
    assert_eq!(rules, [Rule::Gap, Rule::NoneObeyed]);
}

#[test]
fn two_suspended_systems_are_found() {
    let rules = broken_by(Around::Core0, |bench| {
        for system in SystemId::ALL {
            let fault = HardwareFault::Overvoltage;
            bench.pair.set_fault(system, fault, true);
        }
        bench.pair.run_for(Duration::from_ms(100));
    });
    assert!(rules.contains(&Rule::BothSuspended), "{rules:?}");
}

#[test]
fn a_vehicle_that_obeys_the_standby_is_found() {
    let rules = broken_by(Around::Core0, |bench| {
        let mut frame = of_standby(bench);
        frame.term += 1;
        bench.vehicle.borrow_mut().accepted.push(frame);
    });
    assert!(rules.contains(&Rule::ObeysNoMaster), "{rules:?}");
}

/// Without any wire between them, and with no bus, both systems take the role of master.
#[test]
fn two_masters_at_the_end_are_found() {
    let rules = broken_by(Around::Core0, |bench| {
        for system in SystemId::ALL {
            for wire in Wire::ALL {
                bench.pair.cut(wire, system);
            }
        }
        bench.pair.run_for(Duration::from_ms(500));
        let both = SystemId::ALL.map(|system| bench.pair.lamp(system));
        assert_eq!(both, [Some(RoleLamp::DegradedMaster); 2]);
        // The vehicle receives the frames of A again; A sends one every 10 ms.
        bench.pair.restore(Wire::Can, A);
        bench.pair.run_for(Duration::from_ms(12));
    });
    assert!(rules.contains(&Rule::TwoMasters), "{rules:?}");
}

#[test]
fn a_master_whose_frames_are_refused_at_the_end_is_found() {
    let rules = broken_by(Around::Core0, |bench| {
        let fenced = Acceptance {
            ruling: Ruling::Fenced,
            at_ns: ago_ns(bench, 50),
            ..of_standby(bench)
        };
        bench.vehicle.borrow_mut().fenced.push(fenced);
    });
    assert_eq!(rules, [Rule::Unsteady]);
}

#[test]
fn a_system_that_stays_alone_is_found() {
    let mut bench = dual(Around::Core0);
    bench.pair.power_off(B);
    assert_eq!(bench.judge_roles(true), [Rule::NoStandby]);
}

/// Without core 1 in both systems the vehicle stops, which is a finding if a system could drive.
#[test]
fn a_stop_although_a_system_may_drive_is_found() {
    for around in [Around::Core0, Around::CLOSED_LOOP] {
        let mut bench = dual(around);
        bench.vehicle.borrow_mut().poison = true;
        bench.pair.run_for(Duration::from_ms(20_000));
        assert!(!bench.judge_roles(false).contains(&Rule::Stopped));
        assert!(
            bench.judge_roles(true).contains(&Rule::Stopped),
            "{around:?}"
        );
    }
}

#[test]
fn a_panic_is_a_finding() {
    let mut sequence = Group::Single.sequence(0);
    // The simulator has no supply process, so it cannot apply this fault.
    sequence.faults[0].kind = Kind::SupplyHangs(just(1));
    let tried = Profile::from(Config::rt()).try_run(&sequence);
    assert_eq!(tried.violations, [Rule::Panic]);
}

/// The bound is that of the requirement: a product that waits longer for a mute master exceeds it.
#[test]
fn a_product_with_a_longer_control_margin_leaves_a_gap() {
    let mut sequence = Group::Single.sequence(0);
    sequence.faults[0].kind = Kind::Mute;
    sequence.faults[0].way = Way::A;
    sequence.faults[0].lasts = None;
    sequence.span = Duration::from_ms(1_000);
    let broken = |control_margin| {
        let product = Config {
            control_margin,
            ..Config::rt()
        };
        Profile::from(product).try_run(&sequence).violations
    };
    assert_eq!(broken(Config::rt().control_margin), []);
    assert!(broken(Duration::from_ms(400)).contains(&Rule::Gap));
}

/// D-1: with a cut network, a system is not heard outside, and nothing else changes while both
/// drive: no frame on the bus, no event, no rule is broken.
#[test]
fn a_cut_network_changes_nothing_on_the_bus() {
    let ms = Duration::from_ms;
    let fault = |way| Fault {
        kind: Kind::NetworkCut,
        way,
        at: ms(100),
        lasts: Some(ms(3_800)),
    };
    let drive = |cuts: &[Way]| {
        let profile = Profile::from(Config::rt());
        let mut bench = Bench::suffering(profile, &[fault(Way::Both)], 1, false);
        bench.reach_dual();
        let station = bench.pair.join_network();
        let faults: Vec<Fault> = cuts.iter().copied().map(fault).collect();
        let begin = bench.pair.now();
        bench.suffer(&faults, ms(4_000));
        let end = bench.pair.now();
        let judged = bench.judge(&faults, [begin, end], Some(ms(20)));
        assert_eq!(judged.violations, [], "{cuts:?}");
        let hears = || station.try_receive(Channel::Topics, &mut [0; 1_472]);
        let from = std::iter::from_fn(hears).map(|datagram| datagram.from);
        (bench.pair.digest(), from.collect::<BTreeSet<_>>().len())
    };
    let (sound, heard) = drive(&[]);
    assert_eq!(heard, 2);
    for (cut, hears) in [(Way::A, 1), (Way::B, 1), (Way::Both, 0)] {
        assert_eq!(drive(&[cut]), (sound, hears), "{cut:?}");
    }
}
