//! malloc and free of the C library, within one process.

use crate::floor::cas::CHUNK;
use crate::harness::{Batch, Plan, alone};
use std::hint::black_box;
use std::io;

const BYTES: usize = 64;

/// Borrowing and giving back 64 bytes.
///
/// # Errors
/// As [`alone`].
pub fn malloc_free(plan: &Plan) -> io::Result<Batch> {
    let batch = alone(
        plan,
        CHUNK,
        0,
        |_| Ok(()),
        |()| {
            // SAFETY: what malloc has given is freed once; nothing is written to it.
            unsafe { libc::free(black_box(libc::malloc(black_box(BYTES)))) };
        },
    )?;
    Ok(batch.carrying(BYTES as u64))
}
