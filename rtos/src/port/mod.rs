//! The differences between machines: switching, masking, interrupts, the tick.
#![allow(unsafe_code)]

pub(crate) mod events;

#[cfg(target_os = "linux")]
pub mod host;
#[cfg(target_os = "linux")]
pub(crate) use host::{
    Stack, assert_may_block, attach, deferred as without_others, epoch, fatal, idle, in_task,
    prepare, run_time, run_time_span, set_next_tick, start, tear_down, tick_times_ns, timestamp_ns,
    virtual_work,
};

#[cfg(target_arch = "riscv32")]
pub(crate) mod riscv32;
#[cfg(target_arch = "riscv32")]
pub(crate) use riscv32::{
    Stack, assert_may_block, attach, epoch, fatal, idle, in_task, prepare, run_time, run_time_span,
    set_next_tick, start, tear_down, tick_times_ns, timestamp_ns, virtual_work, without_others,
};

/// The source of the tick.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TickSource {
    /// The machine's timer: 1 kHz on absolute time.
    Wall,
    /// Virtual time, which passes only in [`burn`](crate::TaskContext::burn) and while all tasks
    /// wait. For tests that must give the same result in each run. Host only.
    #[cfg(target_os = "linux")]
    Virtual,
}

/// The scheduler cannot start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum StartError {
    /// Tasks cannot share the program's allocator: see `host::TaskAllocator`.
    #[error(
        "tasks cannot share this allocator: the program must declare \
                 `#[global_allocator] static A: tandem_rtos::host::TaskAllocator<…>`"
    )]
    Allocator,
    /// The operating system refused a timer, a signal or a stack. Holds its error number.
    #[error("the operating system refused: error {0}")]
    System(i32),
}
