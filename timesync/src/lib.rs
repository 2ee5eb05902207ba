//! One time for the whole vehicle: sans-IO parts that tell a system, from the messages of another
//! clock, which global time its local clock shows.
//!
//! A protocol (gPTP, a pulse with a transfer, CAN) turns messages and their stamps into a
//! [`Sample`]: at this local time it was that global time. A time base turns samples into a time
//! that never goes back, with a status and an estimate of its error. All arithmetic is in integers.
//!
//! # Example
//!
//! ```
#![doc = include_str!("../examples/two_clocks.rs")]
//! ```
#![no_std]
#![forbid(unsafe_code)]

#[cfg(test)]
extern crate std;

mod base;
mod can_time;
mod continuity;
pub mod gptp;
mod pulse;
mod scale;
mod servo;

pub use base::{
    BaseConfig, CONVERSION_WORDS, Conversion, Heard, MasterQuality, TimeBase, TimeReader,
    TimeReading, TimeStatus,
};
pub use can_time::{
    CanTime, CanTimeCrc, CanTimeFrame, CanTimeMaster, CanTimeRefusal, CanTimeSlave,
};
pub use pulse::{PULSE_WORDS, Pulse, PulseMaster, PulseRefusal, PulseSlave, PulseTransfer};
pub use scale::{Arbitrary, GlobalTime, Sample, Scale, Tai, Utc};
pub use servo::ServoConfig;
