//! The pool: words of the LMU to borrow, hand over and give back. T-SHM-1..4
//!
//! A lock, then one *head* word for each block of 16 words, then the blocks. An allocation is a run
//! of blocks; the head word of its first block says who owns it (core and generation) and how many
//! blocks it has, and carries a stamp that counts the block's allocations. The head words of the
//! other blocks of a run are free. Head words are the only truth: one compare-and-swap on one of
//! them makes an allocation, gives it back, or hands it over, and the walk that looks for free
//! blocks steps over the runs whose owner is alive.
//!
//! Only allocating takes the lock, so that two walks do not find the same blocks. It changes
//! nothing before its one compare-and-swap: an owner of the lock that dies leaves nothing to
//! repair, and a straggler that was declared dead finds the head word changed. What a dead life
//! owns is free: the next walk takes it, or [`Pool::reclaim_dead`].
//!
//! First fit; neighbouring free blocks are one free space by themselves.

use crate::life::{Life, Lives};
use crate::lock::{self, Lock};
use crate::region::{FitError, LINE_WORDS, fit, whole_lines};
use crate::sync::{AtomicU32, Ordering, spin};

/// Words of a block, the unit of allocation: a cache line.
pub const BLOCK_WORDS: usize = LINE_WORDS;

/// The largest number of blocks: they are counted in 9 bits. One less than the LMU of a TC297 has.
pub const MAX_BLOCKS: usize = 511;

/// Looks at the lock before [`Pool::get`] says busy; a walk over [`MAX_BLOCKS`] is shorter.
const LOCK_LOOKS: u32 = 10_000;

// The head word, from the lowest bit: core + 1 (0: free), generation, blocks of the run, stamp.
const CORE_MASK: u32 = 0x3;
const GENERATION_SHIFT: u32 = 2;
const GENERATION_MASK: u32 = 0x1F;
const BLOCKS_SHIFT: u32 = 7;
const BLOCKS_MASK: u32 = 0x1FF;
const STAMP_SHIFT: u32 = 16;

/// Words of a pool of `blocks` blocks.
///
/// # Panics
/// If `blocks` is not 1 ..= [`MAX_BLOCKS`]; in a constant that is a compile error.
#[must_use]
pub const fn words(blocks: usize) -> usize {
    assert!(blocks >= 1 && blocks <= MAX_BLOCKS);
    blocks_at(blocks) + blocks * BLOCK_WORDS
}

const fn blocks_at(blocks: usize) -> usize {
    lock::WORDS + whole_lines(blocks)
}

/// The head word of a run that `life` owns.
const fn owned(life: Life, blocks: usize, stamp: u16) -> u32 {
    (life.core() as u32 + 1)
        | (life.generation() & GENERATION_MASK) << GENERATION_SHIFT
        | (blocks as u32) << BLOCKS_SHIFT
        | (stamp as u32) << STAMP_SHIFT
}

/// The head word of a free block.
const fn free(stamp: u16) -> u32 {
    (stamp as u32) << STAMP_SHIFT
}

const fn is_free(head: u32) -> bool {
    head & CORE_MASK == 0
}

const fn stamp_of(head: u32) -> u16 {
    (head >> STAMP_SHIFT) as u16
}

const fn blocks_of(head: u32) -> usize {
    (head >> BLOCKS_SHIFT & BLOCKS_MASK) as usize
}

/// Names an allocation. It is plain data and may cross the LMU; whoever gets it may hold a stale or
/// forged one, and every use checks it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Handle {
    block: u16,
    words: u16,
    stamp: u16,
}

#[allow(clippy::len_without_is_empty, reason = "an allocation is never empty")]
impl Handle {
    /// How many words were asked for, 1 or more; of a handle that came from elsewhere an
    /// allegation.
    #[must_use]
    pub const fn len(self) -> usize {
        self.words as usize
    }

    /// As two words, to be sent to another core.
    #[must_use]
    pub const fn to_words(self) -> [u32; 2] {
        [
            self.block as u32 | (self.words as u32) << 16,
            self.stamp as u32,
        ]
    }

    /// The inverse of [`Handle::to_words`]. Checks nothing: that is done where the handle is used.
    #[must_use]
    pub const fn from_words([place, stamp]: [u32; 2]) -> Self {
        Self {
            block: place as u16,
            words: (place >> 16) as u16,
            stamp: stamp as u16,
        }
    }
}

/// Why [`Pool::get`] gave nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GetError {
    /// No free run of blocks is long enough, or zero words were asked for.
    Full,
    /// Another core is allocating and did not come to an end: try again later.
    Busy,
}

/// What is wrong with a handle. Of the length only the number of blocks is checked: the owner of a
/// block owns all of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HandleError {
    /// It names no allocation that this pool ever made: forged or scribbled on.
    Invalid,
    /// The words were given back, or reclaimed from a dead owner, since.
    Stale,
    /// They belong to another core, or to an earlier life of this one.
    NotOwner,
}

/// Why words could not be handed over; they stay where they are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HandOverError {
    /// The handle is no good.
    Handle(HandleError),
    /// The other core is not alive.
    ReceiverDead,
}

impl From<HandleError> for HandOverError {
    fn from(error: HandleError) -> Self {
        Self::Handle(error)
    }
}

/// The pool as one life of one core sees it.
#[derive(Debug)]
pub struct Pool<'a> {
    lock: Lock<'a>,
    heads: &'a [AtomicU32],
    blocks: &'a [AtomicU32],
    life: Life,
    lives: Lives<'a>,
}

impl<'a> Pool<'a> {
    /// Attaches to a pool of `blocks` blocks. `life` must have been [announced](Lives::announce).
    ///
    /// # Errors
    /// [`FitError`] if the words are too few or not at a line boundary.
    ///
    /// # Panics
    /// If `blocks` is not 1 ..= [`MAX_BLOCKS`].
    pub fn attach(
        words: &'a [AtomicU32],
        blocks: usize,
        life: Life,
        lives: Lives<'a>,
    ) -> Result<Self, FitError> {
        let words = fit(words, self::words(blocks))?;
        let heads = &words[lock::WORDS..lock::WORDS + blocks];
        let lock = Lock::attach(&words[..lock::WORDS], life, lives)?;
        Ok(Self {
            lock,
            heads,
            blocks: &words[blocks_at(blocks)..],
            life,
            lives,
        })
    }

    /// Borrows `n_words` words (`shdmem_get`). They hold whatever an earlier owner left. Blocks for
    /// a bounded, short time; task context.
    ///
    /// # Errors
    /// [`GetError`]
    pub fn get(&mut self, n_words: usize) -> Result<Handle, GetError> {
        let need = n_words.div_ceil(BLOCK_WORDS);
        if n_words == 0 || need > self.heads.len() {
            return Err(GetError::Full);
        }
        let shared = Shared {
            heads: self.heads,
            lives: self.lives,
        };
        // Whether the last owner died with the lock does not matter: see the top of the file.
        let guard = self
            .lock
            .lock(LOCK_LOOKS, spin)
            .map_err(|_| GetError::Busy)?
            .into_guard();
        let (first, head) = shared.find_free(need).ok_or(GetError::Full)?;
        let stamp = stamp_of(head).wrapping_add(1);
        // Relaxed: the words are published to another core by handing them over.
        let taken = self.heads[first].compare_exchange(
            head,
            owned(self.life, need, stamp),
            Ordering::Relaxed,
            Ordering::Relaxed,
        );
        drop(guard);
        // Not so only if this life was declared dead meanwhile, or the words were scribbled on.
        taken.map_err(|_| GetError::Busy)?;
        Ok(Handle {
            block: first as u16,
            words: n_words as u16,
            stamp,
        })
    }

    /// The words of an allocation that this life owns. The slice outlives the ownership, but what
    /// is in it is one's own only until it is given back or handed over.
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
    /// [`HandleError`]; also when they were given back before.
    pub fn give_back(&self, handle: Handle) -> Result<(), HandleError> {
        let head = self.checked(handle)?;
        self.change(handle, head, free(handle.stamp))
    }

    /// Makes another core the owner. What this core wrote into the words is visible to whoever
    /// [opens](Pool::open) them with the same handle; sending it there is the caller's business.
    /// T-SHM-3
    ///
    /// # Errors
    /// [`HandOverError`]
    ///
    /// # Panics
    /// If `to` is no core (see [`CORES`](crate::life::CORES)).
    pub fn hand_over(&self, handle: Handle, to: usize) -> Result<(), HandOverError> {
        let head = self.checked(handle)?;
        let receiver = self.lives.current(to).ok_or(HandOverError::ReceiverDead)?;
        let new = owned(receiver, blocks_of(head), handle.stamp);
        Ok(self.change(handle, head, new)?)
    }

    /// Frees everything that lives which are not alive own, and returns how many words that were.
    /// [`Pool::get`] does the same where it needs the words. Each life should do it at its start:
    /// the pool keeps 5 bits of a generation, and 32 lives later a dead owner would look alive. Any
    /// context; bounded.
    pub fn reclaim_dead(&self) -> usize {
        let shared = Shared {
            heads: self.heads,
            lives: self.lives,
        };
        (0..self.heads.len())
            .map(|block| shared.reclaim(block))
            .sum::<usize>()
            * BLOCK_WORDS
    }

    /// How many words are free, in whole blocks, as far as one look tells (`size_remain`).
    #[must_use]
    pub fn free_words(&self) -> usize {
        let shared = Shared {
            heads: self.heads,
            lives: self.lives,
        };
        let mut free = 0;
        let mut block = 0;
        while block < self.heads.len() {
            let run = shared.run_of(block, self.heads[block].load(Ordering::Relaxed));
            free += usize::from(run == 0);
            block += run.max(1);
        }
        free * BLOCK_WORDS
    }

    /// The head word of an allocation that this life owns.
    fn checked(&self, handle: Handle) -> Result<u32, HandleError> {
        let block = handle.block as usize;
        let need = handle.len().div_ceil(BLOCK_WORDS);
        if handle.words == 0 || block + need > self.heads.len() {
            return Err(HandleError::Invalid);
        }
        // Acquire pairs with the Release in `change`: what the last owner wrote is seen.
        let head = self.heads[block].load(Ordering::Acquire);
        if is_free(head) || stamp_of(head) != handle.stamp {
            Err(HandleError::Stale)
        } else if blocks_of(head) != need {
            Err(HandleError::Invalid)
        } else if head != owned(self.life, need, handle.stamp) {
            Err(HandleError::NotOwner)
        } else {
            Ok(head)
        }
    }

    fn change(&self, handle: Handle, from: u32, to: u32) -> Result<(), HandleError> {
        // Release pairs with the Acquire in `checked` and `find_free`: what this life did to the
        // words comes before what the next owner does.
        self.heads[handle.block as usize]
            .compare_exchange(from, to, Ordering::Release, Ordering::Relaxed)
            .map(|_| ())
            // This life was declared dead meanwhile, and its words were reclaimed.
            .map_err(|_| HandleError::Stale)
    }
}

/// What the walks need: the pool without its lock.
#[derive(Clone, Copy)]
struct Shared<'a> {
    heads: &'a [AtomicU32],
    lives: Lives<'a>,
}

impl Shared<'_> {
    /// The first of `need` free blocks in a row, and its head word, after taking from the dead what
    /// is in the way.
    fn find_free(&self, need: usize) -> Option<(usize, u32)> {
        let mut first = None;
        let mut block = 0;
        while block < self.heads.len() {
            self.reclaim(block);
            // Acquire pairs with the Release in `change`.
            let head = self.heads[block].load(Ordering::Acquire);
            let run = self.run_of(block, head);
            if run != 0 {
                first = None;
                block += run;
                continue;
            }
            let found = *first.get_or_insert((block, head));
            block += 1;
            if block - found.0 == need {
                return Some(found);
            }
        }
        None
    }

    /// Blocks of the run that begins at `block` with this head word; 0 if the block is free. Never
    /// more than there are.
    fn run_of(&self, block: usize, head: u32) -> usize {
        if is_free(head) {
            0
        } else {
            blocks_of(head).clamp(1, self.heads.len() - block)
        }
    }

    /// Frees the run that begins at `block` if its owner is dead, and returns its blocks, or 0.
    fn reclaim(&self, block: usize) -> usize {
        let head = self.heads[block].load(Ordering::Relaxed);
        if is_free(head) {
            return 0;
        }
        let core = (head & CORE_MASK) as usize - 1;
        let generation = head >> GENERATION_SHIFT & GENERATION_MASK;
        if self.lives.is_current(core, generation, GENERATION_MASK) {
            return 0;
        }
        let free = free(stamp_of(head));
        // Release pairs with the Acquire in `find_free`.
        match self.heads[block].compare_exchange(head, free, Ordering::Release, Ordering::Relaxed) {
            Ok(_) => self.run_of(block, head),
            Err(_) => 0,
        }
    }
}

#[cfg(test)]
#[cfg(not(loom))]
mod tests {
    use super::*;
    use crate::step::{freeze_at, kill_at, zeroed};
    use proptest::prelude::*;
    use std::vec::Vec;

    const BLOCKS: usize = 8;

    #[derive(Clone, Copy)]
    struct Bench {
        words: &'static [AtomicU32],
        lives: Lives<'static>,
    }

    impl Bench {
        fn new() -> Self {
            let lives = Lives::attach(zeroed(Lives::WORDS)).unwrap();
            Self {
                words: zeroed(words(BLOCKS)),
                lives,
            }
        }

        fn start(&self, core: usize, generation: u32) -> Pool<'static> {
            let life = Life::new(core, generation).unwrap();
            self.lives.announce(life).unwrap();
            Pool::attach(self.words, BLOCKS, life, self.lives).unwrap()
        }
    }

    /// T-SHM-1: what does not fit is refused; what fits is as long as was asked for.
    #[test]
    fn words_are_given_until_they_are_gone() {
        let mut pool = Bench::new().start(0, 1);
        assert_eq!(pool.get(0), Err(GetError::Full));
        assert_eq!(pool.get(BLOCKS * BLOCK_WORDS + 1), Err(GetError::Full));
        let one = pool.get(17).unwrap();
        assert_eq!(pool.open(one).unwrap().len(), 17);
        assert_eq!(pool.free_words(), 6 * BLOCK_WORDS);
        let rest = pool.get(6 * BLOCK_WORDS).unwrap();
        assert_eq!(pool.get(1), Err(GetError::Full));
        let (one, rest) = (pool.open(one).unwrap(), pool.open(rest).unwrap());
        assert!(one.as_ptr_range().end <= rest.as_ptr_range().start);
    }

    /// T-SHM-2, T-SHM-4: memory comes back, and a stale or forged handle is an error.
    #[test]
    fn stale_and_forged_handles_are_errors() {
        let bench = Bench::new();
        let (mut pool, other) = (bench.start(0, 1), bench.start(1, 1));
        let handle = pool.get(20).unwrap();
        assert_eq!(Handle::from_words(handle.to_words()), handle);
        assert_eq!(other.open(handle).unwrap_err(), HandleError::NotOwner);
        assert_eq!(other.give_back(handle), Err(HandleError::NotOwner));
        let block = |block| Handle { block, ..handle };
        let words = |words| Handle { words, ..handle };
        let stamp = |stamp| Handle { stamp, ..handle };
        for (forged, error) in [
            (block(7), HandleError::Invalid),
            (block(u16::MAX), HandleError::Invalid),
            (block(3), HandleError::Stale),
            (block(1), HandleError::Stale),
            (words(0), HandleError::Invalid),
            (words(16), HandleError::Invalid),
            (words(33), HandleError::Invalid),
            (words(u16::MAX), HandleError::Invalid),
            (stamp(handle.stamp + 1), HandleError::Stale),
            (stamp(0), HandleError::Stale),
            (Handle::from_words([0, 0]), HandleError::Invalid),
        ] {
            assert_eq!(pool.open(forged).unwrap_err(), error, "{forged:?}");
            assert_eq!(pool.give_back(forged), Err(error), "{forged:?}");
            assert_eq!(pool.hand_over(forged, 1), Err(HandOverError::Handle(error)));
        }
        pool.give_back(handle).unwrap();
        assert_eq!(pool.give_back(handle), Err(HandleError::Stale));
        let again = pool.get(20).unwrap();
        assert_eq!(again.block, handle.block);
        assert_eq!(pool.open(handle).unwrap_err(), HandleError::Stale);
        assert!(pool.open(again).is_ok());
    }

    /// T-SHM-3: the receiver opens with the same handle what the owner has handed over.
    #[test]
    fn ownership_is_handed_over() {
        let bench = Bench::new();
        let (mut pool, other) = (bench.start(0, 1), bench.start(1, 4));
        let handle = pool.get(2).unwrap();
        pool.open(handle).unwrap()[1].store(42, Ordering::Relaxed);
        assert_eq!(pool.hand_over(handle, 2), Err(HandOverError::ReceiverDead));
        pool.hand_over(handle, 1).unwrap();
        assert_eq!(pool.open(handle).unwrap_err(), HandleError::NotOwner);
        assert_eq!(other.open(handle).unwrap()[1].load(Ordering::Relaxed), 42);
        other.give_back(handle).unwrap();
        assert_eq!(pool.free_words(), BLOCKS * BLOCK_WORDS);
    }

    /// T-SHM-2: what a dead core owned comes back, and nothing else.
    #[test]
    fn the_words_of_the_dead_are_reclaimed() {
        let bench = Bench::new();
        let (mut dying, mut other) = (bench.start(0, 1), bench.start(1, 1));
        let _ = dying.get(40).unwrap();
        let kept = other.get(16).unwrap();
        let old = dying.get(16).unwrap();
        let handed = dying.get(16).unwrap();
        dying.hand_over(handed, 1).unwrap();
        assert_eq!(other.reclaim_dead(), 0);
        let successor = bench.start(0, 2);
        assert_eq!(successor.open(old).unwrap_err(), HandleError::NotOwner);
        assert_eq!(other.reclaim_dead(), 4 * BLOCK_WORDS);
        assert_eq!(successor.open(old).unwrap_err(), HandleError::Stale);
        assert!(other.open(kept).is_ok() && other.open(handed).is_ok());
        // And without an explicit call, where the words are needed.
        let _ = bench.start(2, 1).get(48).unwrap();
        assert!(bench.lives.mark_dead(Life::new(2, 1).unwrap()));
        assert!(other.get(48).is_ok());
    }

    /// Killed at any step of get, hand over and give back: nothing stays lost, nothing is given
    /// twice.
    #[test]
    fn killed_at_every_step_everything_comes_back() {
        for at in 0.. {
            let bench = Bench::new();
            let (mut dying, mut other) = (bench.start(0, 1), bench.start(1, 1));
            let kept = other.get(16).unwrap();
            let done = kill_at(at, || {
                let one = dying.get(40).unwrap();
                let two = dying.get(16).unwrap();
                dying.hand_over(one, 1).unwrap();
                dying.give_back(two).unwrap();
            });
            assert!(bench.lives.mark_dead(Life::new(0, 1).unwrap()));
            other.reclaim_dead();
            // What is still owned was handed over to the living.
            let lost = (BLOCKS - 1) * BLOCK_WORDS - other.free_words();
            assert!(
                lost == 0 || lost == 3 * BLOCK_WORDS,
                "killed at {at}: {lost}"
            );
            let all = other.get(other.free_words()).unwrap();
            assert!(other.open(all).is_ok() && other.open(kept).is_ok());
            if done.is_some() {
                break;
            }
        }
    }

    /// A straggler that thaws in the middle of a call takes nothing from the living.
    #[test]
    fn a_straggler_takes_nothing_from_the_living() {
        for at in 0.. {
            let bench = Bench::new();
            let mut straggler = bench.start(0, 1);
            let own = straggler.get(16).unwrap();
            let meanwhile = move || {
                assert!(bench.lives.mark_dead(Life::new(0, 1).unwrap()));
                let mut living = bench.start(1, 1);
                for words in [16, 48, 64] {
                    living.get(words).unwrap();
                }
            };
            let (_, hit) = freeze_at(at, meanwhile, || {
                let _ = straggler.get(32);
                let _ = straggler.hand_over(own, 1);
                let _ = straggler.give_back(own);
            });
            if !hit {
                break;
            }
            let living = bench.start(1, 1);
            living.reclaim_dead();
            assert_eq!(living.free_words(), 0, "frozen at {at}");
        }
    }

    #[test]
    fn scribbled_words_are_no_panic() {
        for scribble in [1, 2, 3, 0xFFF, 0x1234_5678, u32::MAX] {
            let bench = Bench::new();
            let mut pool = bench.start(0, 1);
            let handle = pool.get(20).unwrap();
            for word in bench.words {
                word.store(scribble, Ordering::Relaxed);
            }
            let _ = pool.open(handle);
            let _ = pool.give_back(handle);
            pool.reclaim_dead();
            let _ = pool.free_words();
            bench.words[..lock::WORDS]
                .iter()
                .for_each(|word| word.store(0, Ordering::Relaxed));
            let _ = pool.get(1);
        }
    }

    /// What a core does with the pool.
    #[derive(Clone, Debug)]
    enum Op {
        Get { core: usize, words: usize },
        GiveBack { core: usize, pick: usize },
        HandOver { core: usize, pick: usize, to: usize },
        Respawn { core: usize },
        Reclaim { core: usize },
    }

    fn op() -> impl Strategy<Value = Op> {
        let core = 0..3usize;
        prop_oneof![
            4 => (core.clone(), 0..70usize).prop_map(|(core, words)| Op::Get { core, words }),
            3 => (core.clone(), any::<usize>())
                .prop_map(|(core, pick)| Op::GiveBack { core, pick }),
            2 => (core.clone(), any::<usize>(), core.clone())
                .prop_map(|(core, pick, to)| Op::HandOver { core, pick, to }),
            1 => core.clone().prop_map(|core| Op::Respawn { core }),
            1 => core.prop_map(|core| Op::Reclaim { core }),
        ]
    }

    /// One allocation that was ever made.
    #[derive(Clone, Copy)]
    struct Known {
        handle: Handle,
        /// Core and generation; `None` once it was given back or reclaimed.
        owner: Option<(usize, u32)>,
    }

    /// The pool as a list of all allocations, first fit.
    struct Model {
        generations: [u32; 3],
        known: Vec<Known>,
    }

    impl Model {
        fn bury(&mut self) {
            for known in &mut self.known {
                known.owner = known.owner.filter(|&(core, g)| self.generations[core] == g);
            }
        }

        fn first_fit(&self, blocks: usize) -> Option<usize> {
            let mut used = [false; BLOCKS];
            for Known { handle, .. } in self.known.iter().filter(|known| known.owner.is_some()) {
                let first = handle.block as usize;
                used[first..first + handle.len().div_ceil(BLOCK_WORDS)].fill(true);
            }
            (0..=BLOCKS - blocks).find(|&at| !used[at..at + blocks].contains(&true))
        }
    }

    fn check(ops: &[Op]) {
        let bench = Bench::new();
        let mut pools: Vec<_> = (0..3).map(|core| bench.start(core, 1)).collect();
        let mut model = Model {
            generations: [1; 3],
            known: Vec::new(),
        };
        for op in ops {
            match *op {
                Op::Get { core, words } => {
                    let blocks = words.div_ceil(BLOCK_WORDS);
                    model.bury();
                    let expected = model.first_fit(blocks).filter(|_| words != 0);
                    let got = pools[core].get(words);
                    assert_eq!(got.map(|handle| handle.block as usize).ok(), expected);
                    if let Ok(handle) = got {
                        let owner = Some((core, model.generations[core]));
                        model.known.push(Known { handle, owner });
                    }
                }
                Op::GiveBack { core, pick } if !model.known.is_empty() => {
                    let pick = pick % model.known.len();
                    let known = &mut model.known[pick];
                    let mine = known.owner == Some((core, model.generations[core]));
                    assert_eq!(pools[core].give_back(known.handle).is_ok(), mine);
                    known.owner = known.owner.filter(|_| !mine);
                }
                Op::HandOver { core, pick, to } if !model.known.is_empty() => {
                    let pick = pick % model.known.len();
                    let known = &mut model.known[pick];
                    let mine = known.owner == Some((core, model.generations[core]));
                    assert_eq!(pools[core].hand_over(known.handle, to).is_ok(), mine);
                    if mine {
                        known.owner = Some((to, model.generations[to]));
                    }
                }
                Op::Respawn { core } => {
                    model.generations[core] += 1;
                    pools[core] = bench.start(core, model.generations[core]);
                }
                Op::Reclaim { core } => {
                    pools[core].reclaim_dead();
                    model.bury();
                }
                Op::GiveBack { .. } | Op::HandOver { .. } => {}
            }
            for known in &model.known {
                for (core, pool) in pools.iter().enumerate() {
                    let mine = known.owner == Some((core, model.generations[core]));
                    assert_eq!(pool.open(known.handle).is_ok(), mine);
                }
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig {
            cases: if cfg!(miri) { 4 } else { 512 },
            failure_persistence: None,
            ..ProptestConfig::default()
        })]

        /// T-SHM-1, T-SHM-2, T-SHM-4: the pool does what a plain list of allocations does.
        #[test]
        fn the_pool_does_what_its_model_does(ops in prop::collection::vec(op(), 1..60)) {
            check(&ops);
        }
    }
}
