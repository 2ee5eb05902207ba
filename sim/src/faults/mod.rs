//! Faults as data, what they may cost, and the campaign that tries them on the real control core.
//!
//! Core 0, its state store and the vehicle's gate are the real ones. Cores 1 and 2 only count
//! cycles, or drive a vehicle ([`Around::ClosedLoop`]). Wires, bus, flash, supplies and clocks are
//! those of the simulator. Real processes suffer the same faults (`processes.rs` draws them,
//! `tandem chaos` injects them).

mod bench;
mod fault;
mod file;
mod judge;
mod known;
mod plan;
mod processes;
mod vehicle;

pub use bench::{Around, Bench, State};
pub use fault::{Act, BusFaults, Fault, Kind, Way};
pub use file::FileError;
pub use judge::{Row, Verdict, Violation, containment_bound, row};
pub use plan::{DISTANCES, Group, PHASES, Profile, Sequence};
pub use processes::Victim;
pub use vehicle::Vehicle;
