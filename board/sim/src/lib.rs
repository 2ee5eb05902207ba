//! The board in one process, on a clock that the caller advances.
//!
//! [`SimPair`] is the machine: two systems of three cores, their LMUs, the wires between them, the
//! CAN bus, flash and supplies. It runs the cores in virtual time, which advances only in
//! [`SimPair::run_until`]. Two runs with the same configuration are identical, bit for bit.
//!
//! A core is a [`Poller`]: called when its interrupt is pending or its deadline has passed, it
//! reads its [`SimBoard`], acts, and returns its next deadline. [`blocking`] turns code that blocks
//! in `Board::wait` into a poller: each such core has its own thread, but only one core runs at a
//! time, so threads do not affect determinism.
#![forbid(unsafe_code)]

mod baton;
mod blocking;
mod board;
mod config;
mod digest;
mod event;
mod fabric;
mod faults;
mod flash_medium;
mod machine;
mod network;
mod outbox;
mod pair;
mod power;
mod world;

pub use baton::CoreKilled;
pub use blocking::blocking;
pub use board::{Poller, SimBoard, SimLink, SimNetwork, SimPort};
pub use config::{Clock, Config, Filter, Order, Tamper};
pub use event::{OnBus, SystemEvent, SystemEventKind};
pub use network::SimStation;
pub use pair::SimPair;
pub use tandem_peripherals::codec::Sender;
pub use tandem_peripherals::network::frame_time::{BitRates, Bits};
pub use tandem_peripherals::network::{BusFault, PortFault, Wire, WireTimes};
pub use tandem_peripherals::supply::Power;
pub use world::WorldTick;
