//! Control frames that arrive late, from a system that no longer drives, or many at once.

use tandem_board::{CanFrame, CanId, CoreId, Duration, SystemId};
use tandem_bus::{Control, FrameTransmitter, Message, ModeCode, RoleCode};
use tandem_redundancy::Term;
use tandem_sim::drive::Drive;

const MS: fn(u64) -> Duration = Duration::from_ms;

fn control(frame: &CanFrame, of: SystemId) -> Option<Control> {
    let CanId::Standard(id) = frame.id() else {
        return None;
    };
    match Message::decode(id.into(), frame.data()) {
        Ok(Message::Control { system, control }) if usize::from(system) == of.index() => {
            Some(control)
        }
        _ => None,
    }
}

/// Returns the control frames that this system has sent since the last call.
fn sent_by(drive: &mut Drive, system: SystemId) -> Vec<Control> {
    let log = drive.pair.take_bus_log();
    log.iter()
        .filter_map(|on_bus| control(&on_bus.frame, system))
        .collect()
}

pub(crate) fn forge(drive: &Drive, transmitter: &mut FrameTransmitter, control: Control) {
    // The lowest bit of a term is the system.
    let system = (control.term & 1) as u8;
    let message = Message::Control { system, control };
    let encoded = transmitter.encode(&message);
    let frame = CanFrame::new(CanId::Standard(encoded.id), true, encoded.data());
    let frame = frame.expect("a frame of the DBC");
    drive.seen.borrow_mut().forged.push(frame);
}

/// T-RED-9: a master that thaws after a takeover may still send its last frame. The vehicle
/// rejects that frame, and the new master does not continue from it.
#[test]
fn a_stale_control_frame_does_not_jerk_the_new_master() {
    let mut drive = Drive::new("free-lane", 6);
    drive.run_for(MS(10_000));
    let stale = *sent_in(&mut drive, SystemId::A).last().expect("A drives");
    drive.pair.power_off(SystemId::A);
    drive.run_for(MS(2_000));
    assert_eq!(drive.masters(), [SystemId::A, SystemId::B]);
    let mut transmitter = FrameTransmitter::new();
    let mut steering = vec![];
    for _ in 0..20 {
        forge(
            &drive,
            &mut transmitter,
            Control {
                steering_angle: 0.3,
                acceleration: -6.0,
                ..stale
            },
        );
        steering.extend(sent_in(&mut drive, SystemId::B));
    }
    assert!(steering.len() >= 19, "B drives on");
    let most = steering
        .iter()
        .map(|control| control.steering_angle.abs())
        .fold(0.0, f32::max);
    assert!(most < 0.05, "steers by {most} rad on a straight road");
}

/// Returns the control frames that this system sends within 10 ms.
fn sent_in(drive: &mut Drive, system: SystemId) -> Vec<Control> {
    drive.pair.take_bus_log();
    drive.pair.run_for(MS(10));
    sent_by(drive, system)
}

/// T-RED-1: core 0 of B is frozen while frames with 16 rising terms arrive. After it thaws, its
/// flash holds the last of these terms, or a higher one.
#[test]
fn of_many_frames_at_once_the_last_word_reaches_the_flash() {
    let mut drive = Drive::new("free-lane", 7);
    drive.run_for(MS(10_000));
    let first = *sent_in(&mut drive, SystemId::A).last().expect("A drives");
    let mut term = Term::from_bits(first.term);
    let mut transmitter = FrameTransmitter::new();
    drive.pair.freeze_core(SystemId::B, CoreId::CONTROL, MS(12));
    for _ in 0..16 {
        term = term.above(1, SystemId::A).expect("terms are left");
        let control = Control {
            role: RoleCode::Master,
            mode: ModeCode::L3,
            term: term.bits(),
            ..first
        };
        forge(&drive, &mut transmitter, control);
    }
    // Long enough for the write. A answers with a term above the last one, which B hears as well.
    drive.run_for(MS(15));
    assert!(drive.state_in_flash(SystemId::B).term >= term);
}
