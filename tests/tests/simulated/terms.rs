//! Tests of the vehicle's echo: from the echo, a system learns the terms that it has missed.

use tandem_board::{CanFrame, CanId, Duration, SystemId};
use tandem_bus::{Control, FrameTransmitter, Message, RoleCode};
use tandem_sim::drive::Drive;
use tandem_vehicle::gate::Acceptance;

const fn ms(ms: u64) -> Duration {
    Duration::from_ms(ms)
}

/// Longer than a system needs to start alone.
const START: Duration = ms(6_000);

/// Returns the last control frame that the vehicle accepted, if it is at most two periods old.
pub(crate) fn obeyed(drive: &Drive) -> Option<Acceptance> {
    let seen = drive.seen.borrow();
    let last = seen.world.gate().accepted()?;
    let age = drive.pair.now().as_ns().saturating_sub(last.at_ns);
    (age <= ms(20).as_ns()).then_some(last)
}

fn obeys(drive: &Drive, system: SystemId) -> bool {
    obeyed(drive).is_some_and(|last| usize::from(last.system) == system.index())
}

/// T-RED-9: the vehicle stays on while B and A start alone in turns. The vehicle obeys A although
/// A was off during the masterships of B.
#[test]
fn a_system_that_was_off_learns_the_term_from_the_vehicle() {
    let mut drive = Drive::new("free-lane", 3);
    drive.run_for(START);
    assert!(obeys(&drive, SystemId::A));
    for alone in [SystemId::B, SystemId::A, SystemId::B, SystemId::A] {
        drive.pair.power_off(SystemId::A);
        drive.pair.power_off(SystemId::B);
        drive.run_for(ms(200));
        drive.pair.power_on(alone);
        drive.run_for(START);
        assert!(obeys(&drive, alone), "{alone} alone: {:?}", obeyed(&drive));
    }
    let fenced = drive.seen.borrow().world.gate().counts().fenced;
    assert_eq!(fenced, 0, "no system drives into the fence");
}

/// T-RED-9: a system sends control frames in a new term and dies. The vehicle refuses the first one
/// for its counter, and still obeys the other system, which drives on in its term. The second one
/// acts, so the vehicle rejects the other system, which learns the term and drives on above it.
#[test]
fn one_frame_of_a_dying_system_does_not_lock_the_other_out() {
    let mut drive = Drive::new("free-lane", 4);
    drive.run_for(START);
    drive.pair.power_off(SystemId::A);
    drive.run_for(ms(1_000));
    let before = obeyed(&drive).expect("B drives");
    assert!(obeys(&drive, SystemId::B));

    let control = Control {
        role: RoleCode::Master,
        term: before.term + 41,
        ..Control::default()
    };
    let mut sender = FrameTransmitter::new();
    for acts in [false, true] {
        let frame = sender.encode(&Message::Control { system: 0, control });
        let id = CanId::Standard(frame.id);
        let frame = CanFrame::new(id, true, frame.data()).expect("of the DBC");
        drive.seen.borrow_mut().forged.push(frame);
        drive.run_for(ms(100));
        let after = obeyed(&drive).expect("a system drives");
        assert!(obeys(&drive, SystemId::B), "{after:?}");
        assert_eq!(after.term > control.term, acts, "{after:?}");
    }
}
