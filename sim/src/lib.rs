//! Both systems and a vehicle in virtual time, and sequences of faults applied to them.
//!
//! Core 0, its state store and the vehicle's gate are the real software. Cores 1 and 2 only count
//! cycles, or drive a vehicle ([`Around::ClosedLoop`]). Wires, bus, flash, supplies and clocks are
//! those of the simulated board.
#![forbid(unsafe_code)]
#![allow(
    clippy::expect_used,
    reason = "a simulation that cannot be set up ends with a panic"
)]

mod bench;
mod bend;
pub mod drive;
pub mod grandmaster;
mod outside;
mod sequence_judge;
pub mod time_chain;
pub mod timed;
pub mod timing;
mod trial;
mod value_judge;

pub use bench::{Around, Bench, Profile, SequenceState};
pub use outside::OutsideVehicle;
pub use sequence_judge::Found;
pub use trial::Tried;
pub use value_judge::is_finding;
