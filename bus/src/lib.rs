//! CAN frames of the vehicle: the DBC's signals and their end-to-end protection (no_std).
//!
//! `dbc/tandem.dbc` is the single source of every frame; the build script makes the structs of
//! [`dbc`] from it. [`Message`] is one frame with its values, [`Transmitter`] and [`Receiver`] add
//! and check the end-to-end protection of [`e2e`], [`candump`] writes logs.
//!
//! ```
//! use tandem_bus::{Control, Message, Receiver, Transmitter};
//!
//! let control = Control { term: 2, steering_angle: 0.01, ..Control::default() };
//! let message = Message::Control { system: 0, control };
//! let frame = Transmitter::new().encode(&message);
//! assert_eq!(Receiver::new().receive(u32::from(frame.id), frame.data()), Ok(message));
//! ```
#![no_std]
#![forbid(unsafe_code)]

pub mod candump;
pub mod dbc;
pub mod e2e;
mod endpoint;
mod message;
mod sensor;
mod signal;

pub use dbc::{
    Agreement, CameraLanes, Class, Control, DriverRequest, EgoMotion, FRAMES, GateEcho, Mode, Role,
    Route, SensorHeader, SensorObject, Status,
};
pub use endpoint::{ReceiveError, Receiver, Transmitter};
pub use message::{Encoded, Message};
pub use sensor::SensorId;
pub use signal::{DecodeError, FrameInfo};
