//! Queues of the kernel, which are also its semaphores, mutexes and sets.

use super::shared::Shared;
use super::task;
use super::{Life, ffi};
use crate::context::Context;
use crate::port;
use crate::time::Ticks;
use crate::{InUse, TimedOut};
#[cfg(feature = "alloc")]
use alloc::{boxed::Box, sync::Arc};
use core::cell::UnsafeCell;
use core::ffi::c_void;
use core::mem::{ManuallyDrop, MaybeUninit};
use core::ptr;
use core::sync::atomic::{AtomicUsize, Ordering};

const TYPE_QUEUE: u8 = 0;
const TYPE_MUTEX: u8 = 1;
const TYPE_BINARY: u8 = 3;
/// At the back of the queue, as `queueSEND_TO_BACK`.
const BACK: ffi::Base = 0;
/// At the front of the queue, as `queueSEND_TO_FRONT`.
const FRONT: ffi::Base = 1;

/// The kernel's control block of a queue, a semaphore, a mutex or a set. Stays where it is while
/// the kernel knows it.
pub(crate) struct Raw {
    block: UnsafeCell<[usize; ffi::QUEUE_WORDS]>,
    pub(crate) life: Life,
    /// Holds the set that this is a member of, which the kernel points to.
    set: UnsafeCell<Option<Shared<Set>>>,
}

// SAFETY: the block is the kernel's, which is called from the core's thread only: every call wants
// a context, and no context leaves its thread. The set is written once, on that thread.
unsafe impl Send for Raw {}
// SAFETY: as above.
unsafe impl Sync for Raw {}

impl Raw {
    pub(crate) const fn new() -> Self {
        Self {
            block: UnsafeCell::new([0; ffi::QUEUE_WORDS]),
            life: Life::none(),
            set: UnsafeCell::new(None),
        }
    }

    /// The kernel's handle.
    ///
    /// # Panics
    /// If this was made for an earlier life of the kernel.
    fn handle(&self) -> *mut c_void {
        self.life.assert_current();
        self.block.get().cast()
    }

    fn claim(&self) -> Result<*mut c_void, InUse> {
        self.life.claim()?;
        // SAFETY: the object is new, so nothing points to its set.
        unsafe { *self.set.get() = None };
        Ok(self.block.get().cast())
    }

    pub(crate) fn make_binary(&self) -> Result<(), InUse> {
        let block = self.claim()?;
        // SAFETY: the block is ours and stays; items of no bytes have no storage.
        unsafe { ffi::xQueueGenericCreateStatic(1, 0, ptr::null_mut(), block, TYPE_BINARY) };
        Ok(())
    }

    pub(crate) fn make_counting(&self, max: usize, initial: usize) -> Result<(), InUse> {
        let block = self.claim()?;
        // SAFETY: the block is ours and stays.
        unsafe { ffi::xQueueCreateCountingSemaphoreStatic(max, initial, block) };
        Ok(())
    }

    pub(crate) fn make_mutex(&self) -> Result<(), InUse> {
        let block = self.claim()?;
        // SAFETY: the block is ours and stays.
        unsafe { ffi::xQueueCreateMutexStatic(TYPE_MUTEX, block) };
        Ok(())
    }

    /// Counts a semaphore up, or unlocks a mutex. Whether it could be counted.
    pub(crate) fn give<C: Context>(&self, ctx: &C) -> bool {
        let handle = self.handle();
        let mut woken = 0;
        // SAFETY: a semaphore of this life; the call for interrupts in interrupts.
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
        if timeout != Ticks::NONE {
            port::assert_may_block();
        }
        // SAFETY: a semaphore of this life, and the caller is a task that may block.
        let taken = unsafe { ffi::xQueueSemaphoreTake(self.handle(), timeout.0) };
        if taken == ffi::PASS {
            Ok(())
        } else {
            Err(TimedOut)
        }
    }

    /// Takes a semaphore if it can be had at once.
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

    /// Items that wait, or the count of a semaphore.
    pub(crate) fn count<C: Context>(&self, _ctx: &C) -> usize {
        let handle = self.handle();
        // SAFETY: a queue of this life; the call for interrupts in interrupts.
        unsafe {
            if C::IN_INTERRUPT {
                ffi::uxQueueMessagesWaitingFromISR(handle)
            } else {
                ffi::uxQueueMessagesWaiting(handle)
            }
        }
    }

    /// Whether the running task holds this mutex.
    pub(crate) fn is_mine(&self) -> bool {
        // SAFETY: a mutex of this life; compares two pointers.
        unsafe { ffi::xQueueGetMutexHolder(self.handle()) == task::current_tcb() }
    }

    /// Makes this a member of a set. Whether it was empty and in none.
    fn join(&self, set: &Shared<Set>) -> bool {
        // SAFETY: both are of this life. The kernel will point from here to the set, which is held
        // below for as long.
        let joined = unsafe { ffi::xQueueAddToSet(self.handle(), set.raw.handle()) == ffi::PASS };
        if joined {
            // SAFETY: on the core's thread; there was no set, so nothing refers to this place.
            unsafe { *self.set.get() = Some(set.clone()) };
        }
        joined
    }

    /// What a set says about a member.
    pub(crate) fn address(&self) -> usize {
        self.block.get() as usize
    }
}

/// Where a typed queue keeps its items.
pub(crate) enum Storage<T: 'static> {
    None,
    Static(*mut MaybeUninit<T>),
    #[cfg(feature = "alloc")]
    Heap(Box<[UnsafeCell<MaybeUninit<T>>]>),
}

/// A queue of values of one type. The kernel copies their bytes; a value that was sent is forgotten
/// by the sender, so that there is one owner at any time.
pub(crate) struct Typed<T: 'static> {
    pub(crate) raw: Raw,
    storage: UnsafeCell<Storage<T>>,
    capacity: AtomicUsize,
}

// SAFETY: as for `Raw`; values go from task to task, so they must be `Send`.
unsafe impl<T: Send> Send for Typed<T> {}
// SAFETY: as above.
unsafe impl<T: Send> Sync for Typed<T> {}

impl<T: Send> Typed<T> {
    pub(crate) const fn new() -> Self {
        Self {
            raw: Raw::new(),
            storage: UnsafeCell::new(Storage::None),
            capacity: AtomicUsize::new(0),
        }
    }

    #[cfg(feature = "alloc")]
    pub(crate) fn on_heap(capacity: usize) -> Shared<Self> {
        let items = (0..capacity)
            .map(|_| UnsafeCell::new(MaybeUninit::uninit()))
            .collect();
        let queue = Arc::new(Self::new());
        let made = queue.make(Storage::Heap(items), capacity);
        debug_assert!(made.is_ok(), "new memory is unused");
        Shared::Heap(queue)
    }

    /// Makes the queue in its place, which does not move any more.
    pub(crate) fn make(&self, storage: Storage<T>, capacity: usize) -> Result<(), InUse> {
        assert!(capacity > 0, "a queue of no items");
        let block = self.raw.claim()?;
        self.capacity.store(capacity, Ordering::Relaxed);
        // SAFETY: the object is new: nothing else uses its storage, which lives as long as it.
        unsafe {
            *self.storage.get() = storage;
            let items = match &*self.storage.get() {
                _ if size_of::<T>() == 0 => ptr::null_mut(),
                Storage::None => ptr::null_mut(),
                Storage::Static(items) => items.cast(),
                #[cfg(feature = "alloc")]
                Storage::Heap(items) => UnsafeCell::raw_get(items.as_ptr()).cast(),
            };
            ffi::xQueueGenericCreateStatic(capacity, size_of::<T>(), items, block, TYPE_QUEUE);
        }
        Ok(())
    }

    pub(crate) fn capacity(&self) -> usize {
        self.capacity.load(Ordering::Relaxed)
    }

    fn send_to<C: Context>(
        &self,
        ctx: &C,
        value: T,
        timeout: Ticks,
        place: ffi::Base,
    ) -> Result<(), T> {
        let handle = self.raw.handle();
        let value = ManuallyDrop::new(value);
        let item = ptr::from_ref(&value).cast();
        let mut woken = 0;
        // SAFETY: a queue of this life with items of this size. The bytes are copied; if they are,
        // the value is not used here any more.
        let sent = unsafe {
            if C::IN_INTERRUPT {
                ffi::xQueueGenericSendFromISR(handle, item, &mut woken, place)
            } else {
                ffi::xQueueGenericSend(handle, item, timeout.0, place)
            }
        };
        ctx.woken(woken != 0);
        if sent == ffi::PASS {
            Ok(())
        } else {
            Err(ManuallyDrop::into_inner(value))
        }
    }

    /// The caller has checked that it may wait for this time.
    pub(crate) fn send<C: Context>(&self, ctx: &C, value: T, timeout: Ticks) -> Result<(), T> {
        self.send_to(ctx, value, timeout, BACK)
    }

    /// As `send`, before all that wait.
    pub(crate) fn send_first<C: Context>(
        &self,
        ctx: &C,
        value: T,
        timeout: Ticks,
    ) -> Result<(), T> {
        self.send_to(ctx, value, timeout, FRONT)
    }

    /// The caller has checked that it may wait for this time.
    pub(crate) fn receive<C: Context>(&self, ctx: &C, timeout: Ticks) -> Option<T> {
        let handle = self.raw.handle();
        let mut item = MaybeUninit::<T>::uninit();
        let place = item.as_mut_ptr().cast();
        let mut woken = 0;
        // SAFETY: a queue of this life; what it passes was sent, and leaves the queue.
        unsafe {
            let received = if C::IN_INTERRUPT {
                ffi::xQueueReceiveFromISR(handle, place, &mut woken)
            } else {
                ffi::xQueueReceive(handle, place, timeout.0)
            };
            ctx.woken(woken != 0);
            (received == ffi::PASS).then(|| item.assume_init())
        }
    }

    /// A copy of the first item, which stays.
    pub(crate) fn peek(&self, timeout: Ticks) -> Option<T>
    where
        T: Copy,
    {
        let mut item = MaybeUninit::<T>::uninit();
        // SAFETY: as `receive`; a value that is `Copy` may be in two places.
        unsafe {
            let seen = ffi::xQueuePeek(self.raw.handle(), item.as_mut_ptr().cast(), timeout.0);
            (seen == ffi::PASS).then(|| item.assume_init())
        }
    }
}

impl<T: 'static> Drop for Typed<T> {
    fn drop(&mut self) {
        // What is left is dropped if the kernel may be asked for it here, and leaked otherwise.
        if !self.raw.life.is_current() || !port::in_task() {
            return;
        }
        loop {
            let mut item = MaybeUninit::<T>::uninit();
            let block = self.raw.block.get().cast();
            // SAFETY: as `receive`; without waiting.
            unsafe {
                if ffi::xQueueReceive(block, item.as_mut_ptr().cast(), 0) != ffi::PASS {
                    return;
                }
                item.assume_init_drop();
            }
        }
    }
}

/// A set of queues and semaphores: a queue of the members that have something.
pub(crate) struct Set {
    raw: Raw,
    storage: UnsafeCell<Storage<usize>>,
    capacity: AtomicUsize,
    /// How many of them the members could fill.
    promised: AtomicUsize,
}

// SAFETY: as for `Raw`; what is stored are addresses that are only compared.
unsafe impl Send for Set {}
// SAFETY: as above.
unsafe impl Sync for Set {}

impl Set {
    pub(crate) const fn new() -> Self {
        Self {
            raw: Raw::new(),
            storage: UnsafeCell::new(Storage::None),
            capacity: AtomicUsize::new(0),
            promised: AtomicUsize::new(0),
        }
    }

    #[cfg(feature = "alloc")]
    pub(crate) fn on_heap(capacity: usize) -> Shared<Self> {
        let items = (0..capacity)
            .map(|_| UnsafeCell::new(MaybeUninit::uninit()))
            .collect();
        let set = Arc::new(Self::new());
        let made = set.make(Storage::Heap(items), capacity);
        debug_assert!(made.is_ok(), "new memory is unused");
        Shared::Heap(set)
    }

    pub(crate) fn make(&self, storage: Storage<usize>, capacity: usize) -> Result<(), InUse> {
        assert!(capacity > 0, "a set of no items");
        let block = self.raw.claim()?;
        self.capacity.store(capacity, Ordering::Relaxed);
        self.promised.store(0, Ordering::Relaxed);
        // SAFETY: as in `Typed::make`.
        unsafe {
            *self.storage.get() = storage;
            let items = match &*self.storage.get() {
                Storage::None => ptr::null_mut(),
                Storage::Static(items) => items.cast(),
                #[cfg(feature = "alloc")]
                Storage::Heap(items) => UnsafeCell::raw_get(items.as_ptr()).cast(),
            };
            ffi::xQueueCreateSetStatic(capacity, items, block);
        }
        Ok(())
    }

    /// Whether there is room for what a member of this capacity could announce; then it is kept.
    pub(crate) fn promise(&self, items: usize) -> bool {
        let promised = self.promised.load(Ordering::Relaxed) + items;
        let fits = promised <= self.capacity.load(Ordering::Relaxed);
        if fits {
            self.promised.store(promised, Ordering::Relaxed);
        }
        fits
    }

    /// Gives back a promise.
    pub(crate) fn release(&self, items: usize) {
        let promised = self.promised.load(Ordering::Relaxed);
        self.promised.store(promised - items, Ordering::Relaxed);
    }

    /// The address of the member that has something, if one has in time.
    pub(crate) fn select(&self, timeout: Ticks) -> Option<usize> {
        if timeout != Ticks::NONE {
            port::assert_may_block();
        }
        // SAFETY: a set of this life, and the caller is a task that may block.
        let member = unsafe { ffi::xQueueSelectFromSet(self.raw.handle(), timeout.0) };
        (!member.is_null()).then_some(member as usize)
    }
}

/// Makes a queue or a semaphore a member of a set.
pub(crate) fn join(set: &Shared<Set>, member: &Raw) -> bool {
    member.join(set)
}
