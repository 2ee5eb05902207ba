//! A value that one task at a time may access; its holder inherits the priority of a waiter.

use super::queue::Raw;
use super::task;
use crate::TimedOut;
use crate::context::{TaskContext, TaskLevel};
use crate::time::Ticks;
use alloc::sync::Arc;
use core::cell::UnsafeCell;
use core::fmt;
use core::ops::{Deref, DerefMut};

struct Inner<T> {
    raw: Raw,
    value: UnsafeCell<T>,
}

// SAFETY: the kernel's mutex lets one task at a time reach the value, on the core's thread; the
// value moves from task to task, so it must be `Send`.
unsafe impl<T: Send> Send for Inner<T> {}
// SAFETY: as above.
unsafe impl<T: Send> Sync for Inner<T> {}

/// A value behind a mutex with priority inheritance: while a more urgent task waits for it, the
/// holder has the priority of the waiter. It is not re-entrant, and handlers cannot lock it.
///
/// A handle that outlives its scheduler panics when it is used in the next one: an abandoned task
/// may still borrow the value.
pub struct Mutex<T: 'static> {
    inner: Arc<Inner<T>>,
}

impl<T> Clone for Mutex<T> {
    /// Returns another handle of the same mutex.
    fn clone(&self) -> Self {
        Self {
            inner: Arc::clone(&self.inner),
        }
    }
}

impl<T: fmt::Debug> fmt::Debug for Mutex<T> {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("Mutex")
    }
}

impl<T: Send> Mutex<T> {
    /// Makes a mutex that is not locked.
    #[must_use]
    pub fn new(_at: &impl TaskLevel, value: T) -> Self {
        let inner = Arc::new(Inner {
            raw: Raw::new(),
            value: UnsafeCell::new(value),
        });
        inner.raw.make_mutex();
        Self { inner }
    }

    /// Waits until the mutex is free, and locks it.
    ///
    /// # Errors
    /// [`TimedOut`]
    ///
    /// # Panics
    /// If the task already holds it; in a critical section or with pre-emption deferred; if the
    /// mutex was made for an earlier life of the kernel.
    pub fn lock<'a>(
        &'a self,
        ctx: &'a TaskContext,
        timeout: impl Into<Ticks>,
    ) -> Result<MutexGuard<'a, T>, TimedOut> {
        assert!(!self.inner.raw.is_mine(), "a task locks what it holds");
        self.inner.raw.take(timeout.into())?;
        task::mutex_taken();
        Ok(MutexGuard {
            inner: &self.inner,
            ctx,
        })
    }
}

/// Access to the value until this is dropped. Belongs to the task that locked the mutex.
pub struct MutexGuard<'a, T> {
    inner: &'a Inner<T>,
    ctx: &'a TaskContext,
}

impl<T> Deref for MutexGuard<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        // SAFETY: this task holds the mutex while the guard exists.
        unsafe { &*self.inner.value.get() }
    }
}

impl<T> DerefMut for MutexGuard<'_, T> {
    fn deref_mut(&mut self) -> &mut T {
        // SAFETY: as above, and the guard is borrowed mutably.
        unsafe { &mut *self.inner.value.get() }
    }
}

impl<T> Drop for MutexGuard<'_, T> {
    fn drop(&mut self) {
        task::mutex_given();
        self.inner.raw.give(self.ctx);
    }
}

impl<T: fmt::Debug> fmt::Debug for MutexGuard<'_, T> {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        (**self).fmt(out)
    }
}
