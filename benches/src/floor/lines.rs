//! The floor of throughput: a ring whose cache lines are handed over one by one, full.
//!
//! Eight messages of 8 bytes fill a line; only then the producer says so. That is what the lines
//! themselves cost; it delays each message until its line is full, so it is no channel to use.

use crate::harness::{Batch, Plan};
use crate::shared::Shared;
use crate::stream::{Sink, Source, Stream, from_processes};
use std::io;
use std::sync::atomic::{AtomicU32, Ordering};

const LINE_WORDS: usize = 16;
const LINES: u32 = 64;
/// Messages of a line.
const PER_LINE: u32 = 8;
/// The producer's count of lines, the consumer's, and the lines.
const WORDS: usize = (2 + LINES as usize) * LINE_WORDS;

/// One end; each keeps a copy of the other's count of lines.
struct Ring {
    words: &'static [AtomicU32],
    mine: u32,
    other: u32,
}

impl Ring {
    const fn new(words: &'static [AtomicU32]) -> Self {
        Self {
            words,
            mine: 0,
            other: 0,
        }
    }

    /// The two words of message `k`.
    fn message(&self, k: u32) -> [&AtomicU32; 2] {
        let at = (2 + (k / PER_LINE % LINES) as usize) * LINE_WORDS + 2 * (k % PER_LINE) as usize;
        [&self.words[at], &self.words[at + 1]]
    }
}

impl Source for Ring {
    #[inline]
    fn send(&mut self, k: u32) -> bool {
        if k.is_multiple_of(PER_LINE) && self.mine - self.other == LINES {
            // Acquire pairs with the Release in `receive`: the line has been read.
            self.other = self.words[LINE_WORDS].load(Ordering::Acquire);
            if self.mine - self.other == LINES {
                return false;
            }
        }
        let [low, high] = self.message(k);
        low.store(k, Ordering::Relaxed);
        high.store(!k, Ordering::Relaxed);
        if k % PER_LINE == PER_LINE - 1 {
            self.mine += 1;
            // Release pairs with the Acquire in `receive`: the line is full.
            self.words[0].store(self.mine, Ordering::Release);
        }
        true
    }
}

/// The consumer, with the number of its next message.
struct Taker(Ring, u32);

impl Sink for Taker {
    #[inline]
    fn receive(&mut self) -> Option<u32> {
        let Self(ring, k) = self;
        if k.is_multiple_of(PER_LINE) && ring.mine == ring.other {
            // Acquire pairs with the Release in `send`.
            ring.other = ring.words[0].load(Ordering::Acquire);
            if ring.mine == ring.other {
                return None;
            }
        }
        let [low, high] = ring.message(*k).map(|word| word.load(Ordering::Relaxed));
        assert_eq!(low, !high);
        *k += 1;
        if k.is_multiple_of(PER_LINE) {
            ring.mine += 1;
            // Release pairs with the Acquire in `send`.
            ring.words[LINE_WORDS].store(ring.mine, Ordering::Release);
        }
        Some(low)
    }
}

/// Messages of 8 bytes by full cache lines.
///
/// # Errors
/// As [`from_processes`].
pub fn full_lines(plan: &Plan) -> io::Result<Batch> {
    let shared = Shared::with_case_words(WORDS)?;
    let words = shared.case();
    let stream = Stream {
        chunk: 4096,
        payload_bytes: 8,
        own_bytes: 4 * WORDS as u64,
    };
    from_processes::<_, _, 1>(
        plan,
        &shared,
        stream,
        |_| Ring::new(words),
        |_| Taker(Ring::new(words), 0),
    )
}
