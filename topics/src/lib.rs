//! Topics over DDS: a static participant of RTPS without allocation and without IO (no_std).
//!
//! [`Participant`] announces itself and its endpoints, finds those of others, and exchanges samples
//! with them: reliably, with a short history. The caller brings datagrams and the time, and sends
//! what [`Outlet`] gets. The types of the topics are those of `idl/tandem.idl`. D-1 to D-4
//!
//! ```
#![doc = include_str!("../examples/two_participants.rs")]
//! ```
#![no_std]
#![forbid(unsafe_code)]

mod cdr;
mod discovery;
pub mod endpoints;
mod participant;
mod qos;
mod reader;
mod types;
mod wire;
mod writer;

pub use cdr::{CdrError, TopicType};
pub use discovery::{Announced, announced};
pub use participant::{HEARTBEAT_PERIOD, Participant};
pub use qos::{Counts, Durability, Endpoint, Qos, Reliability};
pub use reader::{Sample, WRITERS};
pub use types::*;
pub use wire::{EntityId, Guid, GuidPrefix, Outlet, Parameter, Parameters, pid};
pub use writer::{READERS, WriteError};

/// The participant of a system: one writer, four readers, a history of three. D-4
pub type Controller =
    Participant<1, 4, 3, { CanFrame::PAYLOAD_LEN }, { PowerControl::PAYLOAD_LEN }>;
