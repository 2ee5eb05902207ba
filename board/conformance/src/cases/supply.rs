//! The supply with its watchdogs and reset causes, the trace and the lamp.

use crate::case::{Failure, Place, check, equal, fail};
use crate::meet::{PATIENCE, sleep};
use tandem_board::{Board, Duration, ResetCause, RoleLamp, Supply, watchdog_answer};

/// The middle of the window, counted from a service.
fn middle<S: Supply>() -> Duration {
    Duration::from_us(u64::from(S::WINDOW_OPENS_US / 2 + S::WINDOW_CLOSES_US / 2))
}

fn serve<B: Board>(board: &B) {
    board
        .supply()
        .service_watchdog(watchdog_answer(board.supply().watchdog_question()));
}

/// Every service comes in the middle of the window with the right answer: no reset.
pub(super) fn good_service<B: Board>(board: &B, _: Place) -> Result<(), Failure> {
    const ROUNDS: u32 = 20;
    let cause = board.supply().reset_cause();
    check(
        cause == ResetCause::PowerOn,
        "the first life begins with power-on",
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

/// First life: a wrong answer. Second life: that was the cause.
pub(super) fn wrong_answer<B: Board>(board: &B, _: Place) -> Result<(), Failure> {
    if board.identity().generation.0 == 1 {
        serve(board);
        sleep(board, middle::<B::Supply>())?;
        let question = board.supply().watchdog_question();
        board.supply().service_watchdog(!watchdog_answer(question));
        sleep(board, PATIENCE)?;
        return fail("a wrong answer to the watchdog resets the system");
    }
    reset_for(board, ResetCause::Watchdog)
}

/// This is the second life, and began for this cause.
#[track_caller]
fn reset_for<B: Board>(board: &B, cause: ResetCause) -> Result<(), Failure> {
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
    )
}

/// More records than a trace may hold, and every lamp: neither blocks.
pub(super) fn trace_and_lamp<B: Board>(board: &B, _: Place) -> Result<(), Failure> {
    for number in 0..100_000 {
        board.trace([number, 0, 0, u32::MAX]);
    }
    for lamp in [
        RoleLamp::Starting,
        RoleLamp::Master,
        RoleLamp::DegradedMaster,
        RoleLamp::Standby,
        RoleLamp::Suspended,
    ] {
        board.supply().show_role(lamp);
    }
    Ok(())
}
