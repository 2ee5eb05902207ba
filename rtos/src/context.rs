//! Where code runs: in a task, or in a handler of an interrupt.

use crate::kernel::Kernel;
use crate::port;
use crate::sys;
use crate::sys::task::TaskStatistics;
use crate::time::Ticks;
use core::marker::PhantomData;
use core::time::Duration;

mod sealed {
    pub trait Sealed {
        /// Whether the kernel's functions for interrupts are to be used.
        const IN_INTERRUPT: bool;
        /// A task of higher priority than the interrupted one was woken.
        fn woken(&self, woken: bool);
    }
}
pub(crate) use sealed::Sealed;

/// A caller of what never blocks: a task, a handler, or the owner of a kernel that does not run
/// yet.
pub trait Context: Sealed {}

/// A caller that may make objects: a task, or the owner of a kernel that does not run yet.
pub trait TaskLevel: Context {}

/// Proof that the caller is a task. Not to be sent anywhere: it belongs to its task.
#[derive(Debug)]
pub struct TaskContext {
    _of_one_task: PhantomData<*mut ()>,
}

/// Proof that the caller is a handler of an interrupt. It cannot block.
#[derive(Debug)]
pub struct InterruptContext {
    woken: core::cell::Cell<bool>,
    _of_one_handler: PhantomData<*mut ()>,
}

impl Sealed for TaskContext {
    const IN_INTERRUPT: bool = false;
    fn woken(&self, _woken: bool) {}
}
impl Context for TaskContext {}
impl TaskLevel for TaskContext {}

impl Sealed for Kernel {
    const IN_INTERRUPT: bool = false;
    fn woken(&self, _woken: bool) {}
}
impl Context for Kernel {}
impl TaskLevel for Kernel {}

/// Proof that the caller is the callback of a software timer. It runs in the task that serves all
/// timers, and must not block.
#[derive(Debug)]
pub struct TimerContext {
    _of_one_task: PhantomData<*mut ()>,
}

impl Sealed for TimerContext {
    const IN_INTERRUPT: bool = false;
    fn woken(&self, _woken: bool) {}
}
impl Context for TimerContext {}

impl TimerContext {
    pub(crate) fn new() -> Self {
        Self {
            _of_one_task: PhantomData,
        }
    }

    /// The current tick.
    #[must_use]
    pub fn now(&self) -> Ticks {
        sys::task::now(false)
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

    /// The current tick.
    #[must_use]
    pub fn now(&self) -> Ticks {
        sys::task::now(true)
    }

    /// T-RTOS-2: what a handler wakes runs when the last interrupt has ended.
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

    /// The current tick.
    #[must_use]
    pub fn now(&self) -> Ticks {
        sys::task::now(false)
    }

    /// When tick 0 was, in nanoseconds of the clock that times
    /// [`KernelEvent`](crate::KernelEvent)s. The same value in every task and at every call, until
    /// the count of ticks wraps around (49 days).
    #[must_use]
    pub fn tick_origin_ns(&self) -> u64 {
        port::tick_origin_ns()
    }

    /// Waits until this task's notification is not zero, and takes all of it.
    ///
    /// Returns the count, or zero if the time was over first.
    ///
    /// # Panics
    /// In a critical section or with pre-emption deferred.
    pub fn take_notifications(&self, timeout: impl Into<Ticks>) -> u32 {
        sys::task::take_notification(true, timeout.into())
    }

    /// Waits until this task's notification is not zero, and counts it down by one.
    ///
    /// Returns whether there was one before the time was over.
    ///
    /// # Panics
    /// In a critical section or with pre-emption deferred.
    pub fn take_notification(&self, timeout: impl Into<Ticks>) -> bool {
        sys::task::take_notification(false, timeout.into()) != 0
    }

    /// Lets the other ready tasks of the same priority run (T-RTOS-2: the switch happens at once).
    pub fn yield_now(&self) {
        sys::task::yield_now();
    }

    /// Blocks for a span, counted from now.
    ///
    /// # Panics
    /// In a critical section or with pre-emption deferred.
    pub fn delay(&self, span: impl Into<Ticks>) {
        sys::task::delay(span.into());
    }

    /// Blocks until `period` after `last_wake`, and moves `last_wake` there: without drift, however
    /// long the work took. Returns at once with `false` if that point has passed already.
    ///
    /// # Panics
    /// If the period is zero; in a critical section or with pre-emption deferred.
    pub fn delay_until(&self, last_wake: &mut Ticks, period: impl Into<Ticks>) -> bool {
        sys::task::delay_until(last_wake, period.into())
    }

    /// Works for a span of this task's own time: while others run it does not pass. In virtual time
    /// the span passes at once. For tests and models.
    pub fn burn(&self, span: Duration) {
        port::burn(span);
    }

    /// Bytes of this task's stack that it never used. Reads all of them, which takes some
    /// microseconds; other tasks may run in between.
    #[must_use]
    pub fn unused_stack_bytes(&self) -> usize {
        sys::task::own_unused_stack_bytes()
    }

    /// Calls `look` for every task that is alive. `look` must not block; no other task runs until
    /// this call returns.
    pub fn each_task(&self, look: impl FnMut(&TaskStatistics<'_>)) {
        port::without_others(|| sys::task::each(look));
    }

    /// Runs `body` with interrupts masked: neither handlers nor other tasks run before it returns.
    /// Keep it short.
    pub fn critical<R>(&self, body: impl FnOnce() -> R) -> R {
        sys::critical(body)
    }

    /// Ends the scheduler: [`Kernel::start`](crate::Kernel::start) returns. The other tasks are
    /// abandoned where they are: what they own is not dropped. To end without that, let every task
    /// return.
    #[cfg(target_os = "linux")]
    pub fn stop(&self) -> ! {
        crate::port::host::stop()
    }
}
