//! Faults of the hardware: each has an effect that portable code sees, until it is repaired.

use super::can::send_stamped;
use super::supply::{is_first_incarnation, middle, reset_for, serve};
use crate::barrier::{
    PATIENCE, SETTLE, sleep, sleep_until, wait_for_cores, wait_for_peer, woken_until,
};
use crate::case::{CaseFailure, check, equal, fail};
use tandem_board::{
    Can, CanErrors, CanFrame, CanId, CanState, CoreAddress, CoreId, Duration, FaultSource,
    HardwareFault, Lines, OutputDiagnosis, ResetCause, SystemId,
};

const HERE: &[CoreId] = &[CoreId::CONTROL, CoreId::PERCEPTION];

/// Returns the name of the case that fails if a fault has no effect on a board.
#[must_use]
pub const fn case_of(fault: HardwareFault) -> &'static str {
    match fault {
        HardwareFault::OpenLoad | HardwareFault::ShortCircuit => "fault-outputs",
        HardwareFault::CanTransmit => "fault-can-transmit",
        HardwareFault::CanReceive => "fault-can-receive",
        HardwareFault::ErrorPin => "fault-error-pin",
        HardwareFault::Undervoltage => "fault-undervoltage",
        HardwareFault::Overvoltage => "fault-overvoltage",
        HardwareFault::Network => "fault-network",
    }
}

/// T-CHIP-6: the diagnosis register shows the fault of the output driver.
pub(super) fn outputs<B: FaultSource>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    let finds = |expected, what| sleep_until(board, what, || board.output_diagnosis() == expected);
    for (fault, found) in [
        (HardwareFault::OpenLoad, OutputDiagnosis::OpenLoad),
        (HardwareFault::ShortCircuit, OutputDiagnosis::ShortCircuit),
    ] {
        finds(OutputDiagnosis::Good, "a whole output driver finds nothing")?;
        board.set_fault(place.system, fault, true);
        finds(found, "the output driver finds the fault")?;
        board.set_fault(place.system, fault, false);
    }
    finds(OutputDiagnosis::Good, "a repaired fault has no effect")
}

fn frame(number: u8) -> Result<CanFrame, CaseFailure> {
    let frame = CanFrame::new(CanId::Standard(0x123), true, &[number]);
    frame.map_or_else(|_| fail("this is a frame"), Ok)
}

#[track_caller]
fn send<B: FaultSource>(board: &B, number: u8) -> Result<(), CaseFailure> {
    let frame = frame(number)?;
    sleep_until(board, "the transmit buffer empties", || {
        board.can().try_send(&frame).is_ok()
    })
}

#[track_caller]
fn receive<B: FaultSource>(board: &B, number: u8) -> Result<(), CaseFailure> {
    let mut received = None;
    sleep_until(board, "a frame comes", || {
        received = board.can().try_receive();
        received.is_some()
    })?;
    let expected = frame(number)?;
    check(
        received.is_some_and(|received| received.frame == expected),
        "the frame is the next one",
    )
}

/// Number of the last frame. The bus carries frames 1 to `LAST` after the repair: 128 sent frames
/// return any error-passive controller to error-active.
const LAST: u8 = 129;

/// The bus destroys the second frame of this core: its controller becomes bus-off, recovers and
/// becomes error-passive again. Then the fault is repaired.
pub(super) fn cannot_send<B: FaultSource>(
    board: &B,
    place: CoreAddress,
) -> Result<(), CaseFailure> {
    let errors = || board.can().errors();
    wait_for_cores(board, HERE, 1)?;
    send(board, 0)?;
    wait_for_cores(board, HERE, 2)?;
    check(errors() == CanErrors::default(), "a good bus has no errors")?;
    board.set_fault(place.system, HardwareFault::CanTransmit, true);
    send(board, 1)?;
    sleep_until(board, "destroyed frames make error-passive", || {
        errors().state() == CanState::ErrorPassive
    })?;
    sleep_until(board, "destroyed frames make bus-off", || {
        errors().state() == CanState::BusOff
    })?;
    check(errors().bus_offs > 0, "a bus-off is counted")?;
    wait_for_cores(board, HERE, 3)?;
    // The other core checks that it has received no frame.
    wait_for_cores(board, HERE, 4)?;
    sleep_until(board, "a recovered controller counts errors again", || {
        errors().state() == CanState::ErrorPassive
    })?;
    board.set_fault(place.system, HardwareFault::CanTransmit, false);
    for number in 2..=LAST {
        send(board, number)?;
    }
    wait_for_cores(board, HERE, 5)?;
    sleep_until(board, "sent frames make error-active", || {
        errors().state() == CanState::ErrorActive
    })
}

/// Receives the frames of the other core, and none while the bus destroys them.
pub(super) fn hears_after_repair<B: FaultSource>(
    board: &B,
    _: CoreAddress,
) -> Result<(), CaseFailure> {
    wait_for_cores(board, HERE, 1)?;
    receive(board, 0)?;
    wait_for_cores(board, HERE, 2)?;
    wait_for_cores(board, HERE, 3)?;
    check(
        board.can().try_receive().is_none(),
        "a frame that is destroyed does not come",
    )?;
    wait_for_cores(board, HERE, 4)?;
    for number in 1..=LAST {
        receive(board, number)?;
    }
    wait_for_cores(board, HERE, 5)
}

/// S-4: a stamped frame that the bus destroys has no stamp before it is on the bus, and none if it
/// was discarded, whatever is sent later.
pub(super) fn stamps_late<B: FaultSource>(
    board: &B,
    place: CoreAddress,
) -> Result<(), CaseFailure> {
    let breaks = |present| {
        board.set_fault(place.system, HardwareFault::CanTransmit, present);
        sleep(board, SETTLE)
    };
    let unstamped = |what| {
        sleep(board, SETTLE)?;
        check(board.can().stamp().is_none(), what)
    };
    wait_for_cores(board, HERE, 1)?;
    for number in [0, 1] {
        breaks(true)?;
        send_stamped(board, &frame(number)?)?;
        unstamped("a frame that waits has no stamp")?;
        if number == 1 {
            board.can().discard_unsent();
        }
        breaks(false)?;
        if number == 0 {
            let stamp = || board.can().stamp().is_some();
            sleep_until(board, "a frame is stamped", stamp)?;
        }
    }
    send(board, 2)?;
    wait_for_cores(board, HERE, 2)?;
    unstamped("a frame that was discarded has no stamp")
}

/// Receives what the bus carries in the end.
pub(super) fn hears_stamped<B: FaultSource>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_cores(board, HERE, 1)?;
    for number in [0, 2] {
        receive(board, number)?;
    }
    wait_for_cores(board, HERE, 2)
}

/// More frames than a receiver needs to become error-passive.
const UNHEARD: u8 = 200;

pub(super) fn sends_on<B: FaultSource>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_cores(board, HERE, 1)?;
    board.set_fault(place.system, HardwareFault::CanReceive, true);
    sleep(board, SETTLE)?;
    for number in 0..UNHEARD {
        send(board, number)?;
    }
    // After this step the other core has counted an error for each frame.
    wait_for_cores(board, HERE, 2)?;
    board.set_fault(place.system, HardwareFault::CanReceive, false);
    sleep(board, SETTLE)?;
    send(board, UNHEARD)?;
    wait_for_cores(board, HERE, 3)
}

pub(super) fn cannot_receive<B: FaultSource>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    let state = || board.can().errors().state();
    wait_for_cores(board, HERE, 1)?;
    sleep_until(board, "each frame with an error counts", || {
        board.can().errors().receive == UNHEARD
    })?;
    let passive = state() == CanState::ErrorPassive;
    check(passive, "frames with errors make error-passive")?;
    wait_for_cores(board, HERE, 2)?;
    receive(board, UNHEARD)?;
    sleep_until(board, "a good frame makes error-active", || {
        state() == CanState::ErrorActive
    })?;
    wait_for_cores(board, HERE, 3)
}

/// First incarnation: runs without a fault until its supply resets it. Second incarnation: checks
/// that the reset cause is `cause`.
fn is_reset<B: FaultSource>(board: &B, cause: ResetCause) -> Result<(), CaseFailure> {
    if !is_first_incarnation(board) {
        return reset_for(board, cause);
    }
    wait_for_peer(board, 1)?;
    let limit = board.now() + PATIENCE;
    while board.now() < limit {
        serve(board);
        sleep(board, middle::<B::Supply>())?;
    }
    fail("the supply resets the system")
}

/// Injects the fault into system A, and repairs it while A is in reset.
fn makes<B: FaultSource>(board: &B, fault: HardwareFault) -> Result<(), CaseFailure> {
    if !is_first_incarnation(board) {
        // After this role has ended, no role services this system's watchdog.
        return Ok(());
    }
    wait_for_peer(board, 1)?;
    let powered = || board.lines().peer_powered();
    let until = |what, holds: &dyn Fn() -> bool| {
        let limit = board.now() + PATIENCE;
        while !holds() {
            check(board.now() < limit, what)?;
            serve(board);
            sleep(board, middle::<B::Supply>())?;
        }
        Ok(())
    };
    board.set_fault(SystemId::A, fault, true);
    until("the level line falls", &|| !powered())?;
    // Longer than any board holds a reset.
    let over = board.now() + Duration::from_ms(100);
    until("time passes", &|| board.now() >= over)?;
    check(!powered(), "the fault holds the system in reset")?;
    board.set_fault(SystemId::A, fault, false);
    until("the system starts when the fault is repaired", &powered)
}

/// T-CHIP-6
pub(super) fn error_pin<B: FaultSource>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    match place.system {
        SystemId::A => is_reset(board, ResetCause::ErrorPin),
        SystemId::B => makes(board, HardwareFault::ErrorPin),
    }
}

/// T-CHIP-6
pub(super) fn undervoltage<B: FaultSource>(
    board: &B,
    place: CoreAddress,
) -> Result<(), CaseFailure> {
    match place.system {
        SystemId::A => is_reset(board, ResetCause::Undervoltage),
        SystemId::B => makes(board, HardwareFault::Undervoltage),
    }
}

/// T-CHIP-6: overvoltage suspends a system until the next power-on.
pub(super) fn overvoltage<B: FaultSource>(
    board: &B,
    place: CoreAddress,
) -> Result<(), CaseFailure> {
    equal(board.identity().generation.0, 1_u32, "nothing starts again")?;
    wait_for_peer(board, 1)?;
    if place.system == SystemId::A {
        sleep(board, PATIENCE)?;
        return fail("too much voltage switches a system off");
    }
    let lines = board.lines();
    board.set_fault(SystemId::A, HardwareFault::Overvoltage, true);
    woken_until(board, "the level line falls", || !lines.peer_powered())?;
    board.set_fault(SystemId::A, HardwareFault::Overvoltage, false);
    sleep(board, Duration::from_ms(100))?;
    check(!lines.peer_powered(), "the system stays off")
}
