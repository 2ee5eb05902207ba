//! The pool.

use crate::cell::{self, opaque};
use crate::map::{self, TANDEM_CORES, TandemMap, TandemWords};
use crate::status::{TandemStatus, TandemStatus as S, status};
use tandem_shm::pool::{
    BLOCK_WORDS, GetError, HandOverError, Handle, HandleError, MAX_BLOCKS, Pool,
};

/// Words of a block of a pool, the unit in which it lends.
pub const TANDEM_BLOCK_WORDS: usize = 16;
/// The most blocks of a pool.
pub const TANDEM_MAX_BLOCKS: usize = 511;

const _: () = assert!(TANDEM_BLOCK_WORDS == BLOCK_WORDS && TANDEM_MAX_BLOCKS == MAX_BLOCKS);

/// A pool as one incarnation of one core sees it. Static, zero at first.
#[repr(C)]
#[derive(Debug)]
pub struct TandemPool {
    /// Private.
    pub opaque: [usize; 22],
}

opaque!(TandemPool, Pool<'static>, 0x06);

/// Names words that were lent. Plain data: it may be sent to another core as two words. Every use
/// checks it, for it may be stale or forged.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct TandemHandle {
    /// What it consists of.
    pub words: [u32; 2],
}

impl From<HandleError> for S {
    fn from(error: HandleError) -> Self {
        match error {
            HandleError::Invalid => Self::Invalid,
            HandleError::Stale => Self::Stale,
            HandleError::NotOwner => Self::NotOwner,
        }
    }
}

/// Words of a pool of `blocks` blocks (1 ..= `TANDEM_MAX_BLOCKS`); 0 if there can be no such pool.
/// `TANDEM_POOL_WORDS` is the same as a constant.
#[unsafe(no_mangle)]
pub extern "C" fn tandem_pool_words(blocks: usize) -> usize {
    match blocks {
        1..=MAX_BLOCKS => tandem_shm::pool::words(blocks),
        _ => 0,
    }
}

/// Attaches to the pool of `blocks` blocks in region `region`, as incarnation `generation` of core
/// `core`, which was announced. The first attachment of an incarnation frees what earlier
/// incarnations of its core own. Task; does not block.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_pool_attach(
    pool: *mut TandemPool,
    map: *const TandemMap,
    region: usize,
    blocks: usize,
    core: u32,
    generation: u32,
) -> TandemStatus {
    status(|| {
        if tandem_pool_words(blocks) == 0 {
            return Err(S::OutOfRange);
        }
        // SAFETY: the caller's contract is passed on.
        unsafe {
            let (words, incarnations) = (map::region(map, region)?, map::incarnations(map)?);
            let incarnation = map::incarnation(core, generation)?;
            cell::put(
                pool,
                Pool::attach(words, blocks, incarnation, incarnations)?,
            )
        }
    })
}

/// Borrows `count` words; they hold what an earlier owner left. Any context; does not block.
///
/// `TANDEM_STATUS_FULL` if no free run of blocks is long enough (or `count` is 0),
/// `TANDEM_STATUS_BUSY` if other cores took what this one had found free: try again later.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_pool_get(
    pool: *mut TandemPool,
    count: usize,
    handle: *mut TandemHandle,
) -> TandemStatus {
    status(|| {
        cell::writable(handle)?;
        // SAFETY: the caller's contract is passed on.
        let got = unsafe { cell::get(pool) }?.get(count);
        let got = got.map_err(|error| match error {
            GetError::Full => S::Full,
            GetError::Busy => S::Busy,
        })?;
        let words = got.to_words();
        // SAFETY: 1 of the caller's contract.
        unsafe { cell::write(handle, TandemHandle { words }) }?;
        Ok(S::Ok)
    })
}

/// The words that a handle names, if this incarnation owns them; they are one's own until they are
/// given back or handed over. Any context; does not block.
///
/// `TANDEM_STATUS_STALE`, `TANDEM_STATUS_NOT_OWNER`, `TANDEM_STATUS_INVALID`
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_pool_open(
    pool: *mut TandemPool,
    handle: TandemHandle,
    words: *mut TandemWords,
) -> TandemStatus {
    status(|| {
        // SAFETY: the caller's contract is passed on.
        unsafe {
            let found = cell::get(pool)?.open(Handle::from_words(handle.words))?;
            cell::write(words, TandemWords::of(found))?;
        }
        Ok(S::Ok)
    })
}

/// Gives words back. Any context; does not block.
///
/// `TANDEM_STATUS_STALE` (also if they were given back before), `TANDEM_STATUS_NOT_OWNER`,
/// `TANDEM_STATUS_INVALID`
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_pool_give_back(
    pool: *mut TandemPool,
    handle: TandemHandle,
) -> TandemStatus {
    status(|| {
        // SAFETY: the caller's contract is passed on.
        let pool = unsafe { cell::get(pool) }?;
        pool.give_back(Handle::from_words(handle.words))?;
        Ok(S::Ok)
    })
}

/// Makes core `to` the owner. What this core wrote is visible to it when it opens the same handle;
/// sending the handle there is the caller's business. Any context; does not block.
///
/// As `tandem_pool_give_back`, and `TANDEM_STATUS_RECEIVER_DEAD`: then nothing has changed.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_pool_hand_over(
    pool: *mut TandemPool,
    handle: TandemHandle,
    to: u32,
) -> TandemStatus {
    status(|| {
        if to as usize >= TANDEM_CORES {
            return Err(S::OutOfRange);
        }
        // SAFETY: the caller's contract is passed on.
        let pool = unsafe { cell::get(pool) }?;
        let handed = pool.hand_over(Handle::from_words(handle.words), to as usize);
        handed.map_err(|error| match error {
            HandOverError::Handle(error) => error.into(),
            HandOverError::ReceiverDead => S::ReceiverDead,
        })?;
        Ok(S::Ok)
    })
}

/// Frees what incarnations that are not alive own, and returns how many words that were.
/// `tandem_pool_get` does the same where it needs the words. Any context; bounded.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_pool_reclaim_dead(pool: *mut TandemPool) -> usize {
    // SAFETY: the caller's contract is passed on.
    unsafe { cell::get(pool) }.map_or(0, |pool| pool.reclaim_dead())
}

/// How many words are free, in whole blocks, as far as one look tells. Any context; bounded.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_pool_free_words(pool: *mut TandemPool) -> usize {
    // SAFETY: the caller's contract is passed on.
    unsafe { cell::get(pool) }.map_or(0, |pool| pool.free_words())
}
