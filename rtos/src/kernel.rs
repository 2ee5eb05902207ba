//! The kernel as a value: taken once, filled with tasks, started.

use crate::TaskContext;
use crate::context::{self, InterruptContext};
use crate::interrupt::{AttachError, Interrupt, InterruptPriority};
use crate::port;
use crate::sys;
use crate::sys::task::TaskHandle;
use crate::sys::trace::TraceSink;
use crate::task::{SpawnError, TaskOptions};
use alloc::boxed::Box;
use core::fmt;
use core::marker::PhantomData;
use core::sync::atomic::{AtomicBool, Ordering};

static TAKEN: AtomicBool = AtomicBool::new(false);

/// What drives the tick.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Clock {
    /// The machine's timer: 1 kHz on absolute time.
    Wall,
    /// Work: time passes only in [`TaskContext::burn`] and while all tasks wait. For tests that
    /// must give the same result each time. Host only.
    #[cfg(target_os = "linux")]
    Virtual,
}

/// The one kernel of this process or core.
#[derive(Debug)]
pub struct Kernel {
    /// All kernel calls are made by the thread that starts it, until its tasks run.
    _of_one_thread: PhantomData<*mut ()>,
}

/// The kernel cannot be had.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum KernelError {
    /// It is taken already; it can be taken again when the scheduler has stopped.
    Taken,
}

impl fmt::Display for KernelError {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Taken => out.write_str("the kernel is in use already"),
        }
    }
}

impl core::error::Error for KernelError {}

/// The scheduler cannot start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StartError {
    /// The program's allocator is not one that tasks can share: see `host::TaskAllocator`.
    Allocator,
    /// The operating system refused a timer, a signal or a stack; its error number.
    System(i32),
}

impl fmt::Display for StartError {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Allocator => out.write_str(
                "tasks cannot share this allocator: the program must declare \
                 `#[global_allocator] static A: tandem_rtos::host::TaskAllocator<…>`",
            ),
            Self::System(errno) => write!(out, "the operating system refused: error {errno}"),
        }
    }
}

impl core::error::Error for StartError {}

impl Kernel {
    /// Takes the kernel.
    ///
    /// # Errors
    /// [`KernelError::Taken`]
    pub fn take() -> Result<Self, KernelError> {
        // Acquire pairs with the Release in `drop`: a kernel that was used on another thread is
        // idle.
        if TAKEN.swap(true, Ordering::Acquire) {
            return Err(KernelError::Taken);
        }
        port::prepare();
        Ok(Self {
            _of_one_thread: PhantomData,
        })
    }

    /// Makes a task, with memory from the heap. It runs when the scheduler has started.
    ///
    /// # Errors
    /// [`SpawnError`]
    pub fn spawn(
        &self,
        options: &TaskOptions<'_>,
        body: impl FnOnce(&TaskContext) + Send + 'static,
    ) -> Result<TaskHandle, SpawnError> {
        sys::task::spawn(options, Box::new(body))
    }

    /// Gives an interrupt its handler, for as long as the scheduler runs. It is called with less
    /// urgent interrupts held back; a task that it wakes runs when the last handler has ended.
    ///
    /// # Errors
    /// [`AttachError`]
    pub fn attach(
        &self,
        interrupt: Interrupt,
        priority: InterruptPriority,
        handler: impl FnMut(&InterruptContext) + Send + 'static,
    ) -> Result<(), AttachError> {
        let handler = Box::leak(Box::new(handler));
        port::attach(interrupt, priority, handler)
    }

    /// Has every event told to a sink, until the scheduler stops.
    pub fn trace(&self, sink: &'static dyn TraceSink) {
        sys::trace::listen(Some(sink));
    }

    /// Runs the tasks: on the host until all have returned or one calls `TaskContext::stop`, on the
    /// target for ever.
    ///
    /// On the host all tasks share one thread, which this call starts with the caller's scheduling
    /// and waits for: they keep the crate's rule about thread-locals. After `TaskContext::stop`
    /// that thread sleeps for ever: another thread may still use what an abandoned task lent it.
    ///
    /// # Errors
    /// [`StartError`]; the kernel is free again.
    pub fn start(self, clock: Clock) -> Result<(), StartError> {
        port::start(clock)
    }
}

impl Drop for Kernel {
    fn drop(&mut self) {
        port::tear_down();
        release();
    }
}

/// The kernel can be taken again.
pub(crate) fn release() {
    sys::trace::listen(None);
    // Release pairs with the Acquire in `take`.
    TAKEN.store(false, Ordering::Release);
}

impl context::TaskContext {
    /// Makes a task, with memory from the heap. It may run before this call returns. Other tasks
    /// wait while its stack is filled with the pattern by which its use is measured.
    ///
    /// # Errors
    /// [`SpawnError`]
    pub fn spawn(
        &self,
        options: &TaskOptions<'_>,
        body: impl FnOnce(&TaskContext) + Send + 'static,
    ) -> Result<TaskHandle, SpawnError> {
        sys::task::spawn(options, Box::new(body))
    }
}
