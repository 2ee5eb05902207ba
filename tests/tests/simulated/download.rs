//! A host that asks a driving controller for a bootloader. T-BOOT-1

use tandem_board::{CanFrame, CanId, Duration, ResetCause, RoleLamp, SystemId};
use tandem_board_sim::SystemEventKind;
use tandem_tests::drive::Drive;

use crate::S;

/// The connect request of `docs/boot.md`: to system 1 (A), 2 (B), or 0 (any).
fn connect(to: u8) -> CanFrame {
    let data = [0x2D, 0x57, 0x3E, 0x08, to, 0, 0, 0];
    CanFrame::new(CanId::Extended(0x0CFF_0126), false, &data).expect("a frame")
}

/// The causes of the resets of a system until now.
fn resets(drive: &Drive, of: SystemId) -> Vec<ResetCause> {
    let events = drive.pair.events().into_iter();
    let reset = events.filter_map(|event| match event.kind {
        SystemEventKind::Reset(cause) if event.system == of => Some(cause),
        _ => None,
    });
    reset.collect()
}

/// The system that drives refuses; the standby goes, for a download; no system hears a host that
/// names no system. The vehicle drives on without a gap.
#[test]
fn only_the_standby_of_a_driving_vehicle_goes_for_a_download() {
    let mut drive = Drive::new("free-lane", 1);
    drive.run_for(S(4));
    let lamp = |drive: &Drive, system| drive.pair.lamp(system);
    assert_eq!(lamp(&drive, SystemId::A), Some(RoleLamp::Master));
    assert_eq!(lamp(&drive, SystemId::B), Some(RoleLamp::Standby));
    for to in [0, 1] {
        drive.seen.borrow_mut().forged.push(connect(to));
        drive.run_for(S(1));
    }
    for system in SystemId::ALL {
        assert_eq!(resets(&drive, system), [], "{system}");
    }
    drive.seen.borrow_mut().forged.push(connect(2));
    drive.run_for(S(2));
    assert_eq!(resets(&drive, SystemId::B), [ResetCause::Download]);
    assert_eq!(resets(&drive, SystemId::A), [], "the master drives on");
    let seen = drive.seen.borrow();
    let mastership = seen.world.gate().mastership();
    let gap = Duration::from_ns(mastership.gap_max_ns(drive.pair.now().as_ns()));
    assert!(gap <= Duration::from_ms(11), "{gap:?}");
}
