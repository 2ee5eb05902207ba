//! Queue sets: a task waits for the first of several queues and semaphores.

use super::queue::{Items, Members, Queue, Raw, may_wait};
use super::semaphore::Semaphore;
use crate::context::{TaskContext, TaskLevel};
use crate::ffi;
use crate::time::Ticks;
use alloc::sync::Arc;
use core::fmt;
use core::sync::atomic::{AtomicUsize, Ordering};

/// A member of a set, as returned by [`QueueSet::select`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Member(usize);

/// A queue or semaphore cannot become a member.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AddError {
    /// The set has no room for all items that its members and the new one can hold together.
    #[error("the set is too small for another member of this capacity")]
    SetFull,
    /// The member is not empty, or is already in a set.
    #[error("the member is not empty, or in a set already")]
    NotFree,
}

/// A set. Members stay in it for their whole life.
///
/// Each time [`QueueSet::select`] returns a member, the task takes one item from it without
/// waiting. Items of a member must not be taken in any other way.
#[derive(Clone)]
pub struct QueueSet {
    set: Arc<Members>,
}

impl fmt::Debug for QueueSet {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("QueueSet")
    }
}

impl QueueSet {
    /// Makes a set for members that together hold `capacity` items.
    ///
    /// # Panics
    /// If the capacity is zero.
    #[must_use]
    pub fn new(_at: &impl TaskLevel, capacity: usize) -> Self {
        let set = Arc::new(Members {
            raw: Raw::new(),
            items: Items::new(capacity),
            promised: AtomicUsize::new(0),
        });
        // SAFETY: block and items are ours, and live as long as the set.
        unsafe { ffi::xQueueCreateSetStatic(capacity, set.items.place(), set.raw.handle()) };
        Self { set }
    }

    fn add(&self, member: &Raw, capacity: usize) -> Result<Member, AddError> {
        let promised = self.set.promised.load(Ordering::Relaxed) + capacity;
        if promised > self.set.items.count() {
            return Err(AddError::SetFull);
        }
        // One critical section: the member must not fill between the check and the moment it joins.
        if !ffi::critical(|| member.join(&self.set)) {
            return Err(AddError::NotFree);
        }
        self.set.promised.store(promised, Ordering::Relaxed);
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
        self.add(queue.raw(), queue.capacity())
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

    /// Waits until a member has an item. Returns `None` at a time-out.
    ///
    /// # Panics
    /// In a critical section or with pre-emption deferred, unless the time is [`Ticks::NONE`].
    pub fn select(&self, _ctx: &TaskContext, timeout: impl Into<Ticks>) -> Option<Member> {
        let timeout = may_wait(timeout.into());
        // SAFETY: a set of this life, and the caller is a task that may block.
        let member = unsafe { ffi::xQueueSelectFromSet(self.set.raw.handle(), timeout) };
        (!member.is_null()).then_some(Member(member as usize))
    }
}
