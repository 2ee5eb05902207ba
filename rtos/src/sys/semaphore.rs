//! Semaphores: counting ones, and binary ones, which count to one.

use super::queue::Raw;
use crate::TimedOut;
use crate::context::{Context, TaskContext, TaskLevel};
use crate::time::Ticks;
use alloc::sync::Arc;
use core::fmt;

/// The semaphore has reached its highest count.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the semaphore is at its highest count")]
pub struct SemaphoreFull;

/// A semaphore. Cloned handles refer to the same semaphore.
///
/// A handle that outlives its scheduler panics when it is used in the next one.
#[derive(Clone)]
pub struct Semaphore {
    raw: Arc<Raw>,
    max: usize,
}

impl fmt::Debug for Semaphore {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("Semaphore")
    }
}

impl Semaphore {
    /// Makes a binary semaphore, not given yet.
    #[must_use]
    pub fn binary(at: &impl TaskLevel) -> Self {
        Self::counting(at, 1, 0)
    }

    /// Makes a counting semaphore.
    ///
    /// # Panics
    /// If `max` is zero, or `initial` above it.
    #[must_use]
    pub fn counting(_at: &impl TaskLevel, max: usize, initial: usize) -> Self {
        assert!(
            max > 0 && initial <= max,
            "a semaphore counts from {initial} to {max}"
        );
        let raw = Arc::new(Raw::new());
        raw.make_semaphore(max, initial);
        Self { raw, max }
    }

    pub(crate) fn raw(&self) -> &Raw {
        &self.raw
    }

    /// Returns the highest count.
    #[must_use]
    pub fn max(&self) -> usize {
        self.max
    }

    /// Counts up by one, and wakes the most urgent waiting task.
    ///
    /// # Errors
    /// [`SemaphoreFull`]
    pub fn give(&self, ctx: &impl Context) -> Result<(), SemaphoreFull> {
        if self.raw.give(ctx) {
            Ok(())
        } else {
            Err(SemaphoreFull)
        }
    }

    /// Waits until the count is above zero, and counts down by one.
    ///
    /// # Errors
    /// [`TimedOut`]
    ///
    /// # Panics
    /// In a critical section or with pre-emption deferred, unless the time is [`Ticks::NONE`].
    pub fn take(&self, _ctx: &TaskContext, timeout: impl Into<Ticks>) -> Result<(), TimedOut> {
        self.raw.take(timeout.into())
    }

    /// Counts down by one if the count is above zero; returns whether it was.
    pub fn try_take(&self, ctx: &impl Context) -> bool {
        self.raw.try_take(ctx)
    }
}
