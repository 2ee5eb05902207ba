//! Execution: ten processes from start to ready, restarts, and activations: skew, overruns.

pub(crate) mod overruns;
pub(crate) mod skew;
mod supervisors;
mod ten_processes;
pub(crate) mod worker_pool;

pub(crate) use supervisors::Supervisor;
pub(crate) use ten_processes::{ready_10, restart};
