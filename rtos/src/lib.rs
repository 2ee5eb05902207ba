//! FreeRTOS on the control core: the real kernel, our ports, a safe interface. T-RTOS-1..4
//!
//! The kernel is FreeRTOS V11 in C, compiled by the build script with the configuration in
//! `kernel/FreeRTOSConfig.h`. On Linux it runs on the port of this crate, in one thread of a
//! process; on riscv32 on the kernel's own port. See the README for how the host port works and what a task
//! may do.
//!
//! [`Kernel::take`] gives the kernel, [`Kernel::spawn`] makes tasks, [`Kernel::start`] runs them. A
//! task is given a [`TaskContext`], a handler of interrupts an [`InterruptContext`]; what blocks
//! wants the former, so that a handler cannot call it.
#![no_std]
#![deny(unsafe_code)]

#[cfg(feature = "alloc")]
extern crate alloc;
#[cfg(target_os = "linux")]
extern crate std;

mod context;
mod interrupt;
mod kernel;
mod notification;
mod port;
mod sys;
mod task;
mod time;
mod trace;

pub use context::{Context, InterruptContext, TaskContext};
pub use interrupt::{AttachError, Interrupt, InterruptPriority};
pub use kernel::{Clock, Kernel, KernelError, StartError};
#[cfg(target_os = "linux")]
pub use port::host;
#[cfg(target_arch = "riscv32")]
pub use port::riscv32;
pub use sys::task::{TaskError, TaskHandle, TaskMemory};
pub use task::{Priority, SpawnError, TaskOptions};
pub use time::Ticks;
