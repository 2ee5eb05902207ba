//! Barriers, with which the roles of a case wait for each other.

use crate::case::{CaseFailure, check};
use core::sync::atomic::{AtomicU32, Ordering};
use tandem_board::{Board, CoreId, Duration, Edge, Line, Lines, Wake};

/// Time limit for everything that must happen. It is longer than any board needs, even on a busy
/// machine; it only decides how late a failure is reported.
pub(crate) const PATIENCE: Duration = Duration::from_ms(10_000);
/// First polling interval of a role that sleeps between polls.
const LOOK: Duration = Duration::from_ms(1);
/// How long to wait for an event that must *not* happen: within this time it would have happened.
pub(crate) const SETTLE: Duration = Duration::from_ms(20);
/// How many interrupts without a cause are allowed in one wait.
const SPURIOUS: u32 = 1_000;

/// Returns word `index` of the words that a case may use.
pub(crate) fn word<B: Board>(board: &B, index: usize) -> &AtomicU32 {
    &board.lmu()[FREE_WORDS + index]
}

/// The barrier uses the words of the LMU below this index.
pub(crate) const FREE_WORDS: usize = 8;

/// Sleeps in small steps until `holds` returns true. Consumes interrupts.
#[track_caller]
pub(crate) fn sleep_until<B: Board>(
    board: &B,
    what: &'static str,
    mut holds: impl FnMut() -> bool,
) -> Result<(), CaseFailure> {
    let begin = board.now();
    while !holds() {
        let now = board.now();
        let waited = now.since(begin);
        check(waited < PATIENCE, what)?;
        // The interval grows with the time already waited.
        board.wait(now + LOOK.max(Duration::from_ns(waited.as_ns() / 32)));
    }
    Ok(())
}

/// Polls until `holds` returns true, without a `wait`: interrupts stay pending.
#[track_caller]
pub(crate) fn spin_until<B: Board>(
    board: &B,
    what: &'static str,
    mut holds: impl FnMut() -> bool,
) -> Result<(), CaseFailure> {
    let limit = board.now() + PATIENCE;
    while !holds() {
        check(board.now() < limit, what)?;
        core::hint::spin_loop();
    }
    Ok(())
}

/// Sleeps until `holds` returns true. Only interrupts may end the sleep: a deadline is a failure.
#[track_caller]
pub(crate) fn woken_until<B: Board>(
    board: &B,
    what: &'static str,
    mut holds: impl FnMut() -> bool,
) -> Result<(), CaseFailure> {
    let limit = board.now() + PATIENCE;
    while !holds() {
        let interrupted = board.wait(limit) == Wake::Interrupt;
        check(interrupted && board.now() < limit, what)?;
    }
    Ok(())
}

/// Sleeps for the whole span, regardless of interrupts.
#[track_caller]
pub(crate) fn sleep<B: Board>(board: &B, span: Duration) -> Result<(), CaseFailure> {
    let end = board.now() + span;
    let mut spurious = 0;
    while board.wait(end) == Wake::Interrupt {
        spurious += 1;
        check(
            spurious < SPURIOUS,
            "a core whose interrupts are consumed sleeps",
        )?;
    }
    Ok(())
}

/// Waits until all `cores` of this system have reached `step`. Steps count from 1.
#[track_caller]
pub(crate) fn wait_for_cores<B: Board>(
    board: &B,
    cores: &[CoreId],
    step: u32,
) -> Result<(), CaseFailure> {
    let at = |core: CoreId| &board.lmu()[core.index()];
    // Release pairs with Acquire below: what a core did before a step is visible after it.
    at(board.identity().core).store(step, Ordering::Release);
    sleep_until(board, "the cores of a system meet through the LMU", || {
        cores
            .iter()
            .all(|core| at(*core).load(Ordering::Acquire) >= step)
    })
}

/// Returns edge `number`, from 0 on, of a line that starts low: rising and falling alternate.
pub(crate) const fn alternating(number: u32) -> Edge {
    if number.is_multiple_of(2) {
        Edge::Rising
    } else {
        Edge::Falling
    }
}

/// Makes core 0 of both systems wait for each other: each sends an edge on the second heartbeat
/// line, rising and falling alternately. Steps count from 1.
#[track_caller]
pub(crate) fn wait_for_peer<B: Board>(board: &B, step: u32) -> Result<(), CaseFailure> {
    const LINE: Line = Line::Heartbeat2;
    let lines = board.lines();
    lines.send(LINE, alternating(step - 1));
    sleep_until(board, "the systems meet through a heartbeat line", || {
        let rising = lines.received(LINE, Edge::Rising);
        rising.wrapping_add(lines.received(LINE, Edge::Falling)) >= step
    })
}

/// Makes `cores` of both systems wait for each other; core 0 must be one of them. Uses two steps:
/// the next step of [`wait_for_cores`] is `2 × step + 1`.
#[track_caller]
pub(crate) fn wait_for_all<B: Board>(
    board: &B,
    cores: &[CoreId],
    step: u32,
) -> Result<(), CaseFailure> {
    wait_for_cores(board, cores, 2 * step - 1)?;
    if board.identity().core == CoreId::CONTROL {
        wait_for_peer(board, step)?;
    }
    wait_for_cores(board, cores, 2 * step)
}
