//! FreeRTOS on the control core: the unmodified kernel, two ports, a safe interface. T-RTOS-1..4
//!
//! The kernel is FreeRTOS V11 in C, compiled by the build script with the configuration in
//! `kernel/FreeRTOSConfig.h`. On Linux it runs on this crate's port, in one thread of a process; on
//! riscv32 it runs on FreeRTOS's own port. The README says how the host port works and what a task
//! may do.
//!
//! [`Kernel::take`] returns the kernel, [`Kernel::spawn`] makes tasks, [`Kernel::start`] runs them.
//! A task receives a [`TaskContext`], a handler of interrupts an [`InterruptContext`]. Blocking
//! calls need a [`TaskContext`], so a handler cannot make them.
//!
//! On the host this interface is sound under one rule that the compiler does not check. All tasks
//! run in one thread and share every thread-local (`thread_local!`), even one in a library. Tasks
//! that share one must access it within `host::deferred`, or there is a data race (see README).
#![no_std]
#![deny(unsafe_code)]

extern crate alloc;
#[cfg(target_os = "linux")]
extern crate std;

mod context;
pub mod demo;
mod ffi;
mod interrupt;
mod kernel;
mod port;
mod sys;
mod task;
mod time;

pub use context::{Context, InterruptContext, TaskContext, TaskLevel, TimerContext};
pub use interrupt::{HandlerError, Interrupt, InterruptPriority};
pub use kernel::{Kernel, KernelError};
pub use port::events::{KernelEvent, KernelEventKind, TraceSink};
#[cfg(target_os = "linux")]
pub use port::host;
pub use port::{StartError, TickSource};
pub use sys::mutex::{Mutex, MutexGuard};
pub use sys::queue::{Queue, QueueFull};
pub use sys::semaphore::{Semaphore, SemaphoreFull};
pub use sys::set::{AddError, Member, QueueSet};
pub use sys::task::{TaskError, TaskHandle, TaskStatistics};
pub use sys::timer::{CommandsFull, Timer};
pub use task::{Priority, SpawnError, TaskOptions};
pub use time::{LONGEST_SHIFT_NS, TickTime, Ticks};

/// The target: its doorbell, its fatal errors, and a reset of its hart.
#[cfg(target_arch = "riscv32")]
pub mod riscv32 {
    pub use crate::port::riscv32::{on_fatal, ring};
    pub use crate::sys::after_reset;
}

/// The time-out passed before the wait ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the time-out has passed")]
pub struct TimedOut;
