//! A sequence lock in shared memory: the least that hands over the newest of several words whole.
//!
//! After H.-J. Boehm, "Can seqlocks get along with programming language memory models?" (2012).

use crate::harness::{Batch, End, Plan, between_processes};
use crate::shared::{LINE, Shared};
use std::hint::spin_loop;
use std::io;
use std::sync::atomic::Ordering::{Acquire, Relaxed, Release};
use std::sync::atomic::{AtomicU32, fence};

/// Words of each direction: the count and the value share a cache line.
type Cell = &'static [AtomicU32];

struct Seqlock {
    out: Cell,
    inward: Cell,
    written: u32,
    seen: u32,
}

impl End for Seqlock {
    fn send(&mut self, stamp: u32) {
        let [count, value, ..] = self.out else { return };
        // Odd: the value changes. Release pairs with the fence in `receive`.
        count.store(self.written + 1, Relaxed);
        fence(Release);
        value.store(stamp, Relaxed);
        self.written = self.written.wrapping_add(2);
        // Pairs with the Acquire in `receive`.
        count.store(self.written, Release);
    }

    fn receive(&mut self) -> u32 {
        let [count, value, ..] = self.inward else {
            return 0;
        };
        loop {
            let before = count.load(Acquire);
            if before != self.seen && before.is_multiple_of(2) {
                let stamp = value.load(Relaxed);
                // Pairs with the Release fence in `send`.
                fence(Acquire);
                if count.load(Relaxed) == before {
                    self.seen = before;
                    return stamp;
                }
            }
            spin_loop();
        }
    }
}

/// 4 bytes through a sequence lock, polled.
///
/// # Errors
/// As [`between_processes`].
pub fn seqlock(plan: &Plan) -> io::Result<Batch> {
    let end = |out: usize, inward: usize| {
        move |shared: &Shared| Seqlock {
            out: &shared.case()[out * LINE..(out + 1) * LINE],
            inward: &shared.case()[inward * LINE..(inward + 1) * LINE],
            written: 0,
            seen: 0,
        }
    };
    between_processes(plan, 2 * 64, end(0, 2), end(2, 0))
}
