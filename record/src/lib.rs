//! The recording of a run, and its analysis: drivers, takeovers with their causes, and roles.
//!
//! All runs use the same events: [`tandem_cores::trace::Event`] for a core, and
//! [`tandem_board::SupplyEvent`] for a supply. The vehicle adds its view of the bus and of the
//! world. A run on processes, in emulated machines or in virtual time fills the same [`RunLog`].
#![forbid(unsafe_code)]

pub mod clocks;
pub mod description;
pub mod file;
pub mod gap;
pub mod happenings;
pub mod log;
pub mod reaction;
pub mod required_limits;
pub mod roles;
pub mod run_log;
pub mod sensor_time;
pub mod slowest;
pub mod start;
pub mod takeover;
pub mod verdict;

pub use file::Entry;
pub use run_log::RunLog;
pub use takeover::{Takeover, takeovers};

/// Returns the time between two points on one clock, ms; negative if `to` is the earlier one.
#[must_use]
pub fn ms_between(from_ns: u64, to_ns: u64) -> f64 {
    (to_ns as f64 - from_ns as f64) * 1e-6
}
