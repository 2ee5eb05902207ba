//! Tests of wrong values: one core hears or sends a wrong number with valid protection. A sound
//! system drives on, and a system that is alone stops in its own lane.

use crate::wrong::{FAULT, MS, aside, drive_of, first};
use tandem_board::{Board, CanFrame, CoreId, Instant, SystemId};
use tandem_board_sim::{Config as BoardConfig, Poller, SimBoard};
use tandem_bus::{CameraLanes, EgoMotion, GateEcho, Message, ModeCode};
use tandem_cores::Config;
use tandem_cores::trace::Event;
use tandem_sim::drive::{Drive, poller};
use tandem_tests::bent::{OnHear, OnSend, altered, bent_core};

use SystemId::{A, B};

/// The lane is 3.5 m and the vehicle 1.8 m wide: a side is 0.1 m off the lane at this offset, m.
const OFF_LANE: f64 = 0.95;

/// Alters a received message.
type Alter = fn(&mut Message);

fn lanes(message: &mut Message, alter: impl Fn(&mut CameraLanes)) {
    if let Message::CameraLanes(lanes) = message {
        alter(lanes);
    }
}

fn ego(message: &mut Message, alter: impl Fn(&mut EgoMotion)) {
    if let Message::EgoMotion(motion) = message {
        alter(motion);
    }
}

fn echo(message: &mut Message, alter: impl Fn(&mut GateEcho)) {
    if let Message::GateEcho(echo) = message {
        alter(echo);
    }
}

/// The fault's time on the clock of this system.
fn fault_of(system: SystemId) -> Instant {
    Instant::from_ns(FAULT.as_ns() + BoardConfig::default().clocks[system.index()].offset_ns)
}

/// Starts a drive in which one core hears altered messages from the fault on.
fn hears(of: SystemId, core: CoreId, alter: Alter) -> Drive {
    let fault = fault_of(of);
    let hears = move |now, frame| match now >= fault {
        true => altered(frame, alter),
        false => frame,
    };
    let bend = move || -> (OnSend, OnHear) { (Box::new(|_, frame| vec![frame]), Box::new(hears)) };
    drive_of((of, core), bend)
}

/// Returns when a system found its scene or its motion wrong: ms after the fault.
fn found(drive: &Drive) -> Option<(u64, SystemId)> {
    first(drive, |event| matches!(event, Event::WrongScene { .. }))
}

const LANES: [(&str, Alter); 5] = [
    ("heading +0.05", |it| lanes(it, |it| it.c1 += 0.05)),
    ("heading +0.2", |it| lanes(it, |it| it.c1 += 0.2)),
    ("signs turned", |it| {
        lanes(it, |it| {
            (it.c0, it.c1) = (-it.c0 - 0.3, -it.c1 - 0.01);
            (it.c2, it.c3) = (-it.c2, -it.c3);
        });
    }),
    ("curvature +0.02", |it| lanes(it, |it| it.c2 += 0.01)),
    ("offset +0.3", |it| lanes(it, |it| it.c0 += 0.3)),
];

/// Starts a drive in which core 1 of A hears a wrong heading of the lane.
pub(crate) fn wrong_scene() -> Drive {
    hears(A, CoreId::PERCEPTION, LANES[0].1)
}

/// T-RED-9: core 1 of one system hears wrong lanes. This system finds it and leaves, and the other
/// one drives undisturbed.
#[test]
fn wrong_lanes_of_one_system_do_not_steer() {
    for of in [B, A] {
        for (name, alter) in LANES {
            let mut drive = hears(of, CoreId::PERCEPTION, alter);
            let aside = aside(&mut drive, MS(20_000));
            let (found, gap) = (found(&drive), drive.gap_max());
            let masters = drive.masters();
            println!("{of} {name}: {aside:.2} m aside, {found:?}, {masters:?}, gap {gap:?}");
            assert!(found.is_some_and(|(ms, by)| ms < 700 && by == of), "{name}");
            let resets = drive.state_in_flash(of).total_resets;
            println!("{resets} starts");
            assert!((2..=4).contains(&resets), "{of} {name}: {resets} starts");
            assert!(aside < 0.2, "{of} {name}: {aside} m");
            assert!(gap < MS(20), "{of} {name}: {gap:?}");
            let last = drive.seen.borrow().log.control.last().map(|it| it.mode);
            assert!(last != Some(ModeCode::SafeStop), "{of} {name}: {last:?}");
            let driving = if of == A { vec![A, B] } else { vec![A] };
            assert_eq!(masters[..driving.len()], driving, "{of} {name}");
        }
    }
}

/// T-RED-9: all cores of one system hear the same wrong lane or speed, so nothing within it is a
/// contradiction. Its scene has jumped against the other's: it leaves, and the other drives.
#[test]
fn what_all_cores_of_one_system_hear_wrongly_does_not_steer() {
    let faults: [(&str, Alter); 5] = [
        ("offset +1.0", |it| lanes(it, |it| it.c0 += 1.0)),
        ("offset +0.3", |it| lanes(it, |it| it.c0 += 0.3)),
        ("heading +0.05", LANES[0].1),
        ("signs turned", LANES[2].1),
        ("speed x 0.4", |it| ego(it, |it| it.speed *= 0.4)),
    ];
    for of in [B, A] {
        for (name, alter) in faults {
            let mut drive = hears_everywhere(of, alter);
            let aside = aside(&mut drive, MS(20_000));
            let by = first(&drive, |event| {
                matches!(event, Event::PeerScene { own: true, .. })
            });
            let (gap, masters) = (drive.gap_max(), drive.masters());
            let speed = drive.seen.borrow().world.snapshot().speed;
            println!(
                "{of} {name}: {aside:.2} m aside, {by:?}, {masters:?}, gap {gap:?}, {speed:.1} m/s"
            );
            assert!(
                by.is_some_and(|(ms, by)| ms < 700 && by == of),
                "{of} {name}"
            );
            assert!(aside < 0.3, "{of} {name}: {aside} m");
            assert!(gap < MS(20), "{of} {name}: {gap:?}");
            assert!(speed > 20.0, "{of} {name}: {speed} m/s");
            assert_eq!(
                masters.last(),
                Some(if of == A { &B } else { &A }),
                "{of} {name}"
            );
            assert_eq!(drive.collisions(), 0);
        }
    }
}

/// Starts a drive in which cores 0 and 1 of this system hear altered messages from the fault on.
fn hears_everywhere(of: SystemId, alter: Alter) -> Drive {
    let fault = fault_of(of);
    let mut drive = Drive::with("free-lane", 5, move |board: &SimBoard| -> Poller {
        if board.identity().system == of && board.identity().core != CoreId::PLANNING {
            let hears = move |now: Instant, frame: CanFrame| match now >= fault {
                true => altered(frame, alter),
                false => frame,
            };
            let on_send = Box::new(|_, frame| vec![frame]);
            bent_core(board, Config::rt(), on_send, Box::new(hears))
        } else {
            poller(board, Config::rt())
        }
    });
    drive.run_for(MS(FAULT.as_ns() / 1_000_000));
    drive
}

/// Faults of a system that is alone: the core that hears wrongly, and what it hears.
const ALONE: [(&str, CoreId, Alter); 6] = [
    ("speed x 0.4", CoreId::CONTROL, |it| {
        ego(it, |it| it.speed *= 0.4)
    }),
    ("slip +0.05", CoreId::CONTROL, |it| {
        ego(it, |it| it.slip_angle += 0.05)
    }),
    ("speed x 0.4", CoreId::PERCEPTION, |it| {
        ego(it, |it| it.speed *= 0.4)
    }),
    ("offset +0.3", CoreId::PERCEPTION, |it| {
        lanes(it, |it| it.c0 += 0.3)
    }),
    ("heading +0.2", CoreId::PERCEPTION, |it| {
        lanes(it, |it| it.c1 += 0.2)
    }),
    ("heading +0.2", CoreId::CONTROL, |it| {
        lanes(it, |it| it.c1 += 0.2)
    }),
];

/// T-RED-9: a system that is alone finds wrong values within a second, and stops in its lane.
#[test]
fn a_system_that_is_alone_finds_wrong_values_and_stops_in_its_lane() {
    for (name, core, alter) in ALONE {
        let fault = fault_of(A);
        let mut drive = Drive::with("free-lane", 5, move |board: &SimBoard| -> Poller {
            if (board.identity().system, board.identity().core) != (A, core) {
                return poller(board, Config::rt());
            }
            let hears = move |now: Instant, frame: CanFrame| match now >= fault {
                true => altered(frame, alter),
                false => frame,
            };
            let on_send = Box::new(|_, frame| vec![frame]);
            bent_core(board, Config::rt(), on_send, Box::new(hears))
        });
        drive.run_for(MS(8_000));
        drive.pair.power_off(B);
        drive.run_for(MS(4_000));
        let aside = aside(&mut drive, MS(15_000));
        let found = found(&drive);
        let speed = drive.seen.borrow().world.snapshot().speed;
        println!("{core} {name}: {aside:.2} m aside, {found:?}, {speed:.1} m/s");
        assert!(found.is_some_and(|(ms, _)| ms < 1_000), "{core} {name}");
        assert!(aside < OFF_LANE, "{core} {name}: {aside} m");
        assert!(speed < 0.1, "{core} {name}: {speed} m/s");
    }
}

/// T-RED-9: the vehicle's echo is wrong by 0.01 rad for a time, at both systems. The measured
/// steering angle shows it: no system leaves, and no frame is missing.
#[test]
fn a_wrong_echo_costs_nothing() {
    for ms in [100, 1_000] {
        let mut drive = Drive::with("free-lane", 5, move |board: &SimBoard| -> Poller {
            if board.identity().core != CoreId::CONTROL {
                return poller(board, Config::rt());
            }
            let fault = fault_of(board.identity().system);
            let hears =
                move |now: Instant, frame: CanFrame| match now >= fault && now < fault + MS(ms) {
                    true => altered(frame, |it| echo(it, |it| it.steering_angle += 0.01)),
                    false => frame,
                };
            let on_send = Box::new(|_, frame| vec![frame]);
            bent_core(board, Config::rt(), on_send, Box::new(hears))
        });
        drive.run_for(MS(FAULT.as_ns() / 1_000_000));
        let aside = aside(&mut drive, MS(6_000));
        let found = first(&drive, |event| matches!(event, Event::WrongEcho));
        println!(
            "{ms} ms: {aside:.2} m aside, {found:?}, {:?}",
            drive.gap_max()
        );
        assert!(found.is_some(), "{ms} ms");
        assert_eq!(drive.masters(), [A], "{ms} ms");
        assert!(drive.gap_max() < MS(16), "{ms} ms: {:?}", drive.gap_max());
        assert!(aside < 0.5, "{ms} ms: {aside} m");
    }
}

/// T-RED-9: the standby hears an echo that is wrong by 0.05 rad when the master loses power. It
/// resumes from the measured angle.
#[test]
fn a_takeover_does_not_resume_from_a_wrong_echo() {
    let mut drive = hears(B, CoreId::CONTROL, |it| {
        echo(it, |it| it.steering_angle += 0.05);
    });
    drive.run_for(MS(300));
    drive.pair.power_off(A);
    let angle = |drive: &Drive| drive.seen.borrow().world.snapshot().steering_angle;
    let before = angle(&drive);
    let turns = (0..30).map(|_| {
        drive.run_for(MS(10));
        (angle(&drive) - before).abs()
    });
    let turn = turns.fold(0.0, f64::max);
    let aside = aside(&mut drive, MS(3_000));
    let gap = drive.gap_max();
    println!("turns by {turn:.4} rad at the takeover, {aside:.2} m aside, gap {gap:?}");
    assert_eq!(drive.masters(), [A, B]);
    assert!(turn < 0.005, "{turn} rad");
    // The gate refuses a command that jumps.
    assert!(gap < MS(20), "{gap:?}");
    assert!(aside < 0.2, "{aside} m");
}
