//! The pool.

use crate::cell::{self, TandemWords, opaque};
use crate::map::{self, TANDEM_CORES, TandemMap};
use crate::status::{TandemStatus, TandemStatus as S};
use tandem_shm::bare;
use tandem_shm::pool::{
    BLOCK_WORDS, GetError, HandOverError, Handle, HandleError, MAX_BLOCKS, Pool,
};

/// Words of a block, the unit of a loan.
pub const TANDEM_BLOCK_WORDS: usize = 16;
/// The largest number of blocks of a pool.
pub const TANDEM_MAX_BLOCKS: usize = 511;

const _: () = assert!(TANDEM_BLOCK_WORDS == BLOCK_WORDS && TANDEM_MAX_BLOCKS == MAX_BLOCKS);

/// A pool as one incarnation of one core sees it. Must be static and initially zero.
#[repr(C)]
#[derive(Debug)]
pub struct TandemPool {
    /// Private.
    pub opaque: [usize; 22],
}

opaque!(TandemPool, Pool<'static>, 0x06);

/// Identifies words that were lent. It is plain data, which may be sent to another core as two
/// words. The library checks it at each use, because it may be stale or forged.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct TandemHandle {
    /// The handle as two words.
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

impl From<GetError> for S {
    fn from(error: GetError) -> Self {
        match error {
            GetError::Full => Self::Full,
            GetError::Busy => Self::Busy,
        }
    }
}

impl From<HandOverError> for S {
    fn from(error: HandOverError) -> Self {
        match error {
            HandOverError::Handle(error) => error.into(),
            HandOverError::ReceiverDead => Self::ReceiverDead,
        }
    }
}

/// Returns the number of words of a pool with `blocks` blocks (1 ..= `TANDEM_MAX_BLOCKS`); 0 if it
/// is out of range. `TANDEM_POOL_WORDS` computes it as a constant.
#[unsafe(no_mangle)]
pub extern "C" fn tandem_pool_words(blocks: usize) -> usize {
    match blocks {
        1..=MAX_BLOCKS => tandem_shm::pool::words(blocks),
        _ => 0,
    }
}

/// Attaches to the pool of `blocks` blocks in region `region`, as incarnation `generation` of core
/// `core`, which must be announced. When an incarnation first attaches, this frees the words that
/// earlier incarnations of its core own. Tasks only; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_pool_attach(
    pool: *mut TandemPool,
    map: *const TandemMap,
    region: usize,
    blocks: usize,
    core: u32,
    generation: u32,
) -> TandemStatus {
    map::attach(pool, map, region, |words, incarnations| {
        if tandem_pool_words(blocks) == 0 {
            return Err(S::OutOfRange);
        }
        let incarnation = map::incarnation(core, generation)?;
        Ok(bare::pool(words, blocks, incarnation, incarnations)?)
    })
}

/// Borrows `count` words, which hold the values of an earlier owner. Any context; does not block.
///
/// `TANDEM_STATUS_FULL` if no free run of blocks is long enough (or `count` is 0),
/// `TANDEM_STATUS_BUSY` if other cores took the blocks that this core found free: try again later.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_pool_get(
    pool: *mut TandemPool,
    count: usize,
    handle: *mut TandemHandle,
) -> TandemStatus {
    cell::with(pool, |pool| {
        cell::writable(handle)?;
        let words = pool.get(count)?.to_words();
        cell::write(handle, TandemHandle { words })
    })
}

/// Writes the words of a handle to `words`, if this incarnation owns them. It owns them until they
/// are given back or handed over. Any context; does not block.
///
/// `TANDEM_STATUS_STALE`, `TANDEM_STATUS_NOT_OWNER`, `TANDEM_STATUS_INVALID`
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_pool_open(
    pool: *mut TandemPool,
    handle: TandemHandle,
    words: *mut TandemWords,
) -> TandemStatus {
    let handle = Handle::from_words(handle.words);
    cell::lend(pool, words, |pool| Ok(pool.open(handle)?))
}

/// Gives words back. Any context; does not block.
///
/// `TANDEM_STATUS_STALE` (also if they were given back before), `TANDEM_STATUS_NOT_OWNER`,
/// `TANDEM_STATUS_INVALID`
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_pool_give_back(
    pool: *mut TandemPool,
    handle: TandemHandle,
) -> TandemStatus {
    let handle = Handle::from_words(handle.words);
    cell::with(pool, |pool| Ok(pool.give_back(handle)?))
}

/// Makes core `to` the owner. The caller then sends it the handle. When that core opens the handle,
/// it sees everything that this core wrote. Any context; does not block.
///
/// Statuses as for `tandem_pool_give_back`, and `TANDEM_STATUS_RECEIVER_DEAD`: nothing has changed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_pool_hand_over(
    pool: *mut TandemPool,
    handle: TandemHandle,
    to: u32,
) -> TandemStatus {
    let handle = Handle::from_words(handle.words);
    cell::with(pool, |pool| {
        if to as usize >= TANDEM_CORES {
            return Err(S::OutOfRange);
        }
        Ok(pool.hand_over(handle, to as usize)?)
    })
}

/// Frees all words owned by incarnations that are not alive, and returns how many.
/// `tandem_pool_get` does the same when it needs the words. Any context; bounded.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_pool_reclaim_dead(pool: *mut TandemPool) -> usize {
    cell::get(pool).map_or(0, |pool| pool.reclaim_dead())
}

/// Returns the number of free words, in whole blocks, counted in one pass. Any context; bounded.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_pool_free_words(pool: *mut TandemPool) -> usize {
    cell::get(pool).map_or(0, |pool| pool.free_words())
}
