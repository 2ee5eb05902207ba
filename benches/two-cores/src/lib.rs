//! Pinned processes that share memory and a clock, for the benchmark and `tandem thesis`. This is a
//! separate crate, because the experiments of the thesis do not need the benchmark's peers.
#![allow(
    clippy::expect_used,
    clippy::missing_panics_doc,
    reason = "an end that cannot start panics; its process dies and the case is reported as failed"
)]

pub mod clock;
pub mod shared;
pub mod worker;
