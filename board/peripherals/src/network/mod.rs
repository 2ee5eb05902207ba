//! Connections of the systems to each other, to the vehicle and to other computers: lines, level
//! lines, link, CAN bus, Ethernet.
//!
//! [`Conditions`] lists what is cut or disturbed. [`Network`] moves frames, edges and datagrams
//! under these conditions, [`Ethernet`] moves datagrams. Each call passes the time in; the models
//! return what arrives.

pub mod conditions;
pub mod controller;
#[cfg(feature = "network")]
mod ethernet;
pub mod frame_time;
#[cfg(feature = "network")]
mod model;

pub use conditions::{BusFault, Conditions, Cuts, LINK_DATAGRAMS, Wire};
#[cfg(feature = "network")]
pub use ethernet::{Ethernet, Packet, PortFault, Station};
#[cfg(feature = "network")]
pub use model::{Arrival, Delivery, Network, Sent, WireTimes};
