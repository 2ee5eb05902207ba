//! What a deterministic client uses on the host: a worker pool, and the sync over shared memory.
#![forbid(unsafe_code)]

pub mod pool;
pub mod sync;
