//! Tests of the ability to drive: one system hears less than the other. The one that hears more
//! drives, and a standby that could not drive is reported at once.

use crate::wrong::{FAULT, MS, aside, first};
use tandem_board::{Board, CanFrame, CanId, CoreId, Instant, SystemId};
use tandem_board_sim::{Config as BoardConfig, Poller, SimBoard};
use tandem_bus::{AbilityCode, ModeCode};
use tandem_cores::Config;
use tandem_cores::trace::Event;
use tandem_redundancy::{Evidence, Phase};
use tandem_sim::drive::{Drive, poller};
use tandem_tests::bent::bent_core;

use SystemId::{A, B};

const EGO_MOTION: u16 = 0x110;
const CAMERA_LANES: u16 = 0x270;
const RADAR_FRONT: u16 = 0x200;

/// The systems that are deaf, and to which frames.
type Deaf = &'static [(SystemId, &'static [u16])];

/// Starts a drive in which each of these systems is deaf to its frames from the fault on.
fn deaf(to: Deaf) -> Drive {
    let mut drive = Drive::with("free-lane", 5, move |board: &SimBoard| -> Poller {
        let of = board.identity();
        let frames = to.iter().find(|(system, _)| *system == of.system);
        let (Some((_, frames)), true) = (frames, of.core != CoreId::PLANNING) else {
            return poller(board, Config::rt());
        };
        let offset_ns = BoardConfig::default().clocks[of.system.index()].offset_ns;
        let fault = Instant::from_ns(FAULT.as_ns() + offset_ns);
        let hears = move |now: Instant, frame: CanFrame| {
            let is_lost = |it: &u16| frame.id() == CanId::Standard(*it);
            if now >= fault && frames.iter().any(is_lost) {
                // No core listens to this identifier.
                let id = CanId::Extended(0x1234_5678);
                return CanFrame::new(id, true, frame.data()).expect("a frame");
            }
            frame
        };
        let sends = Box::new(|_, frame| vec![frame]);
        bent_core(board, Config::rt(), sends, Box::new(hears))
    });
    drive.run_for(MS(FAULT.as_ns() / 1_000_000));
    drive
}

/// Returns the modes that the vehicle obeyed since the fault.
fn modes(drive: &Drive) -> Vec<ModeCode> {
    let seen = drive.seen.borrow();
    let since = seen.log.accepted().filter(|it| it.at_ns >= FAULT.as_ns());
    let mut modes: Vec<_> = since.map(|it| it.mode).collect();
    modes.dedup();
    modes
}

/// Returns the ability in the last status frame of this system.
fn ability(drive: &Drive, of: SystemId) -> Option<AbilityCode> {
    let seen = drive.seen.borrow();
    let last = seen.log.status.iter().rfind(|it| it.system == of);
    last.map(|it| it.ability)
}

fn speed(drive: &Drive) -> f64 {
    drive.seen.borrow().world.snapshot().speed
}

/// Returns when this system entered degraded mode on `on`: ms after the fault.
fn degraded(drive: &Drive, of: SystemId, on: Evidence) -> Option<u64> {
    let enters = |event: &Event| {
        let to = Phase::DegradedMaster;
        matches!(event, Event::Phase { to: it, on: why, .. } if (*it, *why) == (to, on))
    };
    first(drive, enters).and_then(|(ms, system)| (system == of).then_some(ms))
}

/// T-RED-9: the master alone does not hear a sensor. The standby, which hears all, drives soon
/// after the loss can be known, and the vehicle drives on.
#[test]
fn a_standby_that_hears_more_than_the_master_drives() {
    const LOST: [(&str, u64, Deaf); 3] = [
        // The loss is known after 50, 300 and 300 ms, and a scene is up to 50 ms old.
        ("motion", 50, &[(A, &[EGO_MOTION])]),
        ("lanes", 350, &[(A, &[CAMERA_LANES])]),
        ("a radar", 350, &[(A, &[RADAR_FRONT, RADAR_FRONT + 1])]),
    ];
    for (name, known_ms, to) in LOST {
        let mut drive = deaf(to);
        let before = speed(&drive);
        let aside = aside(&mut drive, MS(20_000));
        let resigns = degraded(&drive, B, Evidence::MasterResigns);
        let (modes, after) = (modes(&drive), speed(&drive));
        println!(
            "{name}: B drives after {resigns:?} ms, {modes:?}, {before:.1} to {after:.1} m/s, \
             {aside:.2} m aside, gap {:?}, {:?}",
            drive.gap_max(),
            drive.masters()
        );
        assert_eq!(drive.masters(), [A, B], "{name}");
        assert!(resigns.is_some_and(|ms| ms <= known_ms + 70), "{name}");
        assert!(!modes.contains(&ModeCode::SafeStop), "{name}: {modes:?}");
        // Degraded mode drives at up to 25 m/s.
        assert!(after > 24.5, "{name}: {before} to {after} m/s");
        assert!(drive.gap_max() < MS(16), "{name}: {:?}", drive.gap_max());
        assert!(aside < 0.2, "{name}: {aside} m");
        let able = match name {
            "a radar" => AbilityCode::Lacks,
            _ => AbilityCode::StopOnly,
        };
        assert_eq!(ability(&drive, A), Some(able), "{name}");
    }
}

/// T-RED-9: the standby alone becomes blind. The master reports within a second that it has no
/// backup, and drives in degraded mode. When the master loses its power after 10 s, the standby
/// stops the vehicle.
#[test]
fn a_blind_standby_is_no_backup() {
    const BLIND: [(&str, Deaf); 3] = [
        ("motion", &[(B, &[EGO_MOTION])]),
        ("lanes", &[(B, &[CAMERA_LANES])]),
        ("both", &[(B, &[EGO_MOTION, CAMERA_LANES])]),
    ];
    for (name, to) in BLIND {
        let mut drive = deaf(to);
        drive.run_for(MS(10_000));
        let told = degraded(&drive, A, Evidence::StandbyUnable);
        let own = first(&drive, |event| matches!(event, Event::Ability { .. }));
        let modes = modes(&drive);
        println!("{name}: told after {told:?} ms, by itself {own:?}, {modes:?}");
        assert!(told.is_some_and(|ms| ms < 1_200), "{name}");
        assert!(own.is_some_and(|it| it < (600, B) && it.1 == B), "{name}");
        assert_eq!(modes, [ModeCode::L3, ModeCode::DegradedL2], "{name}");
        assert_eq!(drive.masters(), [A], "{name}");
        let able = ability(&drive, B);
        assert!(
            matches!(able, Some(AbilityCode::StopOnly | AbilityCode::None)),
            "{name}: {able:?}"
        );
        drive.pair.power_off(A);
        let aside = aside(&mut drive, MS(20_000));
        println!("{name}: then {aside:.2} m aside, {:.1} m/s", speed(&drive));
        assert_eq!(drive.masters(), [A, B], "{name}");
        assert!(speed(&drive) < 0.1, "{name}");
    }
}

/// T-RED-9: both systems lose the same sensor. No system is better, so none takes over.
#[test]
fn two_systems_that_hear_the_same_do_not_change() {
    const LOST: [&[u16]; 3] = [
        &[EGO_MOTION],
        &[CAMERA_LANES],
        &[RADAR_FRONT, RADAR_FRONT + 1],
    ];
    for frames in LOST {
        let to: &'static [(SystemId, &[u16])] = Box::leak(Box::new([(A, frames), (B, frames)]));
        let mut drive = deaf(to);
        drive.run_for(MS(5_000));
        assert_eq!(drive.masters(), [A], "{frames:X?}");
        let told = degraded(&drive, A, Evidence::StandbyUnable);
        assert_eq!(told, None, "{frames:X?}");
    }
}
