//! Start protocol, heartbeat, roles and faults of a dual system: sans-IO (no_std).
//!
//! [`Redundancy`] gets the time and the inputs, and returns [`Actions`]; it reads no clock and
//! accesses no board. [`StateStore`] keeps the [`SystemState`] in data flash over power loss; it
//! returns the operation to start and accesses no flash. `docs/redundancy.md` has tables, bounds
//! and reasons.
//!
//! One cycle of core 0:
//!
//! 1. pass every received control frame, status frame and link report to [`Redundancy::on`];
//! 2. take a [`LineSnapshot`] of the lines and pass it as [`Input::Poll`];
//! 3. carry out each [`Action`]; call again no later than [`Actions::deadline`];
//! 4. call [`Redundancy::may_transmit`] right before each control frame.
//!
//! # Example
//!
//! ```
#![doc = include_str!("../examples/failover.rs")]
//! ```
#![no_std]
#![forbid(unsafe_code)]

#[cfg(test)]
extern crate std;

mod ability;
mod action;
mod config;
mod driving;
mod input;
mod machine;
mod phase;
mod report;
mod standby;
mod start_checks;
mod starting;
mod state;
mod store;
mod term;
mod timing_profile;
mod transition;
mod witness;

/// The crate whose times, lines and ids this one's interface uses.
pub use tandem_board;

pub use ability::Ability;
pub use action::{Action, Actions, ClockOwner, RedundancyEvent, Takeover};
pub use config::Config;
pub use input::{ControlHeader, Input, LineSnapshot, ObeyedTerm};
pub use machine::Redundancy;
pub use phase::{Evidence, Mode, Phase, Role};
pub use report::{LinkReport, PeerReport};
pub use state::{FailureMode, StateDecodeError, SystemState};
pub use store::{FlashOp, Geometry, Loaded, StateStore};
pub use term::Term;
pub use timing_profile::Budget;
