//! The clock, and the deadline of `wait`.

use crate::barrier::{SETTLE, spin_until, wait_for_cores, word};
use crate::case::{CaseFailure, check};
use core::sync::atomic::Ordering;
use tandem_board::{Board, CoreAddress, CoreId, Duration, Instant, Wake};

pub(super) fn monotonic<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    let mut last = board.now();
    let first = last;
    for _ in 0..500 {
        let now = board.now();
        check(now >= last, "the clock never goes back")?;
        last = now;
    }
    board.wait(last + SETTLE);
    check(board.now() > first, "the clock advances")
}

pub(super) fn deadline<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    for span_us in [0, 1, 100, 1_000, 5_000, 20_000] {
        for _ in 0..3 {
            let end = board.now() + Duration::from_us(span_us);
            let mut interrupts = 0;
            while board.wait(end) == Wake::Interrupt {
                interrupts += 1;
                check(interrupts < 1_000, "a core without interrupts sleeps")?;
            }
            check(board.now() >= end, "wait does not end before its deadline")?;
        }
    }
    Ok(())
}

pub(super) fn past_deadline<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    for end in [Instant::ORIGIN, board.now()] {
        let mut interrupts = 0;
        while board.wait(end) == Wake::Interrupt {
            interrupts += 1;
            check(
                interrupts < 1_000,
                "a wait for the past ends with the deadline",
            )?;
        }
    }
    Ok(())
}

/// Two cores send each other the time in turn; a received time must not be in the future.
pub(super) fn shared<B: Board>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_cores(board, &[CoreId::CONTROL, CoreId::PERCEPTION], 1)?;
    let own_turn = place.core.index() as u32;
    for turn in 0..20 {
        if turn % 2 == own_turn {
            for (index, half) in board.now().to_words().into_iter().enumerate() {
                word(board, 1 + index).store(half, Ordering::Relaxed);
            }
            // Release pairs with Acquire below: a core that sees the turn sees the time.
            word(board, 0).store(turn + 1, Ordering::Release);
        } else {
            let turn_passed = || word(board, 0).load(Ordering::Acquire) > turn;
            spin_until(board, "the other core passes its time on", turn_passed)?;
            let then = [1, 2].map(|index| word(board, index).load(Ordering::Relaxed));
            let now = board.now();
            check(
                now >= Instant::from_words(then),
                "the cores of a system share one clock",
            )?;
        }
    }
    Ok(())
}
