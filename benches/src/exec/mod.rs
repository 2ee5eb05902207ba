//! Execution: ten processes from start to ready, restarts, and the skew of activations.

mod start;
mod supervisors;

pub(crate) use start::{ready_10, restart};
pub(crate) use supervisors::Supervisor;
