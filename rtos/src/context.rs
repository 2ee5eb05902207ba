//! The contexts in which code runs: a task, a handler of an interrupt, a callback of a timer.

use core::marker::PhantomData;

mod sealed {
    pub trait Sealed {
        /// Whether to use the kernel's functions for interrupts.
        const IN_INTERRUPT: bool = false;
        /// Records whether a task of higher priority than the interrupted one was woken.
        fn woken(&self, _woken: bool) {}
    }
}
pub(crate) use sealed::Sealed;

/// The context of a call that never blocks: a task, a handler, or the owner of a kernel that is
/// not running yet.
pub trait Context: Sealed {}

/// A caller that may make objects: a task, or the owner of a kernel that is not running yet.
pub trait TaskLevel: Context {}

/// Proof that the caller is a task. It cannot be sent to another task.
#[derive(Debug)]
pub struct TaskContext {
    _of_one_task: PhantomData<*mut ()>,
}

/// Proof that the caller is a handler of an interrupt. A handler cannot block.
#[derive(Debug)]
pub struct InterruptContext {
    woken: core::cell::Cell<bool>,
    _of_one_handler: PhantomData<*mut ()>,
}

impl Sealed for TaskContext {}
impl Context for TaskContext {}
impl TaskLevel for TaskContext {}

/// Proof that the caller is the callback of a software timer. A callback runs in the task that
/// serves all timers, and must not block.
#[derive(Debug)]
pub struct TimerContext {
    _of_one_task: PhantomData<*mut ()>,
}

impl Sealed for TimerContext {}
impl Context for TimerContext {}

impl TimerContext {
    pub(crate) fn new() -> Self {
        Self {
            _of_one_task: PhantomData,
        }
    }
}

impl Sealed for InterruptContext {
    const IN_INTERRUPT: bool = true;
    fn woken(&self, woken: bool) {
        self.woken.set(self.woken.get() | woken);
    }
}
impl Context for InterruptContext {}

impl InterruptContext {
    pub(crate) fn new() -> Self {
        Self {
            woken: core::cell::Cell::new(false),
            _of_one_handler: PhantomData,
        }
    }

    /// Returns whether the handler woke a task. That task runs after the last interrupt (T-RTOS-2).
    pub(crate) fn has_woken(&self) -> bool {
        self.woken.get()
    }
}

impl TaskContext {
    pub(crate) fn new() -> Self {
        Self {
            _of_one_task: PhantomData,
        }
    }
}
