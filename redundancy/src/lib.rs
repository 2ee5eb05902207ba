//! Start protocol, heartbeat, roles and faults of a dual system: sans-IO (no_std).
//!
//! [`Redundancy`] is told the time and what was seen, and answers with [`Actions`]; it reads no
//! clock and touches no board. [`StateStore`] keeps the [`SystemState`] in data flash over power
//! loss. Tables, bounds and reasons stand in `docs/redundancy.md`.
//!
//! One cycle of core 0:
//!
//! 1. hand every control frame, status frame and link report that has come to [`Redundancy::on`];
//! 2. take a [`Snapshot`] of the lines and hand it over as [`Input::Poll`];
//! 3. do what the [`Actions`] say; call again no later than [`Actions::deadline`];
//! 4. ask [`Redundancy::may_transmit`] right before each control frame.
#![no_std]
#![forbid(unsafe_code)]

#[cfg(test)]
extern crate std;

mod boot;
mod can_watch;
mod config;
mod heartbeat;
mod io;
mod machine;
mod report;
mod roles;
mod start;
mod state;
mod store;
mod term;

pub use config::Config;
pub use heartbeat::{Beat, BeatReceiver, BeatSender, LineChange};
pub use io::{Actions, ControlFrame, Event, Events, Input, Snapshot, Takeover};
pub use machine::Redundancy;
pub use report::PeerReport;
pub use roles::{Evidence, Mode, Phase, Role, next};
pub use state::{DecodeError, FailureMode, SystemState};
pub use store::{FlashOp, Geometry, Loaded, StateStore};
pub use term::Term;
