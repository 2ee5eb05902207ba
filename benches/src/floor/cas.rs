//! The floors of lock and pool: what the processor needs for the one atomic operation.

use crate::harness::{Batch, Plan, alone};
use std::hint::black_box;
use std::io;
use std::sync::atomic::Ordering;

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
