//! One model of the hardware around the cores, for every board that has to simulate it.
//!
//! A board with real hardware does not use it. The host, the simulator and the emulated board pass
//! bytes and the time to these models and carry out their decisions. A model reads no clock and
//! does no input or output; it returns its decisions.
//!
//! # Example
//!
//! ```
#![doc = include_str!("../examples/watchdog.rs")]
//! ```
#![no_std]
#![forbid(unsafe_code)]

pub mod codec;
pub mod data_flash;
pub mod memory;
pub mod network;
pub mod stamp;
pub mod supply;
pub mod watchdog;

#[cfg(feature = "network")]
extern crate alloc;
#[cfg(test)]
extern crate std;
