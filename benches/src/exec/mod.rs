//! Execution: ten processes from start to ready, restarts, and the skew of activations.

pub(crate) mod pool;
pub(crate) mod skew;
mod start;
mod supervisors;

pub(crate) use start::{ready_10, restart};
pub(crate) use supervisors::Supervisor;
