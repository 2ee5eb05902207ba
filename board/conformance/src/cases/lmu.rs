//! Identity, and the memory that the cores of a system share.

use crate::barrier::{FREE_WORDS, wait_for_cores, wait_for_peer, word};
use crate::case::{CaseFailure, check, equal};
use core::sync::atomic::Ordering;
use tandem_board::{Board, CoreAddress, CoreId};

const ALL: &[CoreId] = &CoreId::ALL;

pub(super) fn identity<B: Board>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    for _ in 0..2 {
        let identity = board.identity();
        check(identity.system == place.system, "a core knows its system")?;
        check(identity.core == place.core, "a core knows its number")?;
        equal(
            identity.generation.0,
            1_u32,
            "the first incarnation is generation 1",
        )?;
    }
    Ok(())
}

pub(super) fn zero<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    check(board.lmu().len() >= 1024, "the LMU has 4 KiB at least")?;
    let aligned = board.lmu().as_ptr().align_offset(64) == 0;
    check(aligned, "the LMU begins at a boundary of 64 bytes")?;
    let all_zero = board
        .lmu()
        .iter()
        .all(|word| word.load(Ordering::Relaxed) == 0);
    check(all_zero, "the LMU is zero at power-on")
}

fn pattern(index: usize, writer: usize) -> u32 {
    (index as u32 ^ (writer as u32) << 28).wrapping_mul(0x9E37_79B1) | 1
}

/// T-CHIP-1: each core in turn writes every word; the other two cores read them.
pub(super) fn shared<B: Board>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    let words = &board.lmu()[FREE_WORDS..];
    for writer in CoreId::ALL {
        let step = 2 * writer.index() as u32 + 1;
        if place.core == writer {
            for (index, word) in words.iter().enumerate() {
                word.store(pattern(index, writer.index()), Ordering::Relaxed);
            }
        }
        wait_for_cores(board, ALL, step)?;
        for (index, word) in words.iter().enumerate() {
            let seen = word.load(Ordering::Relaxed);
            equal(
                seen,
                pattern(index, writer.index()),
                "what one core writes all cores read",
            )?;
        }
        wait_for_cores(board, ALL, step + 1)?;
    }
    match place.core {
        CoreId::CONTROL => wait_for_peer(board, 1),
        _ => Ok(()),
    }
}

/// The other system runs `shared`; this system's LMU must stay zero.
pub(super) fn apart<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_peer(board, 1)?;
    let untouched = board
        .lmu()
        .iter()
        .all(|word| word.load(Ordering::Relaxed) == 0);
    check(untouched, "the systems share no memory")
}

pub(super) fn atomic<B: Board>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    const ROUNDS: u32 = 20_000;
    wait_for_cores(board, ALL, 1)?;
    for round in 0..ROUNDS {
        word(board, 0).fetch_add(1, Ordering::Relaxed);
        let bit = 1 << (place.core.index() as u32 * 8 + round % 8);
        word(board, 1).fetch_xor(bit, Ordering::Relaxed);
    }
    wait_for_cores(board, ALL, 2)?;
    let added = word(board, 0).load(Ordering::Relaxed);
    equal(added, 3 * ROUNDS, "no core's atomic addition is lost")?;
    // Each bit was flipped 2500 times, an even number.
    equal(
        word(board, 1).load(Ordering::Relaxed),
        0_u32,
        "no core's atomic flip is lost",
    )
}
