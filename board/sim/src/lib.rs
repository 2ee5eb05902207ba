//! The board in one process, on a clock that the caller advances.
//!
//! [`SimPair`] is the machine: two systems of three cores, their LMUs, the wires between them, the
//! CAN bus, flash and supplies. It runs the cores in virtual time, which advances only in
//! [`SimPair::run_until`]. The same configuration gives the same run to the bit.
//!
//! A core is a [`Poller`]: called when its interrupt is pending or its deadline has passed, it
//! reads its [`SimBoard`], acts, and returns its next deadline. [`blocking`] makes a poller from
//! code that blocks in `Board::wait`: each such core has its own thread, but only one core runs at
//! a time, so that threads do not affect determinism.
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
mod outbox;
mod pair;
mod power;
mod world;

pub use baton::CoreKilled;
pub use blocking::blocking;
pub use board::{Poller, SimBoard, SimCan, SimFlash, SimLines, SimLink, SimSupply};
pub use config::{Clock, Config, Order, Tamper};
pub use event::{OnBus, SystemEvent, SystemEventKind};
pub use pair::SimPair;
pub use tandem_peripherals::codec::Sender;
pub use tandem_peripherals::network::frame_time::{BitRates, Bits};
pub use tandem_peripherals::network::{BusFault, Wire, WireTimes};
pub use tandem_peripherals::supply::Power;
pub use world::WorldTick;
