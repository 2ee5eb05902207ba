//! The calls of the kernel: its objects, and the claim to use it.
#![allow(unsafe_code)]

mod calls;
pub(crate) mod mutex;
pub(crate) mod queue;
pub(crate) mod semaphore;
pub(crate) mod set;
pub(crate) mod task;
pub(crate) mod timer;

use crate::port;
use crate::port::events::{self, KernelEventKind};
use core::sync::atomic::{AtomicBool, Ordering};

static TAKEN: AtomicBool = AtomicBool::new(false);

/// Claims the one kernel; returns whether it was free.
pub(crate) fn take() -> bool {
    // Acquire pairs with the Release in `release`: the kernel's use on another thread has ended.
    !TAKEN.swap(true, Ordering::Acquire)
}

/// Makes the kernel free to be taken again.
pub(crate) fn release() {
    events::listen(None);
    // Release pairs with the Acquire in `take`.
    TAKEN.store(false, Ordering::Release);
}

/// Records an event of a task. `FreeRTOSConfig.h` numbers the kinds.
#[unsafe(no_mangle)]
extern "C" fn tandem_trace(kind: u32, task: u32) {
    let kind = match kind {
        1 => KernelEventKind::SwitchedIn,
        2 => KernelEventKind::SwitchedOut,
        _ => KernelEventKind::Ready,
    };
    events::record(kind, task, port::timestamp_ns);
}

/// Returns the kernel's counter for the time that tasks run.
#[unsafe(no_mangle)]
extern "C" fn tandem_run_time() -> u64 {
    port::run_time()
}

/// The life of the kernel in which an object was made.
///
/// When a life ends, its state (waiting tasks, active timers) is lost: its objects are never passed
/// to the kernel again.
pub(crate) struct Life(u32);

impl Life {
    pub(crate) fn current() -> Self {
        Self(port::epoch())
    }

    /// Returns whether the object was made in the current life.
    pub(crate) fn is_current(&self) -> bool {
        self.0 == port::epoch()
    }

    /// # Panics
    /// If the object is of an earlier life.
    pub(crate) fn assert_current(&self) {
        assert!(
            self.is_current(),
            "an object that was made for an earlier life of the kernel"
        );
    }
}

/// Restores the kernel's state at power-on, after a reset of its hart that did not clear its
/// memory: [`Kernel::take`](crate::Kernel::take) succeeds again. Tasks, handlers and objects of the
/// earlier life are forgotten and not dropped. Interrupts stay masked until the kernel starts.
/// # Safety
/// The calling hart was the kernel's and has been reset. No code of the earlier life runs again,
/// and no hart uses anything that the earlier life made (handles, objects, borrowed stacks).
#[cfg(target_arch = "riscv32")]
pub unsafe fn after_reset() {
    // SAFETY: the caller's promise.
    unsafe { port::riscv32::reset() };
    task::forget_all();
    release();
}
