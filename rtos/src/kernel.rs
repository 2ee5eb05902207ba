//! The kernel as a value: a program takes it once, adds tasks and starts it.

use crate::context::{Context, InterruptContext, Sealed, TaskContext, TaskLevel};
use crate::interrupt::{HandlerError, Interrupt, InterruptPriority};
use crate::port::events::{self, TraceSink};
use crate::port::{self, StartError, TickSource};
use crate::sys;
use crate::sys::task::TaskHandle;
use crate::task::{SpawnError, TaskOptions};
use alloc::boxed::Box;
use core::marker::PhantomData;

/// The one kernel of this process or core.
#[derive(Debug)]
pub struct Kernel {
    /// Before its tasks run, only the thread that starts the kernel may call it.
    _of_one_thread: PhantomData<*mut ()>,
}

/// The kernel is not available.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum KernelError {
    /// The kernel is already taken. It can be taken again after the scheduler has stopped.
    #[error("the kernel is in use already")]
    Taken,
}

impl Kernel {
    /// Takes the kernel.
    ///
    /// # Errors
    /// [`KernelError::Taken`]
    pub fn take() -> Result<Self, KernelError> {
        if !sys::take() {
            return Err(KernelError::Taken);
        }
        port::prepare();
        Ok(Self {
            _of_one_thread: PhantomData,
        })
    }

    /// Makes a task, with memory from the heap. It runs after the scheduler has started.
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

    /// Sets the handler of an interrupt until the scheduler stops. While the handler runs, less
    /// urgent interrupts wait; a task that it wakes runs when the last handler has ended.
    ///
    /// # Errors
    /// [`HandlerError`]
    pub fn attach(
        &self,
        interrupt: Interrupt,
        priority: InterruptPriority,
        handler: impl FnMut(&InterruptContext) + Send + 'static,
    ) -> Result<(), HandlerError> {
        let handler = Box::leak(Box::new(handler));
        port::attach(interrupt, priority, handler)
    }

    /// Passes every event to `sink`, until the scheduler stops.
    pub fn trace(&self, sink: &'static dyn TraceSink) {
        events::listen(Some(sink));
    }

    /// Runs the tasks. On the host it returns when all have returned or one calls
    /// `TaskContext::stop`; on the target it returns only if the kernel could not start.
    ///
    /// On the host all tasks share one thread. This call starts that thread with the caller's
    /// scheduling policy and priority, and waits until the scheduler ends. Tasks must obey the
    /// crate's rule about thread-locals. After `TaskContext::stop` the thread sleeps for ever,
    /// because another thread may still use memory that an abandoned task lent to it.
    ///
    /// # Errors
    /// [`StartError`]; the kernel can then be taken again.
    pub fn start(self, clock: TickSource) -> Result<(), StartError> {
        port::start(clock, sys::task::none_left)
    }
}

impl Sealed for Kernel {}
impl Context for Kernel {}
impl TaskLevel for Kernel {}

impl Drop for Kernel {
    fn drop(&mut self) {
        #[cfg(target_os = "linux")]
        sys::task::abandon_all();
        port::tear_down();
        sys::release();
    }
}
