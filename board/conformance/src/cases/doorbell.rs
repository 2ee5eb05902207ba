//! The doorbells: a ring wakes a core, rings are merged, and no ring is lost.

use crate::barrier::{
    PATIENCE, SETTLE, sleep, sleep_until, spin_until, wait_for_cores, woken_until, word,
};
use crate::case::{CaseFailure, check, equal};
use core::sync::atomic::Ordering;
use tandem_board::{Board, CoreAddress, CoreId, Duration, Wake};

const ROUNDS: u32 = 10;

/// Rings while the other core is awake.
pub(super) fn early_ringer<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    for round in 1..=ROUNDS {
        let ready = || word(board, 0).load(Ordering::Acquire) >= round;
        sleep_until(board, "the other core gets ready for a ring", ready)?;
        board.ring(CoreId::PERCEPTION);
        // Release pairs with Acquire in `late_waiter`: the waiter waits only after the ring.
        word(board, 1).store(round, Ordering::Release);
    }
    Ok(())
}

/// Waits only after the other core has rung.
pub(super) fn late_waiter<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    for round in 1..=ROUNDS {
        // Consume all pending interrupts, so that the next interrupt can only be the ring.
        sleep(board, Duration::from_ms(2))?;
        word(board, 0).store(round, Ordering::Release);
        let rung = || word(board, 1).load(Ordering::Acquire) >= round;
        spin_until(board, "the other core rings", rung)?;
        let wake = board.wait(board.now() + PATIENCE);
        check(wake == Wake::Interrupt, "a ring before the wait ends it")?;
    }
    sleep(board, SETTLE)
}

/// Writes a value, then rings a sleeping core.
pub(super) fn ringer<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    for round in 1..=ROUNDS {
        let ready = || word(board, 0).load(Ordering::Acquire) >= round;
        sleep_until(board, "the other core goes to sleep", ready)?;
        sleep(board, Duration::from_ms(5))?;
        // Relaxed: `ring` itself must make the value visible.
        word(board, 1).store(round, Ordering::Relaxed);
        board.ring(CoreId::PLANNING);
    }
    Ok(())
}

pub(super) fn sleeper<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    for round in 1..=ROUNDS {
        word(board, 0).store(round, Ordering::Release);
        woken_until(
            board,
            "a ring wakes, and shows what was written before",
            || word(board, 1).load(Ordering::Relaxed) >= round,
        )?;
    }
    Ok(())
}

const HASTY_ROUNDS: u32 = 1_000;

/// Writes and rings again and again without a pause.
pub(super) fn hasty_ringer<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_cores(board, &[CoreId::CONTROL, CoreId::PERCEPTION], 1)?;
    for value in 1..=HASTY_ROUNDS {
        word(board, 0).store(value, Ordering::Relaxed);
        board.ring(CoreId::PERCEPTION);
        if value % 16 == 0 {
            board.now();
        }
    }
    Ok(())
}

pub(super) fn last_value<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_cores(board, &[CoreId::CONTROL, CoreId::PERCEPTION], 1)?;
    let mut wakes = 0_u32;
    woken_until(board, "the last of many rings is not lost", || {
        wakes += 1;
        word(board, 0).load(Ordering::Relaxed) == HASTY_ROUNDS
    })?;
    check(
        wakes <= 2 * HASTY_ROUNDS,
        "rings are merged, not multiplied",
    )?;
    sleep(board, SETTLE)
}

/// T-SYNC-1: a token circulates in both directions, so every core rings every other one.
pub(super) fn relay<B: Board>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    const LAPS: u32 = 4;
    let token = word(board, 0);
    let cores = CoreId::COUNT as u32;
    let at = |turn: u32| match turn / (LAPS * cores) {
        0 => CoreId::ALL[(turn % cores) as usize],
        _ => CoreId::ALL[(cores - 1 - turn % cores) as usize],
    };
    wait_for_cores(board, &CoreId::ALL, 1)?;
    for turn in (0..2 * LAPS * cores).filter(|turn| at(*turn) == place.core) {
        woken_until(board, "each core can ring each other one", || {
            token.load(Ordering::Relaxed) == turn
        })?;
        token.store(turn + 1, Ordering::Relaxed);
        board.ring(at(turn + 1));
    }
    Ok(())
}

pub(super) fn own<B: Board>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    for _ in 0..ROUNDS {
        sleep(board, Duration::from_ms(1))?;
        board.ring(place.core);
        let wake = board.wait(board.now() + PATIENCE);
        check(wake == Wake::Interrupt, "a core can ring its own doorbell")?;
    }
    Ok(())
}

/// Rings the other cores of this system, which have never started: this must have no effect.
pub(super) fn absent<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    for _ in 0..100 {
        board.ring(CoreId::PERCEPTION);
        board.ring(CoreId::PLANNING);
    }
    let words = &board.lmu()[..16];
    let sum: u64 = words
        .iter()
        .map(|word| u64::from(word.load(Ordering::Relaxed)))
        .sum();
    equal(sum, 0_u32, "a ring to an absent core changes nothing")?;
    sleep(board, SETTLE)
}
