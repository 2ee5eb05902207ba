//! The board in one process, on a clock that the caller advances.
//!
//! [`SimPair`] is the machine: two systems of three cores, their LMUs, the wires between them, the
//! CAN bus, flash and supplies. It drives the cores in virtual time: nothing happens but by
//! [`SimPair::run_until`], and the same configuration gives the same run to the bit.
//!
//! A core is a [`Poller`]: called when its interrupt is pending or its deadline has come, it looks
//! at its [`SimBoard`], acts, and returns its next deadline. Code that blocks in `Board::wait`
//! becomes a poller with [`blocking`]: it runs on a thread of its own, but only ever one core runs
//! at a time, so that threads change nothing about determinism.
#![forbid(unsafe_code)]

mod baton;
mod blocking;
mod board;
mod config;
mod fabric;
mod faults;
mod flash;
mod machine;
mod pair;
mod power;
mod world;

pub use baton::CoreKilled;
pub use blocking::blocking;
pub use board::{Poller, SimBoard, SimCan, SimFlash, SimLines, SimLink, SimSupply};
pub use config::{BusFault, Clock, Config, Defect, Order};
pub use machine::{OnBus, SystemEvent, SystemEventKind};
pub use pair::SimPair;
pub use tandem_peripherals::codec::Sender;
pub use tandem_peripherals::supply::Power;
pub use tandem_peripherals::wires::Wire;
pub use world::WorldTick;
