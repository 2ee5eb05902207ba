//! Semaphores: counting, and binary as those that count to one.

use crate::context::{Context, TaskContext, TaskLevel};
use crate::sys::queue::Raw;
use crate::sys::shared::Shared;
use crate::time::Ticks;
use crate::{InUse, TimedOut};
#[cfg(feature = "alloc")]
use alloc::sync::Arc;
use core::fmt;
use core::sync::atomic::{AtomicUsize, Ordering};

/// The semaphore has reached its highest count.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SemaphoreFull;

impl fmt::Display for SemaphoreFull {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("the semaphore is at its highest count")
    }
}

impl core::error::Error for SemaphoreFull {}

/// Memory for a semaphore in a static.
pub struct SemaphoreMemory {
    raw: Raw,
    max: AtomicUsize,
}

impl SemaphoreMemory {
    /// Memory for one semaphore.
    #[must_use]
    #[allow(
        clippy::new_without_default,
        reason = "for statics, where a default is of no use"
    )]
    pub const fn new() -> Self {
        Self {
            raw: Raw::new(),
            max: AtomicUsize::new(0),
        }
    }

    fn make(&self, kind: Kind) -> Result<(), InUse> {
        match kind {
            Kind::Binary => self.raw.make_binary()?,
            Kind::Counting { max, initial } => {
                assert!(
                    max > 0 && initial <= max,
                    "a semaphore counts from {initial} to {max}"
                );
                self.raw.make_counting(max, initial)?;
            }
        }
        let max = if let Kind::Counting { max, .. } = kind {
            max
        } else {
            1
        };
        self.max.store(max, Ordering::Relaxed);
        Ok(())
    }
}

#[derive(Clone, Copy)]
enum Kind {
    Binary,
    Counting { max: usize, initial: usize },
}

/// A semaphore. Cloned handles are the same one.
///
/// A handle that outlives its scheduler panics when it is used in the next one.
#[derive(Clone)]
pub struct Semaphore {
    memory: Shared<SemaphoreMemory>,
}

impl fmt::Debug for Semaphore {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("Semaphore")
    }
}

impl Semaphore {
    /// A binary semaphore on the heap, not given yet.
    #[cfg(feature = "alloc")]
    #[must_use]
    pub fn binary(_at: &impl TaskLevel) -> Self {
        Self::on_heap(Kind::Binary)
    }

    /// A counting semaphore on the heap.
    ///
    /// # Panics
    /// If `max` is zero, or `initial` above it.
    #[cfg(feature = "alloc")]
    #[must_use]
    pub fn counting(_at: &impl TaskLevel, max: usize, initial: usize) -> Self {
        Self::on_heap(Kind::Counting { max, initial })
    }

    #[cfg(feature = "alloc")]
    fn on_heap(kind: Kind) -> Self {
        let memory = Arc::new(SemaphoreMemory::new());
        let made = memory.make(kind);
        debug_assert!(made.is_ok(), "new memory is unused");
        Self {
            memory: Shared::Heap(memory),
        }
    }

    /// A binary semaphore in a static, not given yet.
    ///
    /// # Errors
    /// [`InUse`]
    pub fn binary_static(
        _at: &impl TaskLevel,
        memory: &'static SemaphoreMemory,
    ) -> Result<Self, InUse> {
        Self::in_static(memory, Kind::Binary)
    }

    /// A counting semaphore in a static.
    ///
    /// # Errors
    /// [`InUse`]
    ///
    /// # Panics
    /// If `max` is zero, or `initial` above it.
    pub fn counting_static(
        _at: &impl TaskLevel,
        memory: &'static SemaphoreMemory,
        max: usize,
        initial: usize,
    ) -> Result<Self, InUse> {
        Self::in_static(memory, Kind::Counting { max, initial })
    }

    fn in_static(memory: &'static SemaphoreMemory, kind: Kind) -> Result<Self, InUse> {
        memory.make(kind)?;
        Ok(Self {
            memory: Shared::Static(memory),
        })
    }

    pub(crate) fn raw(&self) -> &Raw {
        &self.memory.raw
    }

    /// The highest count.
    #[must_use]
    pub fn max(&self) -> usize {
        self.memory.max.load(Ordering::Relaxed)
    }

    /// Counts up by one, and wakes the most urgent task that waits.
    ///
    /// # Errors
    /// [`SemaphoreFull`]
    pub fn give(&self, ctx: &impl Context) -> Result<(), SemaphoreFull> {
        if self.raw().give(ctx) {
            Ok(())
        } else {
            Err(SemaphoreFull)
        }
    }

    /// Counts down by one; waits until that is possible.
    ///
    /// # Errors
    /// [`TimedOut`]
    ///
    /// # Panics
    /// In a critical section or with pre-emption deferred, unless the time is [`Ticks::NONE`].
    pub fn take(&self, _ctx: &TaskContext, timeout: impl Into<Ticks>) -> Result<(), TimedOut> {
        self.raw().take(timeout.into())
    }

    /// Counts down by one if that is possible at once. Whether it was.
    pub fn try_take(&self, ctx: &impl Context) -> bool {
        self.raw().try_take(ctx)
    }

    /// The current count.
    pub fn count(&self, ctx: &impl Context) -> usize {
        self.raw().count(ctx)
    }
}
