//! Queues of the kernel, which are also its semaphores, mutexes and sets; queues of values.

use super::Life;
use crate::TimedOut;
use crate::context::{Context, TaskContext, TaskLevel};
use crate::ffi;
use crate::port;
use crate::time::Ticks;
use alloc::{boxed::Box, sync::Arc};
use core::cell::UnsafeCell;
use core::ffi::c_void;
use core::fmt;
use core::mem::{ManuallyDrop, MaybeUninit};
use core::ptr;
use core::sync::atomic::AtomicUsize;

const TYPE_QUEUE: u8 = 0;
const TYPE_MUTEX: u8 = 1;
/// Sends to the back of the queue, as `queueSEND_TO_BACK`.
const BACK: ffi::Base = 0;

/// The kernel's control block of a queue, a semaphore, a mutex or a set. It is made once, at its
/// final place.
pub(crate) struct Raw {
    block: UnsafeCell<[usize; ffi::QUEUE_WORDS]>,
    life: Life,
    /// The set that contains this. It is kept alive because the kernel points to it.
    set: UnsafeCell<Option<Arc<Members>>>,
}

// SAFETY: the block is the kernel's, which is called only on the core's thread: every call needs a
// context, and no context leaves its thread. The set is written once, on that thread.
unsafe impl Send for Raw {}
// SAFETY: as above.
unsafe impl Sync for Raw {}

impl Raw {
    pub(crate) fn new() -> Self {
        Self {
            block: UnsafeCell::new([0; ffi::QUEUE_WORDS]),
            life: Life::current(),
            set: UnsafeCell::new(None),
        }
    }

    /// Returns the kernel's handle.
    ///
    /// # Panics
    /// If the object was made in an earlier life of the kernel.
    pub(super) fn handle(&self) -> *mut c_void {
        self.life.assert_current();
        self.block.get().cast()
    }

    pub(crate) fn make_semaphore(&self, max: usize, initial: usize) {
        // SAFETY: the block is ours and stays.
        unsafe { ffi::xQueueCreateCountingSemaphoreStatic(max, initial, self.handle()) };
    }

    pub(crate) fn make_mutex(&self) {
        // SAFETY: the block is ours and stays.
        unsafe { ffi::xQueueCreateMutexStatic(TYPE_MUTEX, self.handle()) };
    }

    /// Counts a semaphore up, or unlocks a mutex. Returns whether the count could rise.
    pub(crate) fn give<C: Context>(&self, ctx: &C) -> bool {
        let handle = self.handle();
        let mut woken = 0;
        // SAFETY: a semaphore of this life; a handler makes the call for interrupts.
        let given = unsafe {
            if C::IN_INTERRUPT {
                ffi::xQueueGiveFromISR(handle, &mut woken)
            } else {
                ffi::xQueueGenericSend(handle, ptr::null(), 0, BACK)
            }
        };
        ctx.woken(woken != 0);
        given == ffi::PASS
    }

    /// Waits for a semaphore or a mutex.
    pub(crate) fn take(&self, timeout: Ticks) -> Result<(), TimedOut> {
        let timeout = may_wait(timeout);
        // SAFETY: a semaphore of this life, and the caller is a task that may block.
        let taken = unsafe { ffi::xQueueSemaphoreTake(self.handle(), timeout) };
        if taken == ffi::PASS {
            Ok(())
        } else {
            Err(TimedOut)
        }
    }

    /// Takes a semaphore if it can do so at once.
    pub(crate) fn try_take<C: Context>(&self, ctx: &C) -> bool {
        if !C::IN_INTERRUPT {
            return self.take(Ticks::NONE).is_ok();
        }
        let mut woken = 0;
        // SAFETY: a semaphore of this life, whose items have no bytes.
        let taken =
            unsafe { ffi::xQueueReceiveFromISR(self.handle(), ptr::null_mut(), &mut woken) };
        ctx.woken(woken != 0);
        taken == ffi::PASS
    }

    /// Returns whether the running task holds this mutex.
    pub(crate) fn is_mine(&self) -> bool {
        // SAFETY: a mutex of this life; compares two pointers.
        unsafe { ffi::xQueueGetMutexHolder(self.handle()) == ffi::current_tcb() }
    }

    /// Makes this a member of a set. Returns `false` if it is not empty or is already in a set.
    pub(super) fn join(&self, set: &Arc<Members>) -> bool {
        // SAFETY: both are of this life. The kernel will point from here to the set, which the line
        // below keeps alive.
        let joined = unsafe { ffi::xQueueAddToSet(self.handle(), set.raw.handle()) == ffi::PASS };
        if joined {
            // SAFETY: on the core's thread; there was no set, so no reference to this field exists.
            unsafe { *self.set.get() = Some(Arc::clone(set)) };
        }
        joined
    }

    /// Returns the address by which the set identifies a member.
    pub(super) fn address(&self) -> usize {
        self.block.get() as usize
    }
}

/// Converts a time-out for the kernel.
///
/// # Panics
/// If the caller may not block, unless the time is [`Ticks::NONE`].
pub(super) fn may_wait(timeout: Ticks) -> ffi::Tick {
    if timeout != Ticks::NONE {
        port::assert_may_block();
    }
    timeout.0
}

/// Places for values; only the kernel accesses them.
pub(super) struct Items<T>(Box<[UnsafeCell<MaybeUninit<T>>]>);

impl<T> Items<T> {
    /// # Panics
    /// If `count` is zero.
    pub(super) fn new(count: usize) -> Self {
        assert!(count > 0, "a queue of no items");
        let items = (0..count).map(|_| UnsafeCell::new(MaybeUninit::uninit()));
        Self(items.collect())
    }

    pub(super) fn count(&self) -> usize {
        self.0.len()
    }

    /// Returns the address of the items. It is null for items of no bytes, as the kernel requires.
    pub(super) fn place(&self) -> *mut u8 {
        if size_of::<T>() == 0 {
            ptr::null_mut()
        } else {
            UnsafeCell::raw_get(self.0.as_ptr()).cast()
        }
    }
}

/// The queue of those members of a set that have an item.
pub(super) struct Members {
    pub(super) raw: Raw,
    pub(super) items: Items<usize>,
    /// The number of items that the present members can hold in total.
    pub(super) promised: AtomicUsize,
}

// SAFETY: as for `Raw`; the stored values are addresses, which are only compared.
unsafe impl Send for Members {}
// SAFETY: as above.
unsafe impl Sync for Members {}

/// There was no room. Returns the value to the sender.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the queue is full")]
pub struct QueueFull<T>(pub T);

/// The kernel copies the bytes of values. The sender forgets a value that was sent, so a value
/// always has one owner.
struct Values<T: 'static> {
    raw: Raw,
    items: Items<T>,
}

// SAFETY: as for `Raw`; values move from task to task, so they must be `Send`.
unsafe impl<T: Send> Send for Values<T> {}
// SAFETY: as above.
unsafe impl<T: Send> Sync for Values<T> {}

/// A queue: values of one type, first in, first out. Tasks and handlers send and receive.
///
/// Cloned handles refer to the same queue. If the last handle is dropped in a task, the values left
/// in the queue are dropped; elsewhere they are leaked. A handle that outlives its scheduler panics
/// when it is used in the next one.
pub struct Queue<T: 'static> {
    values: Arc<Values<T>>,
}

impl<T> Clone for Queue<T> {
    fn clone(&self) -> Self {
        Self {
            values: Arc::clone(&self.values),
        }
    }
}

impl<T> fmt::Debug for Queue<T> {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("Queue")
    }
}

impl<T: Send> Queue<T> {
    /// Makes a queue for `capacity` values.
    ///
    /// # Panics
    /// If the capacity is zero.
    #[must_use]
    pub fn new(_at: &impl TaskLevel, capacity: usize) -> Self {
        let values = Arc::new(Values {
            raw: Raw::new(),
            items: Items::new(capacity),
        });
        let (items, block) = (values.items.place(), values.raw.handle());
        // SAFETY: block and items are ours, and live as long as the queue.
        unsafe {
            ffi::xQueueGenericCreateStatic(capacity, size_of::<T>(), items, block, TYPE_QUEUE);
        }
        Self { values }
    }

    pub(super) fn raw(&self) -> &Raw {
        &self.values.raw
    }

    /// Sends a value; waits for room if the queue is full.
    ///
    /// # Errors
    /// [`QueueFull`] if there was no room in time.
    ///
    /// # Panics
    /// In a critical section or with pre-emption deferred, unless the time is [`Ticks::NONE`].
    pub fn send(
        &self,
        ctx: &TaskContext,
        value: T,
        timeout: impl Into<Ticks>,
    ) -> Result<(), QueueFull<T>> {
        self.send_within(ctx, value, may_wait(timeout.into()))
    }

    /// Sends a value if there is room.
    ///
    /// # Errors
    /// [`QueueFull`]
    pub fn try_send(&self, ctx: &impl Context, value: T) -> Result<(), QueueFull<T>> {
        self.send_within(ctx, value, 0)
    }

    fn send_within<C: Context>(
        &self,
        ctx: &C,
        value: T,
        timeout: ffi::Tick,
    ) -> Result<(), QueueFull<T>> {
        let handle = self.values.raw.handle();
        let value = ManuallyDrop::new(value);
        let item = ptr::from_ref(&value).cast();
        let mut woken = 0;
        // SAFETY: a queue of this life with items of this size. If the bytes are copied, the value
        // is not used here any more.
        let sent = unsafe {
            if C::IN_INTERRUPT {
                ffi::xQueueGenericSendFromISR(handle, item, &mut woken, BACK)
            } else {
                ffi::xQueueGenericSend(handle, item, timeout, BACK)
            }
        };
        ctx.woken(woken != 0);
        if sent == ffi::PASS {
            Ok(())
        } else {
            Err(QueueFull(ManuallyDrop::into_inner(value)))
        }
    }

    /// Waits for a value. Returns `None` if none arrived in time.
    ///
    /// # Panics
    /// As [`Queue::send`].
    pub fn receive(&self, ctx: &TaskContext, timeout: impl Into<Ticks>) -> Option<T> {
        self.receive_within(ctx, may_wait(timeout.into()))
    }

    /// Returns the first value, if there is one.
    pub fn try_receive(&self, ctx: &impl Context) -> Option<T> {
        self.receive_within(ctx, 0)
    }

    fn receive_within<C: Context>(&self, ctx: &C, timeout: ffi::Tick) -> Option<T> {
        let handle = self.values.raw.handle();
        let mut item = MaybeUninit::<T>::uninit();
        let place = item.as_mut_ptr().cast();
        let mut woken = 0;
        // SAFETY: a queue of this life; it passes a value that was sent, and removes it.
        unsafe {
            let received = if C::IN_INTERRUPT {
                ffi::xQueueReceiveFromISR(handle, place, &mut woken)
            } else {
                ffi::xQueueReceive(handle, place, timeout)
            };
            ctx.woken(woken != 0);
            (received == ffi::PASS).then(|| item.assume_init())
        }
    }

    /// Returns the largest number of values in the queue.
    #[must_use]
    pub fn capacity(&self) -> usize {
        self.values.items.count()
    }
}

impl<T: 'static> Drop for Values<T> {
    fn drop(&mut self) {
        // Remaining values are dropped if the kernel may be called here; otherwise they leak.
        if !self.raw.life.is_current() || !port::in_task() {
            return;
        }
        loop {
            let mut item = MaybeUninit::<T>::uninit();
            let block = self.raw.block.get().cast();
            // SAFETY: as in `receive_within`; does not wait.
            unsafe {
                if ffi::xQueueReceive(block, item.as_mut_ptr().cast(), 0) != ffi::PASS {
                    return;
                }
                item.assume_init_drop();
            }
        }
    }
}
