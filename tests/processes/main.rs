//! Tests of the `tandem` command as a user runs it, with real processes and real kills.
//!
//! This is a test of the package `tandem`, so that cargo builds the command for it. The code is in
//! the folder of the whole-process tests.
#![allow(
    clippy::unwrap_used,
    reason = "a test ends where something is not as it must be"
)]

mod bounds;
mod deaths;
mod drive;
mod errors;
mod fixture;
mod injection;
mod json;
mod observers;
mod parking;
#[path = "../../topics/host/tests/stand_in/place.rs"]
mod place;
#[path = "../json/schema.rs"]
mod schema;
mod sealed;
mod stalls;
mod startup;
mod terminal;
mod time;
mod trace;

/// The program under test.
const PROGRAM: &str = env!("CARGO_BIN_EXE_tandem");
