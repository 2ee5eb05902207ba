//! A value that one task at a time may touch; its holder inherits the priority of a waiter.

use super::queue::Raw;
use super::shared::Shared;
use super::task;
use crate::context::{TaskContext, TaskLevel};
use crate::time::Ticks;
use crate::{InUse, TimedOut};
#[cfg(feature = "alloc")]
use alloc::sync::Arc;
use core::cell::UnsafeCell;
use core::fmt;
use core::ops::{Deref, DerefMut};
use core::sync::atomic::{AtomicBool, Ordering};

struct Inner<T> {
    raw: Raw,
    /// A guard lives, in whichever life of the kernel. The scheduler may stop while its task
    /// borrows the value, or has lent it to another thread; then this stays.
    locked: AtomicBool,
    value: UnsafeCell<T>,
}

// SAFETY: the value is reached by one task at a time, which the kernel's mutex sees to, on the
// core's thread; it goes from task to task, so it must be `Send`.
unsafe impl<T: Send> Send for Inner<T> {}
// SAFETY: as above.
unsafe impl<T: Send> Sync for Inner<T> {}

/// Memory for a mutex in a static, with its value.
pub struct MutexMemory<T>(Inner<T>);

impl<T: Send> MutexMemory<T> {
    /// Memory for one mutex.
    pub const fn new(value: T) -> Self {
        Self(Inner {
            raw: Raw::new(),
            locked: AtomicBool::new(false),
            value: UnsafeCell::new(value),
        })
    }
}

/// A value behind a mutex with priority inheritance: as long as a task holds it and a more urgent
/// one waits, the former has the latter's priority. Not re-entrant, and not for interrupts.
pub struct Mutex<T: 'static> {
    inner: Shared<Inner<T>>,
}

impl<T> Clone for Mutex<T> {
    /// Another handle of the same mutex.
    fn clone(&self) -> Self {
        Self {
            inner: self.inner.clone(),
        }
    }
}

impl<T: fmt::Debug> fmt::Debug for Mutex<T> {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("Mutex")
    }
}

impl<T: Send> Mutex<T> {
    /// A mutex on the heap.
    #[cfg(feature = "alloc")]
    #[must_use]
    pub fn new(_at: &impl TaskLevel, value: T) -> Self {
        let inner = Arc::new(Inner {
            raw: Raw::new(),
            locked: AtomicBool::new(false),
            value: UnsafeCell::new(value),
        });
        let made = inner.raw.make_mutex();
        debug_assert!(made.is_ok(), "new memory is unused");
        Self {
            inner: Shared::Heap(inner),
        }
    }

    /// A mutex in a static.
    ///
    /// # Errors
    /// [`InUse`], also if it was locked when an earlier life of the kernel was stopped: something
    /// may still borrow the value.
    pub fn new_static(
        _at: &impl TaskLevel,
        memory: &'static MutexMemory<T>,
    ) -> Result<Self, InUse> {
        // Between this look and the next line nobody locks: either the mutex is of this life, and
        // is refused there, or of an earlier one, and cannot be locked any more.
        // Acquire pairs with the Release in the guard's `drop`.
        if memory.0.locked.load(Ordering::Acquire) {
            return Err(InUse);
        }
        memory.0.raw.make_mutex()?;
        Ok(Self {
            inner: Shared::Static(&memory.0),
        })
    }

    /// Waits for the value.
    ///
    /// # Errors
    /// [`TimedOut`]
    ///
    /// # Panics
    /// If the task holds it already; in a critical section or with pre-emption deferred; if the
    /// mutex was made for an earlier life of the kernel.
    pub fn lock<'a>(
        &'a self,
        ctx: &'a TaskContext,
        timeout: impl Into<Ticks>,
    ) -> Result<MutexGuard<'a, T>, TimedOut> {
        assert!(!self.inner.raw.is_mine(), "a task locks what it holds");
        self.inner.raw.take(timeout.into())?;
        task::mutex_taken();
        self.inner.locked.store(true, Ordering::Relaxed);
        Ok(MutexGuard {
            inner: &self.inner,
            ctx,
        })
    }
}

/// The value, until this is dropped. Belongs to the task that locked.
pub struct MutexGuard<'a, T> {
    inner: &'a Inner<T>,
    ctx: &'a TaskContext,
}

impl<T> Deref for MutexGuard<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        // SAFETY: this task holds the mutex as long as the guard is.
        unsafe { &*self.inner.value.get() }
    }
}

impl<T> DerefMut for MutexGuard<'_, T> {
    fn deref_mut(&mut self) -> &mut T {
        // SAFETY: as above, and the guard is borrowed alone.
        unsafe { &mut *self.inner.value.get() }
    }
}

impl<T> Drop for MutexGuard<'_, T> {
    fn drop(&mut self) {
        // Release pairs with the Acquire in `new_static`: the value is not borrowed any more.
        self.inner.locked.store(false, Ordering::Release);
        task::mutex_given();
        self.inner.raw.give(self.ctx);
    }
}

impl<T: fmt::Debug> fmt::Debug for MutexGuard<'_, T> {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        (**self).fmt(out)
    }
}
