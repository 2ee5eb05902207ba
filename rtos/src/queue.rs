//! Queues: values of one type, first in, first out, from tasks and handlers to tasks and handlers.

use crate::InUse;
use crate::context::{Context, TaskContext, TaskLevel};
use crate::port;
use crate::sys::queue::{Storage, Typed};
use crate::sys::shared::Shared;
use crate::time::Ticks;
use core::cell::UnsafeCell;
use core::fmt;
use core::mem::MaybeUninit;

/// There was no room; the value is given back.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Full<T>(pub T);

impl<T> fmt::Display for Full<T> {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("the queue is full")
    }
}

impl<T: fmt::Debug> core::error::Error for Full<T> {}

/// Memory for a queue of `N` values in a static.
pub struct QueueMemory<T: 'static, const N: usize> {
    queue: Typed<T>,
    items: Items<T, N>,
}

use items::Items;

#[allow(unsafe_code)]
mod items {
    use super::{MaybeUninit, UnsafeCell};

    /// Places for values, which only the kernel touches.
    pub(super) struct Items<T, const N: usize>(pub(super) UnsafeCell<[MaybeUninit<T>; N]>);

    // SAFETY: the kernel is called from one thread only, and values that pass it are `Send`.
    unsafe impl<T: Send, const N: usize> Sync for Items<T, N> {}
}

impl<T: Send, const N: usize> QueueMemory<T, N> {
    /// Memory for one queue.
    #[must_use]
    #[allow(
        clippy::new_without_default,
        reason = "for statics, where a default is of no use"
    )]
    pub const fn new() -> Self {
        Self {
            queue: Typed::new(),
            items: Items(UnsafeCell::new([const { MaybeUninit::uninit() }; N])),
        }
    }
}

/// A queue. Cloned handles are the same queue. Values that are left in it when the last one goes
/// are dropped in a task, and leaked elsewhere.
///
/// A handle that outlives its scheduler panics when it is used in the next one.
pub struct Queue<T: 'static> {
    queue: Shared<Typed<T>>,
}

impl<T> Clone for Queue<T> {
    fn clone(&self) -> Self {
        Self {
            queue: self.queue.clone(),
        }
    }
}

impl<T> fmt::Debug for Queue<T> {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("Queue")
    }
}

impl<T: Send> Queue<T> {
    /// A queue of `capacity` values on the heap.
    ///
    /// # Panics
    /// If the capacity is zero.
    #[cfg(feature = "alloc")]
    #[must_use]
    pub fn new(_at: &impl TaskLevel, capacity: usize) -> Self {
        Self {
            queue: Typed::on_heap(capacity),
        }
    }

    /// A queue of `N` values in a static.
    ///
    /// # Errors
    /// [`InUse`]
    ///
    /// # Panics
    /// If `N` is zero.
    pub fn new_static<const N: usize>(
        _at: &impl TaskLevel,
        memory: &'static QueueMemory<T, N>,
    ) -> Result<Self, InUse> {
        let items = memory.items.0.get().cast();
        memory.queue.make(Storage::Static(items), N)?;
        Ok(Self {
            queue: Shared::Static(&memory.queue),
        })
    }

    pub(crate) fn typed(&self) -> &Typed<T> {
        &self.queue
    }

    /// Sends a value; waits for room.
    ///
    /// # Errors
    /// [`Full`] if there was none in time.
    ///
    /// # Panics
    /// In a critical section or with pre-emption deferred, unless the time is [`Ticks::NONE`].
    pub fn send(
        &self,
        ctx: &TaskContext,
        value: T,
        timeout: impl Into<Ticks>,
    ) -> Result<(), Full<T>> {
        let timeout = blocking(timeout.into());
        self.queue.send(ctx, value, timeout).map_err(Full)
    }

    /// Sends a value before all that wait in the queue; waits for room.
    ///
    /// # Errors
    /// [`Full`] if there was none in time.
    ///
    /// # Panics
    /// As [`Queue::send`].
    pub fn send_first(
        &self,
        ctx: &TaskContext,
        value: T,
        timeout: impl Into<Ticks>,
    ) -> Result<(), Full<T>> {
        let timeout = blocking(timeout.into());
        self.queue.send_first(ctx, value, timeout).map_err(Full)
    }

    /// Sends a value if there is room.
    ///
    /// # Errors
    /// [`Full`]
    pub fn try_send(&self, ctx: &impl Context, value: T) -> Result<(), Full<T>> {
        self.queue.send(ctx, value, Ticks::NONE).map_err(Full)
    }

    /// Sends a value before all that wait in the queue, if there is room.
    ///
    /// # Errors
    /// [`Full`]
    pub fn try_send_first(&self, ctx: &impl Context, value: T) -> Result<(), Full<T>> {
        self.queue.send_first(ctx, value, Ticks::NONE).map_err(Full)
    }

    /// Waits for a value. `None` if none arrived in time.
    ///
    /// # Panics
    /// As [`Queue::send`].
    pub fn receive(&self, ctx: &TaskContext, timeout: impl Into<Ticks>) -> Option<T> {
        let timeout = blocking(timeout.into());
        self.queue.receive(ctx, timeout)
    }

    /// The first value, if there is one.
    pub fn try_receive(&self, ctx: &impl Context) -> Option<T> {
        self.queue.receive(ctx, Ticks::NONE)
    }

    /// Waits for a value and leaves it in the queue. `None` if none arrived in time.
    ///
    /// # Panics
    /// As [`Queue::send`].
    pub fn peek(&self, _ctx: &TaskContext, timeout: impl Into<Ticks>) -> Option<T>
    where
        T: Copy,
    {
        self.queue.peek(blocking(timeout.into()))
    }

    /// How many values wait.
    pub fn len(&self, ctx: &impl Context) -> usize {
        self.queue.raw.count(ctx)
    }

    /// Whether no value waits.
    pub fn is_empty(&self, ctx: &impl Context) -> bool {
        self.len(ctx) == 0
    }

    /// How many values the queue holds at most.
    #[must_use]
    pub fn capacity(&self) -> usize {
        self.queue.capacity()
    }
}

/// A time that the caller may wait.
fn blocking(timeout: Ticks) -> Ticks {
    if timeout != Ticks::NONE {
        port::assert_may_block();
    }
    timeout
}
