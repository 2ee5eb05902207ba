//! The floors of the lock: what the processor needs for the one atomic operation.

use crate::harness::{Batch, Plan, alone, give_way};
use crate::mutual_exclusion::{Exclusion, contended};
use crate::shared::Shared;
use std::hint::{black_box, spin_loop};
use std::io;
use std::sync::atomic::{AtomicU32, Ordering};

/// Operations of a sample.
pub(crate) const CHUNK: usize = 64;

/// A compare-and-swap that takes a free word and a store that gives it back: the least a lock
/// does.
///
/// # Errors
/// As [`alone`].
pub fn lock(plan: &Plan) -> io::Result<Batch> {
    alone(
        plan,
        CHUNK,
        64,
        |shared| Ok(shared.line(0)),
        |word| {
            let taken = word.compare_exchange(0, 1, Ordering::Acquire, Ordering::Relaxed);
            black_box(taken.is_ok());
            word.store(0, Ordering::Release);
        },
    )
}

/// Polls of a word that another process has, before the CPU goes to others.
const POLLS: u32 = 1000;

/// A word that is 1 while somebody is inside.
struct Word(&'static AtomicU32);

impl Exclusion for Word {
    fn inside(&mut self, stay: impl FnOnce()) {
        let mut polls = 0;
        // Acquire pairs with the Release of the process that was inside before.
        while self.0.swap(1, Ordering::Acquire) == 1 {
            while self.0.load(Ordering::Relaxed) == 1 {
                polls += 1;
                if polls % POLLS == 0 {
                    give_way();
                } else {
                    spin_loop();
                }
            }
        }
        stay();
        self.0.store(0, Ordering::Release);
    }
}

/// One word that several processes want: no turns, so the one that leaves is often the next inside.
///
/// # Errors
/// As [`contended`].
pub fn under_contention(plan: &Plan, processes: usize) -> io::Result<Batch> {
    let shared = Shared::new()?;
    contended(plan, &shared, processes, 64, |_| Word(shared.line(0)))
}
