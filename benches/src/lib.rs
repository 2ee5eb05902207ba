//! Measurements: floors, peers, and what Tandem adds, by one harness in one run.
//!
//! Two ends pass 4 bytes to and fro (see [`harness`]); the [`cases`] differ only in the mechanism.
#![allow(
    clippy::expect_used,
    clippy::missing_panics_doc,
    reason = "an end that cannot start panics; its process dies and the case is reported as failed"
)]

pub mod cases;
mod columns;
pub mod command;
mod compare;
mod exec;
mod floor;
mod hardware;
pub mod harness;
mod load;
mod measure;
mod modes;
pub mod mutual_exclusion;
mod noise;
mod open_loop;
mod page;
mod payload;
mod peers;
mod provider;
mod result;
mod rtos;
mod stream;
#[cfg(test)]
mod synthetic;
pub mod system_calls;
mod table;
mod tandem;
mod topics;

pub use tandem_two_cores::{clock, shared, worker};
