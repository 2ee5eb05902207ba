//! FreeRTOS on the control core: the real kernel, our ports, a safe interface. T-RTOS-1..4
//!
//! The kernel is FreeRTOS V11 in C, compiled by the build script with the configuration in
//! `kernel/FreeRTOSConfig.h`. On Linux it runs on the port of this crate, in one thread of a
//! process; on riscv32 on the kernel's own port. See the README for how the host port works and
//! what a task may do.
//!
//! [`Kernel::take`] gives the kernel, [`Kernel::spawn`] makes tasks, [`Kernel::start`] runs them. A
//! task is given a [`TaskContext`], a handler of interrupts an [`InterruptContext`]; what blocks
//! wants the former, so that a handler cannot call it.
//!
//! On the host this interface is sound under one rule that the compiler does not check: all tasks
//! are one thread, so a thread-local (`thread_local!`, a library's too) is shared by all of them.
//! If two touch it, they do so within `host::deferred`, or it is a data race. See the README.
#![no_std]
#![deny(unsafe_code)]

#[cfg(feature = "alloc")]
extern crate alloc;
#[cfg(target_os = "linux")]
extern crate std;

mod context;
pub mod demo;
mod event;
mod interrupt;
mod kernel;
mod notification;
mod port;
mod queue;
mod semaphore;
mod set;
mod sys;
mod task;
mod time;
mod timer;
mod trace;

pub use context::{Context, InterruptContext, TaskContext, TaskLevel, TimerContext};
pub use event::{EventGroup, EventGroupMemory, Events, EventsFull};
pub use interrupt::{AttachError, Interrupt, InterruptPriority};
pub use kernel::{Clock, Kernel, KernelError, StartError};
#[cfg(target_os = "linux")]
pub use port::host;
#[cfg(target_arch = "riscv32")]
pub use port::riscv32;
pub use queue::{Full, Queue, QueueMemory};
pub use semaphore::{Semaphore, SemaphoreFull, SemaphoreMemory};
pub use set::{AddError, Member, QueueSet, QueueSetMemory};
pub use sys::mutex::{Mutex, MutexGuard, MutexMemory};
pub use sys::task::{TaskError, TaskHandle, TaskMemory, TaskStatistics};
pub use task::{Priority, SpawnError, TaskOptions};
pub use time::Ticks;
pub use timer::{CommandsFull, Timer, TimerMemory};
pub use trace::{Event, EventKind, TraceReader, TraceRing, TraceSink};

use core::fmt;

/// The time was over before the wait was fulfilled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimedOut;

impl fmt::Display for TimedOut {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("the time was over")
    }
}

impl core::error::Error for TimedOut {}

/// The static memory has an object already.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InUse;

impl fmt::Display for InUse {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("the static memory is in use")
    }
}

impl core::error::Error for InUse {}
