//! The lock.

use crate::cell::{self, opaque};
use crate::map::{self, TandemMap};
use crate::status::{TandemStatus, TandemStatus as S, status};
use core::ffi::c_void;
use tandem_shm::bare;
use tandem_shm::lock::{Acquired, Held, Lock, WORDS};
use tandem_shm::sync::spin;

/// Words of a lock.
pub const TANDEM_LOCK_WORDS: usize = 16;

const _: () = assert!(TANDEM_LOCK_WORDS == WORDS);

/// One end of a lock. Each task that takes the lock has its own. Must be static and initially zero.
#[repr(C)]
#[derive(Debug)]
pub struct TandemLock {
    /// Private.
    pub opaque: [usize; 13],
}

pub(crate) struct End {
    lock: Lock<'static>,
    held: Option<Held<'static>>,
}

opaque!(TandemLock, End, 0x03);

/// Waits for about `spins` spins (1 ..= 64) between two polls of a lock. May yield or sleep.
pub type TandemRelax = Option<unsafe extern "C" fn(context: *mut c_void, spins: u32)>;

/// Attaches to the lock in region `region`, as incarnation `generation` of core `core`, which must
/// be announced. If an earlier incarnation held the lock, it stays held: the next owner recovers
/// it. Tasks only; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_lock_attach(
    lock: *mut TandemLock,
    map: *const TandemMap,
    region: usize,
    core: u32,
    generation: u32,
) -> TandemStatus {
    map::attach(lock, map, region, |words, incarnations| {
        let incarnation = map::incarnation(core, generation)?;
        let lock = bare::lock(words, incarnation, incarnations)?;
        Ok(End { lock, held: None })
    })
}

/// Takes the lock. Polls it at most `looks` times (at least 1). `relax` waits between two polls; if
/// it is NULL, spins. Tasks only; blocks no longer than the polls take.
///
/// `TANDEM_STATUS_OK`: taken; the last owner had released it. `TANDEM_STATUS_RECOVERED`: taken, but
/// the last owner died holding it; repair its data. `TANDEM_STATUS_TIMED_OUT`: not taken.
/// `TANDEM_STATUS_BUSY`: this end already holds it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_lock_acquire(
    lock: *mut TandemLock,
    looks: u32,
    relax: TandemRelax,
    context: *mut c_void,
) -> TandemStatus {
    let relax = |spins| match relax {
        // SAFETY: a function of C with this signature, called with the context that C passed.
        Some(relax) => unsafe { relax(context, spins) },
        None => spin(spins),
    };
    let take = |end: &mut End| match end.held {
        Some(_) => Err(S::Busy),
        None => {
            let acquired = end.lock.lock(looks.max(1), relax);
            acquired
                .map(|acquired| keep(&mut end.held, acquired))
                .map_err(|_| S::TimedOut)
        }
    };
    status(|| cell::occupy(lock, take)?)
}

fn keep(held: &mut Option<Held<'static>>, acquired: Acquired<'_, 'static>) -> S {
    let recovered = acquired.is_recovered();
    *held = Some(acquired.into_guard().detach());
    if recovered { S::Recovered } else { S::Ok }
}

/// Takes the lock if it is free and no waiting core has its turn before this core. Any context;
/// does not block.
///
/// Returns the same as `tandem_lock_acquire`, and `TANDEM_STATUS_BUSY` if the lock was not taken.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_lock_try_acquire(lock: *mut TandemLock) -> TandemStatus {
    cell::with(lock, |end| {
        if end.held.is_some() {
            return Err(S::Busy);
        }
        let acquired = end.lock.try_lock().ok_or(S::Busy)?;
        Ok(keep(&mut end.held, acquired))
    })
}

/// Releases the lock. Any context; does not block.
///
/// `TANDEM_STATUS_NOTHING_TO_END` if this end does not hold it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_lock_release(lock: *mut TandemLock) -> TandemStatus {
    cell::with(lock, |end| end.held.take().map(drop).ok_or(S::NothingToEnd))
}
