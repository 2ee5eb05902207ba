//! Resources that the tasks share through their one thread: the allocator, locks of libraries.
//!
//! A lock of the standard library belongs to a thread, and all tasks run in one thread. If a task
//! were pre-empted while it holds a lock, the next task would wait for ever (a dead-lock) or, if
//! the lock is re-entrant, see half-changed data. So such a task is not pre-empted: an allocation
//! is a critical section, and a longer operation defers the switch but lets interrupts run.

use super::{interrupts, state};
use core::alloc::{GlobalAlloc, Layout};
use core::sync::atomic::{AtomicBool, Ordering::Relaxed};

/// An allocator that tasks can share. A program with tasks must declare it:
///
/// ```
/// use std::alloc::System;
/// use tandem_rtos::host::TaskAllocator;
///
/// #[global_allocator]
/// static ALLOCATOR: TaskAllocator<System> = TaskAllocator::new(System);
/// ```
///
/// Each call costs a critical section on the core's thread, and one thread-local load elsewhere.
pub struct TaskAllocator<A> {
    inner: A,
}

/// Is true while `is_installed` runs.
static PROBING: AtomicBool = AtomicBool::new(false);
static PROBED: AtomicBool = AtomicBool::new(false);

impl<A> TaskAllocator<A> {
    /// Wraps another allocator.
    #[must_use]
    pub const fn new(inner: A) -> Self {
        Self { inner }
    }

    /// Returns the wrapped allocator.
    pub const fn inner(&self) -> &A {
        &self.inner
    }
}

/// Runs `body`, which does not unwind, as a critical section if this is the core's thread.
pub(super) fn guarded<R>(body: impl FnOnce() -> R) -> R {
    if !state::on_core() {
        return body();
    }
    state::mask();
    let result = body();
    interrupts::unmask();
    result
}

// SAFETY: every call is passed on unchanged. Interrupts are masked, so on the core's thread no
// other task and no handler runs during a call; the inner allocator synchronises with other
// threads.
#[allow(unsafe_op_in_unsafe_fn, reason = "passes the caller's promise on")]
unsafe impl<A: GlobalAlloc> GlobalAlloc for TaskAllocator<A> {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        if PROBING.load(Relaxed) {
            PROBED.store(true, Relaxed);
        }
        guarded(|| self.inner.alloc(layout))
    }

    unsafe fn dealloc(&self, place: *mut u8, layout: Layout) {
        guarded(|| self.inner.dealloc(place, layout));
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        guarded(|| self.inner.alloc_zeroed(layout))
    }

    unsafe fn realloc(&self, place: *mut u8, layout: Layout, bytes: usize) -> *mut u8 {
        guarded(|| self.inner.realloc(place, layout, bytes))
    }
}

/// Returns whether the program's allocator is a [`TaskAllocator`].
pub(super) fn is_installed() -> bool {
    PROBED.store(false, Relaxed);
    PROBING.store(true, Relaxed);
    drop(core::hint::black_box(alloc::boxed::Box::new(0u8)));
    PROBING.store(false, Relaxed);
    PROBED.load(Relaxed)
}

/// Runs `body` while no other task of the core runs. Interrupts still run, and a task that they
/// wake waits. Use it for state that a library shares implicitly: locks and thread-locals. Costs as
/// much as a critical section. On threads without tasks it only calls `body`.
///
/// # Panics
/// If a call in `body` may block the task.
pub fn deferred<R>(body: impl FnOnce() -> R) -> R {
    interrupts::deferred(body)
}
