//! Tests of campaigns and experiments as a user of the `tandem` command runs them.
#![allow(
    clippy::unwrap_used,
    reason = "a test ends where something is not as it must be"
)]

mod chaos;
mod errors;
#[path = "../processes/fixture.rs"]
#[allow(dead_code, reason = "the tests of runs use more of it")]
mod fixture;
mod json;
#[path = "../json/schema.rs"]
mod schema;

/// The program that implements these commands.
const PROGRAM: &str = env!("CARGO_BIN_EXE_tandem-lab");
