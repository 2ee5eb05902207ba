//! Queue sets: a task waits for the first of several queues and semaphores.

use crate::InUse;
use crate::context::{TaskContext, TaskLevel};
use crate::queue::Queue;
use crate::semaphore::Semaphore;
use crate::sys;
use crate::sys::queue::{Raw, Set, Storage, join};
use crate::sys::shared::Shared;
use crate::time::Ticks;
use core::cell::UnsafeCell;
use core::fmt;
use core::mem::MaybeUninit;

/// A member of a set, as [`QueueSet::select`] names it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Member(usize);

/// A queue or semaphore cannot become a member.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AddError {
    /// The set cannot hold what this member and the others could announce together.
    SetFull,
    /// It is not empty, or in a set already.
    NotFree,
}

impl fmt::Display for AddError {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Self::SetFull => "the set is too small for another member of this capacity",
            Self::NotFree => "the member is not empty, or in a set already",
        })
    }
}

impl core::error::Error for AddError {}

/// Memory for a set in a static, for members with together `N` items.
pub struct QueueSetMemory<const N: usize> {
    set: Set,
    items: items::Items<N>,
}

#[allow(unsafe_code)]
mod items {
    use super::{MaybeUninit, UnsafeCell};

    /// Places for handles, which only the kernel touches.
    pub(super) struct Items<const N: usize>(pub(super) UnsafeCell<[MaybeUninit<usize>; N]>);

    // SAFETY: the kernel is called from one thread only.
    unsafe impl<const N: usize> Sync for Items<N> {}
}

impl<const N: usize> QueueSetMemory<N> {
    /// Memory for one set.
    #[must_use]
    #[allow(
        clippy::new_without_default,
        reason = "for statics, where a default is of no use"
    )]
    pub const fn new() -> Self {
        Self {
            set: Set::new(),
            items: items::Items(UnsafeCell::new([MaybeUninit::uninit(); N])),
        }
    }
}

/// A set. Members stay in it for as long as they are.
///
/// Each time [`QueueSet::select`] names a member, the task takes one item from it without waiting;
/// nobody takes from a member otherwise.
#[derive(Clone)]
pub struct QueueSet {
    set: Shared<Set>,
}

impl fmt::Debug for QueueSet {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("QueueSet")
    }
}

impl QueueSet {
    /// A set on the heap, for members with together `capacity` items.
    ///
    /// # Panics
    /// If the capacity is zero.
    #[cfg(feature = "alloc")]
    #[must_use]
    pub fn new(_at: &impl TaskLevel, capacity: usize) -> Self {
        Self {
            set: Set::on_heap(capacity),
        }
    }

    /// A set in a static.
    ///
    /// # Errors
    /// [`InUse`]
    ///
    /// # Panics
    /// If `N` is zero.
    pub fn new_static<const N: usize>(
        _at: &impl TaskLevel,
        memory: &'static QueueSetMemory<N>,
    ) -> Result<Self, InUse> {
        memory
            .set
            .make(Storage::Static(memory.items.0.get().cast()), N)?;
        Ok(Self {
            set: Shared::Static(&memory.set),
        })
    }

    fn add(&self, member: &Raw, capacity: usize) -> Result<Member, AddError> {
        if !self.set.promise(capacity) {
            return Err(AddError::SetFull);
        }
        // Undivided: the member must not fill between the look and the joining.
        if !sys::critical(|| join(&self.set, member)) {
            self.set.release(capacity);
            return Err(AddError::NotFree);
        }
        Ok(Member(member.address()))
    }

    /// Makes a queue a member.
    ///
    /// # Errors
    /// [`AddError`]
    pub fn add_queue<T: Send>(
        &self,
        _at: &impl TaskLevel,
        queue: &Queue<T>,
    ) -> Result<Member, AddError> {
        self.add(&queue.typed().raw, queue.capacity())
    }

    /// Makes a semaphore a member.
    ///
    /// # Errors
    /// [`AddError`]
    pub fn add_semaphore(
        &self,
        _at: &impl TaskLevel,
        semaphore: &Semaphore,
    ) -> Result<Member, AddError> {
        self.add(semaphore.raw(), semaphore.max())
    }

    /// Waits until a member has something. `None` if none had in time.
    ///
    /// # Panics
    /// In a critical section or with pre-emption deferred, unless the time is [`Ticks::NONE`].
    pub fn select(&self, _ctx: &TaskContext, timeout: impl Into<Ticks>) -> Option<Member> {
        self.set.select(timeout.into()).map(Member)
    }
}
