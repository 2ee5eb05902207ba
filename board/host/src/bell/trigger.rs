//! A futex as the trigger of an iceoryx2 event.
//!
//! The event itself (its state, its name, who may open it) is iceoryx2's; only what the listener
//! sleeps on is ours. The triggers that iceoryx2 brings were measured and are described in
//! `docs/decisions/0002-host-board-over-iceoryx2-building-blocks.md`.
//!
//! One word: EMPTY, PENDING (rung) or SLEEPING (the listener sleeps). The kernel is called only if
//! the listener sleeps. Nothing in it belongs to a process, so a death at any point leaves no harm.

use core::cell::Cell;
use core::ptr::NonNull;
use core::sync::atomic::AtomicU32;
use core::sync::atomic::Ordering::SeqCst;
use core::time::Duration;

use iceoryx2_bb_elementary_traits::testing::abandonable::Abandonable;
use iceoryx2_bb_posix::access_mode::AccessMode;
use iceoryx2_bb_system_types::file_name::FileName;
use iceoryx2_bb_system_types::path::Path;
use iceoryx2_cal::dynamic_storage::posix_shared_memory as shm;
use iceoryx2_cal::dynamic_storage::{DynamicStorage, DynamicStorageBuilder};
use iceoryx2_cal::dynamic_storage::{DynamicStorageCreateError, DynamicStorageOpenError};
use iceoryx2_cal::event::event_state::EventState;
use iceoryx2_cal::event::trigger::{Configuration, HandlerInterface, State, WaiterInterface};
use iceoryx2_cal::event::{
    ListenerCreateError, ListenerWaitError, NotifierNotifyError, NotifierOpenError,
};
use iceoryx2_cal::named_concept::{NamedConceptBuilder, NamedConceptConfiguration};
use iceoryx2_cal::named_concept::{
    NamedConceptMgmt, NamedConceptPathHintRemoveError, NamedConceptRemoveError,
};
use rustix::io::Errno;
use rustix::thread::futex;

use crate::clock;
use crate::segment::Words;

const EMPTY: u32 = 0;
const PENDING: u32 = 1;
const SLEEPING: u32 = 2;

/// A cache line, so that a ring touches nothing else.
type FutexWords = Words<16>;
type FutexStorage = shm::Storage<FutexWords>;

/// The ringing end.
#[derive(Debug)]
pub(crate) struct FutexHandle {
    storage: FutexStorage,
}

/// The sleeping end.
#[derive(Debug)]
pub(crate) struct FutexWaiter {
    storage: FutexStorage,
}

impl FutexHandle {
    /// Opens the futex of the event of this name.
    pub(crate) fn open(name: &FileName, prefix: &FileName) -> Result<Self, NotifierOpenError> {
        let opened = <FutexStorage as DynamicStorage<FutexWords>>::Builder::new(name)
            .config(&storage_config(prefix))
            .has_ownership(false)
            .open(AccessMode::ReadWrite);
        match opened {
            Ok(storage) => Ok(Self { storage }),
            Err(DynamicStorageOpenError::DoesNotExist) => Err(NotifierOpenError::DoesNotExist),
            Err(DynamicStorageOpenError::InitializationNotYetFinalized) => {
                Err(NotifierOpenError::InitializationNotYetFinalized)
            }
            Err(DynamicStorageOpenError::VersionMismatch) => {
                Err(NotifierOpenError::VersionMismatch)
            }
            Err(DynamicStorageOpenError::InternalError) => Err(NotifierOpenError::InternalFailure),
        }
    }

    /// Wakes the listener if it sleeps; else its next sleep ends at once. Never blocks.
    pub(crate) fn wake(&self) {
        let word = word(&self.storage);
        // Pairs with the compare-exchange in `sleep`: either that sees PENDING, or this sees
        // SLEEPING.
        if word.swap(PENDING, SeqCst) == SLEEPING {
            // Nobody to wake is no error: the listener may have just died.
            let _ = futex::wake(word, futex::Flags::empty(), 1);
        }
    }
}

thread_local! {
    /// Whether an event of this thread has come as far as its trigger.
    static WOKEN: Cell<bool> = const { Cell::new(false) };
}

/// Whether iceoryx2 has called the trigger during `notify`; it marks the event before it does.
pub(crate) fn has_woken<T>(notify: impl FnOnce() -> T) -> bool {
    WOKEN.set(false);
    let _outcome = notify();
    WOKEN.get()
}

impl<E, S> HandlerInterface<E, (), S> for FutexHandle
where
    E: EventState,
    S: DynamicStorage<State<E, ()>>,
{
    fn open(name: &FileName, config: &Configuration, _: &()) -> Result<Self, NotifierOpenError> {
        Self::open(name, &config.prefix)
    }

    fn notify(&self) -> Result<(), NotifierNotifyError> {
        self.wake();
        WOKEN.set(true);
        Ok(())
    }
}

impl<E, S> WaiterInterface<E, (), S> for FutexWaiter
where
    E: EventState,
    S: DynamicStorage<State<E, ()>>,
{
    const IS_FILE_DESCRIPTOR_BASED: bool = false;

    unsafe fn remove(
        name: &FileName,
        config: &Configuration,
    ) -> Result<bool, NamedConceptRemoveError> {
        // SAFETY: the caller promises that nobody uses the event any more.
        unsafe { FutexStorage::remove_cfg(name, &storage_config(&config.prefix)) }
    }

    fn remove_path_hint(_: &Path) -> Result<(), NamedConceptPathHintRemoveError> {
        Ok(())
    }

    fn create(
        name: &FileName,
        config: &Configuration,
        mgmt: &mut core::mem::MaybeUninit<()>,
    ) -> Result<Self, ListenerCreateError> {
        mgmt.write(());
        let created = <FutexStorage as DynamicStorage<FutexWords>>::Builder::new(name)
            .config(&storage_config(&config.prefix))
            .has_ownership(true)
            // Fresh shared memory is zero, which is EMPTY.
            .initializer(|_, _| true)
            .create();
        match created {
            Ok(storage) => Ok(Self { storage }),
            Err(DynamicStorageCreateError::AlreadyExists) => {
                Err(ListenerCreateError::AlreadyExists)
            }
            Err(DynamicStorageCreateError::InsufficientPermissions) => {
                Err(ListenerCreateError::InsufficientPermissions)
            }
            Err(_) => Err(ListenerCreateError::InternalFailure),
        }
    }

    fn try_wait(&self) -> Result<(), ListenerWaitError> {
        word(&self.storage).store(EMPTY, SeqCst);
        Ok(())
    }

    fn timed_wait(&self, timeout: Duration) -> Result<(), ListenerWaitError> {
        sleep(word(&self.storage), Some(timeout))
    }

    fn blocking_wait(&self) -> Result<(), ListenerWaitError> {
        sleep(word(&self.storage), None)
    }

    fn empty_buffer(&self) -> Result<(), ListenerWaitError> {
        word(&self.storage).store(EMPTY, SeqCst);
        Ok(())
    }
}

impl Abandonable for FutexHandle {
    unsafe fn abandon_in_place(mut this: NonNull<Self>) {
        // SAFETY: the caller promises a valid, constructed `Self` that is not used afterwards.
        unsafe {
            FutexStorage::abandon_in_place(NonNull::from_mut(&mut this.as_mut().storage));
        }
    }
}

impl Abandonable for FutexWaiter {
    unsafe fn abandon_in_place(mut this: NonNull<Self>) {
        // SAFETY: the caller promises a valid, constructed `Self` that is not used afterwards.
        unsafe {
            FutexStorage::abandon_in_place(NonNull::from_mut(&mut this.as_mut().storage));
        }
    }
}

/// Returns when rung, when `timeout` has passed, or on a signal; leaves the word EMPTY or PENDING.
fn sleep(word: &AtomicU32, timeout: Option<Duration>) -> Result<(), ListenerWaitError> {
    let timeout = timeout.map(|span| clock::timespec(span.as_nanos().min(u64::MAX.into()) as u64));
    // Pairs with the swap in `notify`.
    if word.compare_exchange(EMPTY, SLEEPING, SeqCst, SeqCst) == Err(PENDING) {
        return Ok(());
    }
    let slept = futex::wait(word, futex::Flags::empty(), SLEEPING, timeout.as_ref());
    // A ring that came in the meantime stays PENDING and is taken by the caller.
    let _ = word.compare_exchange(SLEEPING, EMPTY, SeqCst, SeqCst);
    match slept {
        Ok(()) | Err(Errno::AGAIN | Errno::TIMEDOUT) => Ok(()),
        Err(Errno::INTR) => Err(ListenerWaitError::InterruptSignal),
        Err(_) => Err(ListenerWaitError::InternalFailure),
    }
}

fn word(storage: &FutexStorage) -> &AtomicU32 {
    &storage.get().as_slice()[0]
}

/// The futex lies beside the event under the same name; iceoryx2 tells them apart by their types.
fn storage_config(prefix: &FileName) -> shm::Configuration<FutexWords> {
    shm::Configuration::default().prefix(prefix)
}
