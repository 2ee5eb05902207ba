//! What connects the systems to each other and to the vehicle: lines, level lines, link, CAN bus.
//!
//! [`Conditions`] says what is cut or disturbed. [`Network`] moves frames, edges and datagrams
//! under these conditions. It is told the time and returns what arrives; a board moves the bytes.

pub mod conditions;
pub mod controller;
pub mod frame_time;
#[cfg(feature = "network")]
mod model;

pub use conditions::{BusFault, Conditions, Cuts, LINK_DATAGRAMS, Wire};
#[cfg(feature = "network")]
pub use model::{Arrival, Delivery, Network, WireTimes};
