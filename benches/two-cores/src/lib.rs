//! Pinned processes that share memory and a clock, and two experiments of the thesis with them.
//!
//! Apart from the benchmark, so that `tandem` needs none of its peers to run the experiments.
#![allow(
    clippy::expect_used,
    clippy::missing_panics_doc,
    reason = "an end that cannot start panics; its process dies and the case is reported as failed"
)]

pub mod clock;
pub mod shared;
pub mod thesis;
pub mod worker;
