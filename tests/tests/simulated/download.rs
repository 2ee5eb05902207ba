//! Tests of a host that requests the bootloader from a driving controller. T-BOOT-1

use tandem_board::{CanFrame, CanId, Duration, ResetCause, RoleLamp, SystemId};
use tandem_board_sim::SystemEventKind;
use tandem_redundancy::Evidence;
use tandem_sim::drive::{Drive, poller};

const MS: fn(u64) -> Duration = Duration::from_ms;

/// Returns the connect request of `docs/boot.md` for system 1 (A), 2 (B), or 0 (any).
fn connect(to: u8) -> CanFrame {
    let data = [0x2D, 0x57, 0x3E, 0x08, to, 0, 0, 0];
    CanFrame::new(CanId::Extended(0x0CFF_0126), false, &data).expect("a frame")
}

/// Returns the causes of a system's resets so far.
fn resets(drive: &Drive, of: SystemId) -> Vec<ResetCause> {
    let events = drive.pair.events().into_iter();
    let reset = events.filter_map(|event| match event.kind {
        SystemEventKind::Reset(cause) if event.system == of => Some(cause),
        _ => None,
    });
    reset.collect()
}

/// Starts a drive whose systems resume dual operation after a reset.
fn drive() -> Drive {
    let mut config = tandem_cores::Config::rt();
    config.redundancy.reintegrate = true;
    let mut drive = Drive::with("free-lane", 1, move |board| poller(board, config));
    drive.run_for(MS(4_000));
    assert_eq!(lamps(&drive), DUAL);
    drive
}

fn lamps(drive: &Drive) -> [Option<RoleLamp>; 2] {
    SystemId::ALL.map(|system| drive.pair.lamp(system))
}

/// A drives, and B is its standby.
const DUAL: [Option<RoleLamp>; 2] = [Some(RoleLamp::Master), Some(RoleLamp::Standby)];

/// Repeats a host's request until the system resets, for at most 300 ms as in `docs/boot.md`.
fn ask(drive: &mut Drive, system: SystemId) {
    let to = system.index() as u8 + 1;
    for _ in 0..60 {
        drive.seen.borrow_mut().forged.push(connect(to));
        drive.run_for(MS(5));
        if !resets(drive, system).is_empty() {
            return;
        }
    }
}

/// T-BOOT-1, U-3: each system enters its bootloader while the other system drives: the standby at
/// once, the master after it has handed over. No control frame is lost in either case.
#[test]
fn both_systems_go_for_a_download_while_the_vehicle_drives() {
    let mut drive = drive();
    drive.seen.borrow_mut().forged.push(connect(0));
    drive.run_for(MS(1_000));
    for system in SystemId::ALL {
        assert_eq!(resets(&drive, system), [], "{system} was not named");
    }
    ask(&mut drive, SystemId::B);
    drive.run_for(MS(4_000));
    assert_eq!(resets(&drive, SystemId::B), [ResetCause::Download]);
    assert_eq!(lamps(&drive), DUAL, "B is back");

    ask(&mut drive, SystemId::A);
    drive.run_for(MS(4_000));
    assert_eq!(resets(&drive, SystemId::A), [ResetCause::Download]);
    assert_eq!(resets(&drive, SystemId::B), [ResetCause::Download]);
    let [a, b] = lamps(&drive);
    assert_eq!([b, a], DUAL, "A is the standby of B");
    let takeovers = drive.takeovers();
    let causes: Vec<_> = takeovers.iter().map(|takeover| takeover.cause).collect();
    assert_eq!(causes, [Some(Evidence::MasterResigns)]);
    assert!(takeovers[0].gap_ms <= 11.0, "{takeovers:?}");
    assert!(drive.gap_max() <= MS(11), "{:?}", drive.gap_max());
    assert_eq!(drive.two_masters_ns(), 0);
}

/// T-BOOT-1: one request makes the master hand over. It then remains the standby, and enters the
/// bootloader only after another request.
#[test]
fn a_system_that_drives_does_not_go() {
    let mut drive = drive();
    drive.seen.borrow_mut().forged.push(connect(1));
    drive.run_for(MS(4_000));
    let [a, b] = lamps(&drive);
    assert_eq!([b, a], DUAL);
    assert_eq!(resets(&drive, SystemId::A), []);
    assert!(drive.gap_max() <= MS(11), "{:?}", drive.gap_max());
}

/// T-BOOT-1: a standby does not reset while its master fails, however often a host requests it.
#[test]
fn a_standby_does_not_leave_a_master_that_fails() {
    for after_ms in [5, 8, 12] {
        let mut drive = drive();
        drive.pair.power_off(SystemId::A);
        drive.run_for(MS(after_ms));
        ask(&mut drive, SystemId::B);
        assert_eq!(resets(&drive, SystemId::B), [], "after {after_ms} ms");
        assert_eq!(drive.masters(), SystemId::ALL);
        assert!(drive.gap_max() <= MS(20), "{:?}", drive.gap_max());
    }
}
