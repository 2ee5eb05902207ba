//! The kernel calls of a task, a handler of an interrupt and a timer's callback.

use super::task::{self, TaskHandle, TaskStatistics};
use crate::context::{InterruptContext, TaskContext, TimerContext};
use crate::ffi::{self, Base};
use crate::port;
use crate::task::{SpawnError, TaskOptions};
use crate::time::{LONGEST_SHIFT_NS, TICK_NS, TickTime, Ticks};
use alloc::boxed::Box;
use core::ptr;
use core::time::Duration;

/// A tick that is nearer is not moved, ns: a timer that has just expired when it is set anew could
/// interrupt twice, and each of its interrupts is a tick.
const NEAREST_SHIFT_NS: u64 = 50_000;

impl TimerContext {
    /// Returns the current tick.
    #[must_use]
    pub fn now(&self) -> Ticks {
        task::now(false)
    }
}

impl InterruptContext {
    /// Returns the current tick.
    #[must_use]
    pub fn now(&self) -> Ticks {
        task::now(true)
    }
}

impl TaskContext {
    /// Makes a task, with memory from the heap. The task may run before this call returns. Other
    /// tasks wait while its stack is filled with the pattern by which stack use is measured.
    ///
    /// # Errors
    /// [`SpawnError`]
    pub fn spawn(
        &self,
        options: &TaskOptions<'_>,
        body: impl FnOnce(&TaskContext) + Send + 'static,
    ) -> Result<TaskHandle, SpawnError> {
        task::spawn(options, Box::new(body))
    }

    /// Returns the current tick.
    #[must_use]
    pub fn now(&self) -> Ticks {
        task::now(false)
    }

    /// Returns the last tick. Its count and its time belong together, whatever interrupts the call.
    #[must_use]
    pub fn last_tick(&self) -> TickTime {
        ffi::critical(|| TickTime {
            count: self.now(),
            due_ns: port::tick_times_ns().0,
        })
    }

    /// Moves the next tick by `by_ns`, later if positive, and all later ticks with it. The count of
    /// ticks does not change, so a wait ends with the same tick as without the call. More than
    /// [`LONGEST_SHIFT_NS`] is cut to it; the port rounds to its clock (100 ns on riscv32).
    ///
    /// Returns `false`, and moves nothing, if the next tick has already been moved, or if it is
    /// less than 50 µs away, before or after the move. So two ticks are 0.9 to 1.1 ms apart.
    #[must_use]
    pub fn shift_ticks(&self, by_ns: i32) -> bool {
        let by_ns = by_ns.clamp(-LONGEST_SHIFT_NS, LONGEST_SHIFT_NS);
        ffi::critical(|| {
            let (last, next) = port::tick_times_ns();
            let moved = next.saturating_add_signed(by_ns.into());
            let is_near = port::timestamp_ns() + NEAREST_SHIFT_NS > next.min(moved);
            if is_near || next - last != TICK_NS {
                return false;
            }
            port::set_next_tick(moved);
            true
        })
    }

    /// Waits until this task's notification is not zero, and takes all of it.
    ///
    /// Returns the count, or zero at a time-out.
    ///
    /// # Panics
    /// In a critical section or with pre-emption deferred.
    pub fn take_notifications(&self, timeout: impl Into<Ticks>) -> u32 {
        take(true, timeout.into())
    }

    /// Waits until this task's notification is not zero, and counts it down by one.
    ///
    /// Returns whether there was a notification before the time-out.
    ///
    /// # Panics
    /// In a critical section or with pre-emption deferred.
    pub fn take_notification(&self, timeout: impl Into<Ticks>) -> bool {
        take(false, timeout.into()) != 0
    }

    /// Yields to the other ready tasks of the same priority (T-RTOS-2: the switch happens at once).
    pub fn yield_now(&self) {
        // SAFETY: called by a task.
        unsafe { ffi::tandem_yield() };
    }

    /// Blocks for `span`, counted from now.
    ///
    /// # Panics
    /// In a critical section or with pre-emption deferred.
    pub fn delay(&self, span: impl Into<Ticks>) {
        let span = span.into().0.min(Ticks::FOREVER.0 - 1);
        port::assert_may_block();
        // SAFETY: called by a task that may block.
        unsafe { ffi::vTaskDelay(span) };
    }

    /// Blocks until `period` after `last_wake`, and sets `last_wake` to that point. The work of a
    /// period causes no drift. Returns `false` at once if that point has already passed.
    ///
    /// # Panics
    /// If the period is zero; in a critical section or with pre-emption deferred.
    pub fn delay_until(&self, last_wake: &mut Ticks, period: impl Into<Ticks>) -> bool {
        let period = period.into();
        port::assert_may_block();
        assert!(period.0 > 0, "a period of zero ticks");
        // SAFETY: called by a task that may block; `last_wake` is written during the call only.
        unsafe { ffi::xTaskDelayUntil(&mut last_wake.0, period.0) != 0 }
    }

    /// Works until this task has run for `span`; the run time of other tasks does not count. In
    /// virtual time the span passes at once. For tests and models.
    pub fn burn(&self, span: Duration) {
        if port::virtual_work(span) {
            return;
        }
        let begin = own_run_time();
        while port::run_time_span(own_run_time().saturating_sub(begin)) < span {
            core::hint::spin_loop();
        }
    }

    /// Returns the bytes of this task's stack that were never used. Reads all of them, which takes
    /// some microseconds; other tasks may run during that time.
    #[must_use]
    pub fn unused_stack_bytes(&self) -> usize {
        let mut info = ffi::TaskInfo::default();
        // SAFETY: called by a task, which is the current one and lives; only it uses its stack.
        unsafe { ffi::tandem_task_info(ffi::current_tcb(), &mut info) };
        info.unused_stack_words * size_of::<usize>()
    }

    /// Calls `visit` for every task that is alive. `visit` must not block; no other task runs until
    /// this call returns.
    pub fn each_task(&self, visit: impl FnMut(&TaskStatistics<'_>)) {
        port::without_others(|| task::each(visit));
    }

    /// Runs `body` with interrupts masked: neither handlers nor other tasks run before it returns.
    /// `body` must be short.
    pub fn critical<R>(&self, body: impl FnOnce() -> R) -> R {
        ffi::critical(body)
    }

    /// Ends the scheduler: [`Kernel::start`](crate::Kernel::start) returns. The other tasks are
    /// abandoned where they are, and the objects that they own are not dropped. To drop them, let
    /// every task return instead.
    #[cfg(target_os = "linux")]
    pub fn stop(&self) -> ! {
        port::host::stop()
    }
}

/// Waits for a notification of the running task; takes one, or all of them.
fn take(all: bool, timeout: Ticks) -> u32 {
    port::assert_may_block();
    // SAFETY: called by a task that may block; the call concerns the task's own word 0.
    unsafe { ffi::ulTaskGenericNotifyTake(0, Base::from(all), timeout.0) }
}

/// Returns how long the running task has run, in the port's units.
fn own_run_time() -> u64 {
    // SAFETY: null means the caller, a task.
    unsafe { ffi::ulTaskGetRunTimeCounter(ptr::null()) }
}
