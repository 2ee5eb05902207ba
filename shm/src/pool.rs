//! The pool: cores borrow words of the LMU, hand them over and give them back. T-SHM-1..4
//!
//! The pool is one line of counters, then one *state* word for each block of 16 words, then the
//! blocks. An allocation is a run of neighbouring blocks. The state of its first block, the *head*,
//! holds the incarnation that owns the run, the number of its blocks, and a stamp: the number of
//! the allocation. The state of each further block holds the first block and the same stamp; it
//! counts only while the head has that stamp and an owner. So one compare-and-swap of the head
//! gives all blocks of a run back, hands them over, or takes them from a dead owner.
//!
//! There is no lock. A core that borrows takes one block after the other, each by a
//! compare-and-swap from the state in which it read the block as free:
//!
//! 1. the head, marked as *gathering* if the run has more than one block,
//! 2. the further blocks,
//! 3. the head again, to clear the mark.
//!
//! If one of them fails, the core frees the head, and with it all blocks of the run, and starts
//! again. A step fails only if another core changed the block first. So one core always makes
//! progress, and a core that is pre-empted, frozen or dead delays no other.
//!
//! **Stragglers**: an incarnation that was declared dead and still runs takes no block of a living
//! owner. If it read a block as free and another core has borrowed it since, the block's state has
//! changed. If its own run was reclaimed, its head has changed, so step 3 fails.
//!
//! **Deaths**: blocks of a dead incarnation are free. The next [`Pool::get`] that needs them takes
//! them, or [`Pool::reclaim_dead`] frees them; when an incarnation first attaches, it frees the
//! blocks of earlier incarnations of its core.
//!
//! The search is first fit; neighbouring free blocks need no merging.
//!
//! Limit: a stamp has 16 bits. A stale handle is accepted, or a straggler's compare-and-swap
//! succeeds, if the pool has made exactly a multiple of 2^16 allocations since and the block has
//! the same state again.

use crate::incarnation::{Attached, CORES, Incarnation, Incarnations};
use crate::shape::{FitError, LINE_WORDS, fit, whole_lines};
use crate::sync::{AtomicU32, Ordering};

/// Words of a block, the unit of allocation: a cache line.
pub const BLOCK_WORDS: usize = LINE_WORDS;

/// The largest number of blocks, because the count has 9 bits. The LMU of a TC297 has one more.
pub const MAX_BLOCKS: usize = 511;

/// Attempts of [`Pool::get`] and [`Pool::attach`]. An attempt of `get` fails if another core takes
/// a block that was found free, one of `attach` if another incarnation attaches.
const ATTEMPTS: u32 = 4;

/// The word that counts the allocations that were started.
const ALLOCATIONS_AT: usize = 0;
const ATTACHED_AT: usize = 1;
const STATES_AT: usize = LINE_WORDS;

// The state of a block, from the lowest bit: core + 1 of the owner (0: not a head), a mark, the
// owner's generation, a number, the stamp. In a head the mark is set while the run is being
// gathered, and the number is the run's length in blocks. In another block the mark is set if the
// block belongs to a run, and the number is the run's first block; without the mark it is free.
const CORE_MASK: u32 = 0x3;
const MARK: u32 = 0x4;
const GENERATION_SHIFT: u32 = 3;
const GENERATION_MASK: u32 = 0xF;
const NUMBER_SHIFT: u32 = 7;
const NUMBER_MASK: u32 = 0x1FF;
const STAMP_SHIFT: u32 = 16;

/// Returns the number of words of a pool of `blocks` blocks.
///
/// # Panics
/// If `blocks` is not 1 ..= [`MAX_BLOCKS`]; in a constant that is a compile error.
#[must_use]
pub const fn words(blocks: usize) -> usize {
    assert!(blocks >= 1 && blocks <= MAX_BLOCKS);
    blocks_at(blocks) + blocks * BLOCK_WORDS
}

const fn blocks_at(blocks: usize) -> usize {
    STATES_AT + whole_lines(blocks)
}

/// Returns the head of a run that `incarnation` owns.
const fn owned(incarnation: Incarnation, blocks: usize, stamp: u16) -> u32 {
    (incarnation.core() as u32 + 1)
        | (incarnation.generation() & GENERATION_MASK) << GENERATION_SHIFT
        | (blocks as u32) << NUMBER_SHIFT
        | (stamp as u32) << STAMP_SHIFT
}

/// Returns the state of a further block of the run that begins at `first`.
const fn further(first: usize, stamp: u16) -> u32 {
    MARK | (first as u32) << NUMBER_SHIFT | (stamp as u32) << STAMP_SHIFT
}

/// Returns the state of a free block.
const fn free(stamp: u16) -> u32 {
    (stamp as u32) << STAMP_SHIFT
}

const fn is_head(state: u32) -> bool {
    state & CORE_MASK != 0
}

const fn is_marked(state: u32) -> bool {
    state & MARK != 0
}

const fn stamp_of(state: u32) -> u16 {
    (state >> STAMP_SHIFT) as u16
}

const fn number_of(state: u32) -> usize {
    (state >> NUMBER_SHIFT & NUMBER_MASK) as usize
}

/// Names an allocation. It is plain data that cores may pass through the LMU. The pool checks it at
/// every use, because it may be stale or forged.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Handle {
    block: u16,
    words: u16,
    stamp: u16,
}

#[allow(clippy::len_without_is_empty, reason = "an allocation is never empty")]
impl Handle {
    /// Returns how many words were requested (1 or more). In a forged handle it may be wrong.
    #[must_use]
    pub const fn len(self) -> usize {
        self.words as usize
    }

    /// Returns the handle as two words, to be sent to another core.
    #[must_use]
    pub const fn to_words(self) -> [u32; 2] {
        [
            self.block as u32 | (self.words as u32) << 16,
            self.stamp as u32,
        ]
    }

    /// Converts two words to a handle. Checks nothing: the pool checks each use of the handle.
    #[must_use]
    pub const fn from_words([place, stamp]: [u32; 2]) -> Self {
        Self {
            block: place as u16,
            words: (place >> 16) as u16,
            stamp: stamp as u16,
        }
    }
}

/// Why [`Pool::get`] failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum GetError {
    /// No free run of blocks is long enough, or zero words were requested.
    Full,
    /// Other cores took the blocks that this one found free, or are gathering a run: try again
    /// later.
    Busy,
}

impl core::fmt::Display for GetError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Full => "no free run of blocks is long enough",
            Self::Busy => "other cores take the blocks; try again later",
        })
    }
}

impl core::error::Error for GetError {}

/// Why a handle is refused. A wrong length is refused only if it needs another number of blocks:
/// the owner of a block owns all of its words.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum HandleError {
    /// This pool never made the allocation: the handle is forged or garbage.
    Invalid,
    /// The words were already given back, or reclaimed from a dead owner.
    Stale,
    /// The words belong to another core, or to an earlier incarnation of this one.
    NotOwner,
}

impl core::fmt::Display for HandleError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Invalid => "the pool never made this allocation",
            Self::Stale => "the words were already given back",
            Self::NotOwner => "the words belong to another incarnation",
        })
    }
}

impl core::error::Error for HandleError {}

/// Why words could not be handed over; their owner is unchanged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum HandOverError {
    /// The handle is refused.
    Handle(HandleError),
    /// The other core is not alive.
    ReceiverDead,
}

impl core::fmt::Display for HandOverError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Handle(error) => error.fmt(f),
            Self::ReceiverDead => f.write_str("the receiver is not alive"),
        }
    }
}

impl core::error::Error for HandOverError {}

impl From<HandleError> for HandOverError {
    fn from(error: HandleError) -> Self {
        Self::Handle(error)
    }
}

/// The pool as one incarnation of one core sees it.
#[derive(Clone, Copy, Debug)]
pub struct Pool<'a> {
    allocations: &'a AtomicU32,
    states: &'a [AtomicU32],
    blocks: &'a [AtomicU32],
    incarnation: Incarnation,
    attached: Attached<'a>,
}

impl<'a> Pool<'a> {
    /// Attaches to a pool of `blocks` blocks. When `incarnation` first attaches, this frees the
    /// blocks of earlier incarnations of its core. `incarnation` must have been
    /// [announced](Incarnations::announce). Never blocks.
    ///
    /// # Errors
    /// [`FitError`] if the words are too few or not at a line boundary.
    ///
    /// # Panics
    /// If `blocks` is not 1 ..= [`MAX_BLOCKS`].
    pub(crate) fn attach(
        words: &'a [AtomicU32],
        blocks: usize,
        incarnation: Incarnation,
        incarnations: Incarnations<'a>,
    ) -> Result<Self, FitError> {
        let words = fit(words, self::words(blocks))?;
        let generations: &[AtomicU32; CORES] = words[ATTACHED_AT..]
            .first_chunk()
            .ok_or(FitError::TooSmall)?;
        let pool = Self {
            allocations: &words[ALLOCATIONS_AT],
            states: &words[STATES_AT..STATES_AT + blocks],
            blocks: &words[blocks_at(blocks)..],
            incarnation,
            attached: Attached::new(generations, incarnations),
        };
        pool.disown_earlier_incarnations(incarnation);
        Ok(pool)
    }

    /// Frees the blocks of earlier incarnations of a core, unless `incarnation` has already
    /// attached or is not alive.
    #[cold]
    fn disown_earlier_incarnations(&self, incarnation: Incarnation) {
        // Retries only if another core, or an earlier incarnation, attached at the same time.
        for _ in 0..ATTEMPTS {
            let Some(earlier) = self.attached.earlier(incarnation) else {
                return;
            };
            for block in 0..self.states.len() {
                // Acquire pairs with the Release in `replace`. The head is read before `earlier`: a
                // head from before this incarnation attached belongs to an earlier one.
                let state = self.states[block].load(Ordering::Acquire);
                if self.attached.earlier(incarnation).is_none() {
                    return;
                }
                if state & CORE_MASK == incarnation.core() as u32 + 1 {
                    self.replace(block, state, free(stamp_of(state)));
                }
            }
            if self.attached.insert(incarnation, earlier) {
                return;
            }
        }
    }

    /// Borrows `n_words` words (`shdmem_get`). They hold the values of an earlier owner. Never
    /// blocks; any context. Bounded: at most four passes over the blocks.
    ///
    /// # Errors
    /// [`GetError`]
    pub fn get(&self, n_words: usize) -> Result<Handle, GetError> {
        let need = n_words.div_ceil(BLOCK_WORDS);
        if n_words == 0 || need > self.states.len() {
            return Err(GetError::Full);
        }
        for _ in 0..ATTEMPTS {
            let (first, state) = self.find_free(need)?;
            // Relaxed: only the number matters. Each attempt has its own number, so that blocks
            // left by a failed attempt never count as part of a later one.
            let stamp = self.allocations.fetch_add(1, Ordering::Relaxed) as u16;
            let stamp = stamp.wrapping_add(1);
            if self.gather(first, state, need, stamp) {
                return Ok(Handle {
                    block: first as u16,
                    words: n_words as u16,
                    stamp,
                });
            }
        }
        Err(GetError::Busy)
    }

    /// Returns the words of an allocation that this incarnation owns. The slice may be used only
    /// until the words are given back or handed over, although its lifetime is longer.
    ///
    /// # Errors
    /// [`HandleError`]
    pub fn open(&self, handle: Handle) -> Result<&'a [AtomicU32], HandleError> {
        self.checked(handle)?;
        let first = handle.block as usize * BLOCK_WORDS;
        Ok(&self.blocks[first..first + handle.len()])
    }

    /// Gives words back. T-SHM-2
    ///
    /// # Errors
    /// [`HandleError`], also if they were already given back.
    pub fn give_back(&self, handle: Handle) -> Result<(), HandleError> {
        let head = self.checked(handle)?;
        self.change(handle, head, free(handle.stamp))
    }

    /// Makes another core the owner. The caller sends it the handle. With the same handle that core
    /// [opens](Pool::open) the words and sees everything that this core wrote. Any context.
    /// T-SHM-3
    ///
    /// # Errors
    /// [`HandOverError`]
    ///
    /// # Panics
    /// If `to` is not below [`CORES`].
    pub fn hand_over(&self, handle: Handle, to: usize) -> Result<(), HandOverError> {
        let head = self.checked(handle)?;
        let receiver = self.attached.incarnations().current(to);
        let receiver = receiver.ok_or(HandOverError::ReceiverDead)?;
        // If the receiver has not attached yet, this core disowns the receiver's predecessors.
        self.disown_earlier_incarnations(receiver);
        let new = owned(receiver, number_of(head), handle.stamp);
        Ok(self.change(handle, head, new)?)
    }

    /// Frees all words owned by incarnations that are not alive, and returns their number.
    /// [`Pool::get`] does the same where it needs the words. Any context; bounded.
    pub fn reclaim_dead(&self) -> usize {
        let mut reclaimed = 0;
        for block in 0..self.states.len() {
            // Acquire pairs with the Release in `replace`.
            let head = self.states[block].load(Ordering::Acquire);
            if is_head(head)
                && !self.is_owner_alive(head)
                && self.replace(block, head, free(stamp_of(head)))
            {
                reclaimed += self.end_of(block, head) - block;
            }
        }
        reclaimed * BLOCK_WORDS
    }

    /// Returns the number of free words, in whole blocks, counted in one pass over the blocks
    /// (`size_remain`).
    #[must_use]
    pub fn free_words(&self) -> usize {
        let is_free = |block: usize| {
            // Acquire pairs with the Release in `replace`.
            let state = self.states[block].load(Ordering::Acquire);
            self.run_of(block, state).is_none()
        };
        (0..self.states.len())
            .filter(|&block| is_free(block))
            .count()
            * BLOCK_WORDS
    }

    /// Returns the head of an allocation that this incarnation owns.
    fn checked(&self, handle: Handle) -> Result<u32, HandleError> {
        let block = handle.block as usize;
        let need = handle.len().div_ceil(BLOCK_WORDS);
        if handle.words == 0 || block + need > self.states.len() {
            return Err(HandleError::Invalid);
        }
        // Acquire pairs with the Release in `replace`: everything that the last owner wrote is
        // visible.
        let head = self.states[block].load(Ordering::Acquire);
        if !is_head(head) || stamp_of(head) != handle.stamp {
            Err(HandleError::Stale)
        } else if number_of(head) != need {
            Err(HandleError::Invalid)
        } else if head != owned(self.incarnation, need, handle.stamp) {
            Err(HandleError::NotOwner)
        } else {
            Ok(head)
        }
    }

    fn change(&self, handle: Handle, from: u32, to: u32) -> Result<(), HandleError> {
        if self.replace(handle.block as usize, from, to) {
            Ok(())
        } else {
            // This incarnation was declared dead, and its words were reclaimed.
            Err(HandleError::Stale)
        }
    }

    /// Replaces the state of a block if it is still the expected one. Returns whether it did.
    #[inline]
    fn replace(&self, block: usize, expected: u32, new: u32) -> bool {
        // Release pairs with the Acquire of each load of a state: this incarnation's accesses to
        // the words happen before those of the next owner, and a core that sees a run sees that its
        // owner was announced and had attached.
        self.states[block]
            .compare_exchange(expected, new, Ordering::Release, Ordering::Relaxed)
            .is_ok()
    }

    /// Returns the first of `need` free blocks in a row, and its state. During the search, frees
    /// blocks of dead owners.
    fn find_free(&self, need: usize) -> Result<(usize, u32), GetError> {
        let mut error = GetError::Full;
        let mut block = 0;
        let mut found = (0, 0);
        while block < self.states.len() {
            match self.look(block) {
                Look::Free(state) => {
                    if block == found.0 {
                        found.1 = state;
                    }
                    block += 1;
                    if block - found.0 == need {
                        return Ok(found);
                    }
                    continue;
                }
                Look::Owned { end } => block = end,
                Look::Moving => {
                    error = GetError::Busy;
                    block += 1;
                }
            }
            found.0 = block;
        }
        Err(error)
    }

    /// Takes `need` blocks from `first` on, which were found free; `first` had state `state`. If it
    /// returns `false`, it has taken none: another core took a block first, or this incarnation was
    /// declared dead.
    #[inline]
    fn gather(&self, first: usize, state: u32, need: usize, stamp: u16) -> bool {
        let head = owned(self.incarnation, need, stamp);
        if need == 1 {
            return self.replace(first, state, head);
        }
        let gathering = head | MARK;
        if !self.replace(first, state, gathering) {
            return false;
        }
        let take = |block| match self.look(block) {
            Look::Free(state) => self.replace(block, state, further(first, stamp)),
            Look::Owned { .. } | Look::Moving => false,
        };
        if (first + 1..first + need).all(take) {
            return self.replace(first, gathering, head);
        }
        self.replace(first, gathering, free(stamp));
        false
    }

    /// Checks one block. If it belongs to a run whose owner is dead, frees the run.
    #[inline]
    fn look(&self, block: usize) -> Look {
        // Acquire pairs with the Release in `replace`.
        let state = self.states[block].load(Ordering::Acquire);
        if is_head(state) || is_marked(state) {
            self.look_at_run(block, state)
        } else {
            Look::Free(state)
        }
    }

    #[inline(never)]
    fn look_at_run(&self, block: usize, state: u32) -> Look {
        let Some((first, head)) = self.run_of(block, state) else {
            return Look::Free(state);
        };
        if self.is_owner_alive(head) {
            return match is_marked(head) {
                true => Look::Moving,
                false => Look::Owned {
                    end: self.end_of(first, head),
                },
            };
        }
        let freed = free(stamp_of(head));
        match self.replace(first, head, freed) {
            true if first == block => Look::Free(freed),
            true => Look::Free(state),
            false => Look::Moving,
        }
    }

    /// Returns the run of a block with this state: its first block and its head. `None` if the
    /// block is free.
    #[inline]
    fn run_of(&self, block: usize, state: u32) -> Option<(usize, u32)> {
        if is_head(state) {
            return Some((block, state));
        }
        if !is_marked(state) {
            return None;
        }
        let first = number_of(state);
        // Acquire pairs with the Release in `replace`: if the run has ended, its last owner no
        // longer accesses its words.
        let head = self.states.get(first)?.load(Ordering::Acquire);
        let is_there = is_head(head)
            && stamp_of(head) == stamp_of(state)
            && (1..number_of(head)).contains(&block.wrapping_sub(first));
        is_there.then_some((first, head))
    }

    /// Returns the block after the run that begins at `first`. While the run is being gathered, its
    /// further blocks may belong to other runs, so only the first block counts.
    fn end_of(&self, first: usize, head: u32) -> usize {
        let blocks = if is_marked(head) { 1 } else { number_of(head) };
        first + blocks.clamp(1, self.states.len() - first)
    }

    fn is_owner_alive(&self, head: u32) -> bool {
        let core = (head & CORE_MASK) as usize - 1;
        let bits = head >> GENERATION_SHIFT & GENERATION_MASK;
        self.attached.is_alive(core, bits, GENERATION_MASK)
    }
}

/// The result of a check of one block.
enum Look {
    /// The block is free; this is its state.
    Free(u32),
    /// The block belongs to a run of a living owner.
    Owned {
        /// The block after the run; not below this block.
        end: usize,
    },
    /// Another core is changing the block.
    Moving,
}

#[cfg(test)]
#[cfg(not(loom))]
mod tests;
