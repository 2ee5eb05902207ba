//! A futex as the trigger of an iceoryx2 event.
//!
//! iceoryx2 provides the event itself (its state, its name, its permissions); this module defines
//! only the word on which the listener sleeps.
//! `docs/decisions/0002-host-board-over-iceoryx2-building-blocks.md` describes and compares
//! iceoryx2's own triggers.
//!
//! One word in the memory of the event: EMPTY, PENDING (rung) or SLEEPING (the listener sleeps). A
//! ringer calls the kernel only if the listener sleeps. No process owns the word, so a death at any
//! point does no harm. The word is only compared, so a peer that writes an invalid value can only
//! wake the listener or leave it asleep until its deadline.

use core::mem::MaybeUninit;
use core::ptr::NonNull;
use core::sync::atomic::AtomicU32;
use core::sync::atomic::Ordering::SeqCst;
use core::time::Duration;

use iceoryx2_bb_elementary_traits::testing::abandonable::Abandonable;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use iceoryx2_bb_system_types::file_name::FileName;
use iceoryx2_bb_system_types::path::Path;
use iceoryx2_cal::dynamic_storage::DynamicStorage;
use iceoryx2_cal::event::event_state::EventState;
use iceoryx2_cal::event::trigger::{Configuration, HandlerInterface, State, WaiterInterface};
use iceoryx2_cal::event::{
    ListenerCreateError, ListenerWaitError, NotifierNotifyError, NotifierOpenError,
};
use iceoryx2_cal::named_concept::{NamedConceptPathHintRemoveError, NamedConceptRemoveError};
use rustix::io::Errno;
use rustix::thread::futex;

use crate::clock;

const EMPTY: u32 = 0;
const PENDING: u32 = 1;
const SLEEPING: u32 = 2;

/// The word on which the listener sleeps. The initial content is zero.
#[derive(Debug, Default)]
#[repr(C)]
pub struct Futex(AtomicU32);

// SAFETY: a 32-bit atomic: self-contained, and valid for any bit pattern.
unsafe impl ZeroCopySend for Futex {}

impl Futex {
    /// Wakes the listener if it sleeps; otherwise its next sleep ends at once. Never blocks.
    pub(super) fn wake(&self) {
        // Pairs with the compare-exchange in `sleep`: either `sleep` sees PENDING, or this swap
        // sees SLEEPING.
        match self.0.swap(PENDING, SeqCst) {
            EMPTY | PENDING => {}
            // SLEEPING, or a value that neither end writes. It is not an error if no process
            // sleeps, because the listener may have just died.
            _ => drop(futex::wake(&self.0, futex::Flags::empty(), 1)),
        }
    }

    /// Clears a pending ring.
    fn take(&self) {
        // Pairs with the swap in `wake`: a later ring finds EMPTY. This is a swap, not a store,
        // because it must read the PENDING that it replaces, so that the drain sees its bits.
        self.0.swap(EMPTY, SeqCst);
    }

    /// Sleeps until rung, until `timeout` has passed, or until a signal; leaves the word EMPTY or
    /// PENDING.
    fn sleep(&self, timeout: Option<Duration>) -> Result<(), ListenerWaitError> {
        let timeout =
            timeout.map(|span| clock::timespec(span.as_nanos().min(u64::MAX.into()) as u64));
        // Pairs with the swap in `wake`.
        match self.0.compare_exchange(EMPTY, SLEEPING, SeqCst, SeqCst) {
            Ok(_) => {}
            Err(PENDING) => return Ok(()),
            Err(_) => {
                // Neither end writes this value. The caller polls and then sleeps again.
                self.take();
                return Ok(());
            }
        }
        let slept = futex::wait(&self.0, futex::Flags::empty(), SLEEPING, timeout.as_ref());
        // Pairs with the swap in `wake`: a ring in between stays PENDING, and the caller handles
        // it.
        let _ = self.0.compare_exchange(SLEEPING, EMPTY, SeqCst, SeqCst);
        match slept {
            Ok(()) | Err(Errno::AGAIN | Errno::TIMEDOUT) => Ok(()),
            Err(Errno::INTR) => Err(ListenerWaitError::InterruptSignal),
            Err(_) => Err(ListenerWaitError::InternalFailure),
        }
    }
}

/// The ringer's end: a pointer to the futex in the storage of the event.
#[derive(Debug)]
pub struct FutexHandle(NonNull<Futex>);

/// The sleeper's end: a pointer to the futex in the storage of the event.
#[derive(Debug)]
pub struct FutexWaiter(NonNull<Futex>);

// SAFETY: only shared references to an atomic can be obtained from it.
unsafe impl Send for FutexHandle {}
// SAFETY: as above.
unsafe impl Sync for FutexHandle {}
// SAFETY: as above.
unsafe impl Send for FutexWaiter {}
// SAFETY: as above.
unsafe impl Sync for FutexWaiter {}

impl FutexHandle {
    fn futex(&self) -> &Futex {
        // SAFETY: iceoryx2 keeps a handle beside the storage that holds the word, and drops the
        // handle first; the mapping does not move.
        unsafe { self.0.as_ref() }
    }
}

impl FutexWaiter {
    fn futex(&self) -> &Futex {
        // SAFETY: iceoryx2 keeps a waiter beside the storage that holds the word, and drops the
        // waiter first; the mapping does not move.
        unsafe { self.0.as_ref() }
    }
}

impl<E, S> HandlerInterface<E, Futex, S> for FutexHandle
where
    E: EventState,
    S: DynamicStorage<State<E, Futex>>,
{
    fn open(_: &FileName, _: &Configuration, futex: &Futex) -> Result<Self, NotifierOpenError> {
        Ok(Self(NonNull::from(futex)))
    }

    fn notify(&self) -> Result<(), NotifierNotifyError> {
        self.futex().wake();
        Ok(())
    }
}

impl<E, S> WaiterInterface<E, Futex, S> for FutexWaiter
where
    E: EventState,
    S: DynamicStorage<State<E, Futex>>,
{
    const IS_FILE_DESCRIPTOR_BASED: bool = false;

    unsafe fn remove(_: &FileName, _: &Configuration) -> Result<bool, NamedConceptRemoveError> {
        // The trigger is removed together with the storage of the event.
        Ok(true)
    }

    fn remove_path_hint(_: &Path) -> Result<(), NamedConceptPathHintRemoveError> {
        Ok(())
    }

    fn create(
        _: &FileName,
        _: &Configuration,
        futex: &mut MaybeUninit<Futex>,
    ) -> Result<Self, ListenerCreateError> {
        Ok(Self(NonNull::from(futex.write(Futex::default()))))
    }

    fn try_wait(&self) -> Result<(), ListenerWaitError> {
        self.futex().take();
        Ok(())
    }

    fn timed_wait(&self, timeout: Duration) -> Result<(), ListenerWaitError> {
        self.futex().sleep(Some(timeout))
    }

    fn blocking_wait(&self) -> Result<(), ListenerWaitError> {
        self.futex().sleep(None)
    }

    fn empty_buffer(&self) -> Result<(), ListenerWaitError> {
        self.futex().take();
        Ok(())
    }
}

impl Abandonable for FutexHandle {
    unsafe fn abandon_in_place(_: NonNull<Self>) {
        // The handle owns nothing.
    }
}

impl Abandonable for FutexWaiter {
    unsafe fn abandon_in_place(_: NonNull<Self>) {
        // The waiter owns nothing.
    }
}
