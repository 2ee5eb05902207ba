//! Both systems and a vehicle in virtual time.
#![forbid(unsafe_code)]
#![allow(
    clippy::expect_used,
    reason = "a simulation that cannot be set up ends with a panic"
)]

pub mod drive;
pub mod faults;
pub mod timed;
pub mod timing;
