//! The world outside the bus: plant, sensors, traffic, scenarios.
#![forbid(unsafe_code)]

pub mod geometry;
pub mod plant;
