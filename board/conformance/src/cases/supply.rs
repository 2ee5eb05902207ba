//! The supply with its watchdogs and reset causes, the trace and the lamp.

use crate::barrier::{PATIENCE, sleep, wait_for_peer, woken_until};
use crate::case::{CaseFailure, check, equal, fail};
use tandem_board::{
    Board, CoreAddress, Duration, Lines, ResetCause, ResetRequest, RoleLamp, Supply,
    watchdog_answer,
};

/// Returns the time from a service to the middle of the window.
pub(super) fn middle<S: Supply>() -> Duration {
    Duration::from_us(u64::from(S::WINDOW_OPENS_US / 2 + S::WINDOW_CLOSES_US / 2))
}

pub(super) fn serve<B: Board>(board: &B) {
    board
        .supply()
        .service_watchdog(watchdog_answer(board.supply().watchdog_question()));
}

/// Every service is in the middle of the window and has the right answer: no reset follows.
pub(super) fn good_service<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    const ROUNDS: u32 = 20;
    let cause = board.supply().reset_cause();
    check(
        cause == ResetCause::PowerOn,
        "the first incarnation begins with power-on",
    )?;
    equal(
        board.identity().generation.0,
        1_u32,
        "a good service resets nothing",
    )?;
    let mut asked = 0_u32;
    for _ in 0..ROUNDS {
        let question = board.supply().watchdog_question();
        check(question <= 15, "a question is 0 to 15")?;
        asked |= 1 << question;
        serve(board);
        sleep(board, middle::<B::Supply>())?;
    }
    check(
        asked.count_ones() > 1,
        "the functional watchdog asks different questions",
    )
}

/// Every service is just after the window opens: no reset follows.
pub(super) fn as_early_as_may_be<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    const ROUNDS: u32 = 10;
    // Half a millisecond of margin for differences between the clocks.
    let opens = Duration::from_us(u64::from(B::Supply::WINDOW_OPENS_US) + 500);
    for _ in 0..ROUNDS {
        serve(board);
        sleep(board, opens)?;
    }
    equal(
        board.identity().generation.0,
        1_u32,
        "a service in the open window resets nothing",
    )
}

pub(super) fn is_first_incarnation<B: Board>(board: &B) -> bool {
    board.identity().generation.0 == 1
}

/// Services the watchdog correctly, so that any reset must have an earlier cause.
fn serve_on<B: Board>(board: &B) -> Result<(), CaseFailure> {
    for _ in 0..5 {
        sleep(board, middle::<B::Supply>())?;
        serve(board);
    }
    Ok(())
}

/// Waits for the reset that must end the first incarnation; fails if there is none.
#[track_caller]
pub(super) fn expect_reset<B: Board>(board: &B, what: &'static str) -> Result<(), CaseFailure> {
    sleep(board, PATIENCE)?;
    fail(what)
}

/// Checks that this is the second incarnation and that `cause` is its reset cause.
#[track_caller]
pub(super) fn reset_for<B: Board>(board: &B, cause: ResetCause) -> Result<(), CaseFailure> {
    equal(
        board.identity().generation.0,
        2_u32,
        "a reset begins the next generation",
    )?;
    let seen = board.supply().reset_cause();
    equal(
        seen as u32,
        cause as u32,
        "the supply tells the cause of the reset",
    )?;
    equal(
        u32::from(board.supply().starts()),
        2_u32,
        "the supply counts the starts over a reset",
    )?;
    board.supply().confirm_start();
    equal(
        u32::from(board.supply().starts()),
        0_u32,
        "a confirmed start begins the count anew",
    )
}

/// T-CHIP-6. First incarnation: gives a wrong answer. Second: checks the reset cause.
pub(super) fn wrong_answer<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    if is_first_incarnation(board) {
        serve(board);
        sleep(board, middle::<B::Supply>())?;
        let question = board.supply().watchdog_question();
        board.supply().service_watchdog(!watchdog_answer(question));
        serve_on(board)?;
        return fail("a wrong answer to the watchdog resets the system");
    }
    reset_for(board, ResetCause::Watchdog)
}

/// First incarnation: gives a right answer before the window opens.
pub(super) fn early<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    if is_first_incarnation(board) {
        check(
            B::Supply::WINDOW_OPENS_US > 0,
            "a window watchdog has a closed window",
        )?;
        serve(board);
        serve(board);
        serve_on(board)?;
        return fail("a service before the window opens resets the system");
    }
    reset_for(board, ResetCause::Watchdog)
}

/// T-CHIP-6. First incarnation: services the watchdog once only.
pub(super) fn late<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    if is_first_incarnation(board) {
        serve(board);
        return expect_reset(board, "no service in the window resets the system");
    }
    reset_for(board, ResetCause::Watchdog)
}

/// T-CHIP-6. First incarnation: never services the watchdog.
pub(super) fn never<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    if is_first_incarnation(board) {
        return expect_reset(board, "no first service resets the system");
    }
    reset_for(board, ResetCause::Watchdog)
}

/// First incarnation: makes a request. Second incarnation: checks that its reset cause is `cause`.
fn asks<B: Board>(board: &B, request: ResetRequest, cause: ResetCause) -> Result<(), CaseFailure> {
    if is_first_incarnation(board) {
        board.supply().request_reset(request);
        return expect_reset(board, "a reset that was asked for comes");
    }
    reset_for(board, cause)
}

pub(super) fn software_reset<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    asks(board, ResetRequest::Software, ResetCause::Software)
}

pub(super) fn download_reset<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    asks(board, ResetRequest::Download, ResetCause::Download)
}

/// Requests a reset because another core of its system is dead.
pub(super) fn reports_core_dead<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    asks(board, ResetRequest::CoreDead, ResetCause::Trap)
}

/// Waits until another core of its system requests a reset, which also resets this core.
pub(super) fn bystander<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    if is_first_incarnation(board) {
        return expect_reset(board, "a reset is one of all cores of the system");
    }
    equal(
        board.identity().generation.0,
        2_u32,
        "a reset begins the next generation",
    )
}

/// Requests to be held in reset, while the other system watches.
pub(super) fn suspends<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_peer(board, 1)?;
    sleep(board, Duration::from_ms(5))?;
    board.supply().request_reset(ResetRequest::Suspend);
    expect_reset(board, "a system that suspends is held in reset")
}

/// Waits for an interrupt caused by the level line of the other system.
pub(super) fn sees_low<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_peer(board, 1)?;
    let lines = board.lines();
    woken_until(board, "a fall of the level line interrupts core 0", || {
        !lines.peer_powered()
    })?;
    sleep(board, Duration::from_ms(50))?;
    check(
        !lines.peer_powered(),
        "a system that suspends stays in reset",
    )
}

/// First incarnation: requests a reset while the other system watches.
pub(super) fn reset_in_sight<B: Board>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    if is_first_incarnation(board) {
        wait_for_peer(board, 1)?;
        sleep(board, Duration::from_ms(5))?;
    }
    software_reset(board, place)
}

/// The other system is reset: its level line falls, then rises when its next incarnation begins.
pub(super) fn sees_reset<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    if !is_first_incarnation(board) {
        // After this role has ended, no role services this system's watchdog.
        return Ok(());
    }
    wait_for_peer(board, 1)?;
    let limit = board.now() + PATIENCE;
    let mut next_service = board.now();
    for high in [false, true] {
        while board.lines().peer_powered() != high {
            let now = board.now();
            check(now < limit, "the level line shows a reset and its end")?;
            if now >= next_service {
                serve(board);
                next_service = board.now() + middle::<B::Supply>();
            }
            board.wait(next_service);
        }
    }
    Ok(())
}

/// Writes more records than a trace may hold and shows every lamp: no call may block.
pub(super) fn trace_and_lamp<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    for number in 0..100_000 {
        board.trace([number, 0, 0, u32::MAX]);
    }
    for lamp in RoleLamp::ALL {
        board.supply().show_role(lamp);
    }
    Ok(())
}
