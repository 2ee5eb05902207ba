//! What the processes of a run on the host do: the cores of both systems, and the vehicle with the
//! recording. The command that starts them and reports on them is `tandem`.
#![forbid(unsafe_code)]

use std::alloc::System;

use tandem_rtos::host::TaskAllocator;

pub mod boot;
pub mod control_core;
pub mod core_process;
pub mod files;
mod forging;
pub mod live;
pub mod observed;
pub mod open_bus;
pub mod percentiles;
pub mod recorder;
pub mod run_config;
pub mod three_frames;
pub mod update;
pub mod vehicle;
pub mod world_record;

/// The tasks of a core share its thread, and therefore also its allocator.
#[global_allocator]
static ALLOCATOR: TaskAllocator<System> = TaskAllocator::new(System);
