//! Measurements: floors, peers, and what Tandem adds, by one harness in one run.
//!
//! Two ends pass 4 bytes to and fro (see [`harness`]); the [`cases`] differ only in how.
#![allow(
    clippy::expect_used,
    clippy::missing_panics_doc,
    reason = "an end that cannot start panics; its process dies and the case is reported as failed"
)]

pub mod cases;
mod columns;
pub mod command;
pub mod compare;
pub mod floor;
pub mod harness;
pub mod load;
pub mod machine;
pub mod measure;
pub mod mutual_exclusion;
pub mod noise;
pub mod open_loop;
pub mod page;
pub mod peers;
mod prose;
pub mod provider;
pub mod result;
pub mod rtos;
pub mod stream;
#[cfg(test)]
mod synthetic;
pub mod system_calls;
pub mod table;
pub mod tandem;

pub use tandem_two_cores::{clock, shared, worker};
