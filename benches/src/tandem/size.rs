//! Payloads of any size in place: they lie in shared memory, and the signal's value says which one
//! is meant.
//!
//! The LMU of a controller has 32 KiB, and the pool knows no more. What is larger lies beside it,
//! on the host in a segment of its own. Each direction has two payloads, so that one can be
//! filled while the other is read.

use super::{Core, How, both};
use crate::harness::{Batch, End, Plan, between_processes};
use crate::shared::Shared;
use std::io;
use std::sync::atomic::{AtomicU32, Ordering};
use tandem_shm::wait::WaitPolicy;

const PAYLOADS: usize = 2;
/// Words in a cache line.
const LINE: usize = 16;

struct InPlace {
    core: Core,
    out: [&'static [AtomicU32]; PAYLOADS],
    inward: [&'static [AtomicU32]; PAYLOADS],
    turn: usize,
}

impl InPlace {
    fn start(core: Core, out: &'static [AtomicU32], inward: &'static [AtomicU32]) -> Self {
        let halves = |words: &'static [AtomicU32]| -> [&'static [AtomicU32]; PAYLOADS] {
            let (first, second) = words.split_at(words.len() / PAYLOADS);
            [first, second]
        };
        for (at, word) in out.iter().enumerate() {
            word.store(at as u32, Ordering::Relaxed);
        }
        Self {
            core,
            out: halves(out),
            inward: halves(inward),
            turn: 0,
        }
    }
}

impl End for InPlace {
    fn send(&mut self, stamp: u32) {
        let turn = self.turn;
        if let Some(last) = self.out[turn].last() {
            // Relaxed: the signal publishes it.
            last.store(stamp, Ordering::Relaxed);
        }
        self.core.send(turn as u32);
        self.turn = (turn + 1) % PAYLOADS;
    }

    fn receive(&mut self) -> u32 {
        let which = self.core.receive() as usize % PAYLOADS;
        let last = self.inward[which].last();
        last.map_or(0, |word| word.load(Ordering::Relaxed))
    }
}

/// One-way time of a payload of `bytes`, a multiple of 4, between cores that spin: stamped at its
/// end, signalled, and the stamp read from the payload by the handler's core.
///
/// # Errors
/// As [`between_processes`].
pub fn in_place(plan: &Plan, bytes: usize) -> io::Result<Batch> {
    let words = (bytes / 4).next_multiple_of(LINE);
    let payloads = Shared::with_case_words(2 * PAYLOADS * words)?;
    let ways = payloads.case().split_at(PAYLOADS * words);
    let [near, far] = both(plan, How::new(WaitPolicy::Spin, 2));
    let near = |shared: &Shared| InPlace::start(near(shared), ways.0, ways.1);
    let far = |shared: &Shared| InPlace::start(far(shared), ways.1, ways.0);
    Ok(between_processes(plan, 0, near, far)?
        .carrying(bytes as u64)
        .without_facts())
}
