//! The driving functions of the three cores: pure computation, given the time. T-CHIP-3

pub mod control;
pub mod degraded;
pub mod function;
mod idm;
pub mod knowledge;
pub(crate) mod math;
pub mod odometry;
pub mod parking;
pub mod perception;
pub mod planning;
pub mod road;
pub mod types;
pub(crate) mod vehicle;
