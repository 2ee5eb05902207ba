//! CAN frames of the vehicle: the DBC's signals and their end-to-end protection (no_std).
//!
//! `dbc/tandem.dbc` is the single source of every frame; `cargo xtask dbc` generates the enums, the
//! structs and [`Message`] (one frame with its values) from it. [`FrameTransmitter`] adds and
//! [`FrameReceiver`] checks the end-to-end protection of [`e2e`]; [`candump`] writes logs.
//!
//! ```
//! use tandem_bus::{Control, FrameReceiver, FrameTransmitter, Message};
//!
//! let control = Control { term: 2, steering_angle: 0.01, ..Control::default() };
//! let message = Message::Control { system: 0, control };
//! let frame = FrameTransmitter::new().encode(&message);
//! assert_eq!(FrameReceiver::new().receive(u32::from(frame.id), frame.data()), Ok(message));
//! ```
#![no_std]
#![forbid(unsafe_code)]

pub mod candump;
mod dbc;
pub mod e2e;
mod endpoint;
mod frame_codec;
mod freshness;
#[cfg(feature = "embedded-can")]
mod hal;
mod sensor;
mod signal;

/// Text of `dbc/tandem.dbc`, for hosts that show what the code does not need: units and words.
pub const DBC: &str = include_str!("../dbc/tandem.dbc");

pub use dbc::*;
pub use endpoint::{FrameReceiver, FrameTransmitter, ReceiveError};
pub use frame_codec::Encoded;
pub use signal::{FrameError, FrameInfo};
