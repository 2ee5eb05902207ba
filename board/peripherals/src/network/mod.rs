//! Connections of the systems to each other and to the vehicle: lines, level lines, link, CAN bus.
//!
//! [`Conditions`] lists what is cut or disturbed. [`Network`] moves frames, edges and datagrams
//! under these conditions. Each call passes the time in; `Network` returns what arrives.

pub mod conditions;
pub mod controller;
pub mod frame_time;
#[cfg(feature = "network")]
mod model;

pub use conditions::{BusFault, Conditions, Cuts, LINK_DATAGRAMS, Wire};
#[cfg(feature = "network")]
pub use model::{Arrival, Delivery, Network, WireTimes};
