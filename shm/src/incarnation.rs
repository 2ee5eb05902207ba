//! The incarnation table holds the current incarnation of each core, and whether it still runs.
//!
//! It has one word for each core: `generation << 1 | dead`, 0 before the first incarnation. A core
//! announces its generation when it starts; a supervisor that has seen it die marks it dead. An
//! incarnation is alive while it is the announced one and not marked. Any core may take over words
//! in the LMU whose owner is not alive.
//!
//! An owner word of a lock or a pool has room for only a few bits of a generation. Beside it,
//! `Attached` keeps for each core the whole generation of the last incarnation that attached. When
//! an incarnation first attaches, it disowns everything that its predecessors left. So a later
//! incarnation is never taken for the owner, however many incarnations are between them.

use crate::shape::{FitError, LINE_WORDS, fit};
use crate::sync::{AtomicU32, Ordering};

/// Number of cores that share an LMU.
pub const CORES: usize = 3;

/// The largest generation: 30 bits. With one reset a second, it is reached after 34 years.
pub const MAX_GENERATION: u32 = (1 << 30) - 1;

const DEAD: u32 = 1;

/// An incarnation that is at most this far behind the announced one is refused as a straggler. A
/// word that is further ahead is garbage, which must not keep the core from starting.
const MAX_LIVES_BEHIND: u32 = 7;

/// One incarnation of one core.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Incarnation {
    core: u8,
    generation: u32,
}

impl Incarnation {
    /// Returns incarnation `generation` (1 ..= [`MAX_GENERATION`]) of core `core` (below
    /// [`CORES`]), or `None` if a number is out of its range.
    #[must_use]
    pub const fn new(core: usize, generation: u32) -> Option<Self> {
        if core < CORES && generation >= 1 && generation <= MAX_GENERATION {
            Some(Self {
                core: core as u8,
                generation,
            })
        } else {
            None
        }
    }

    /// Returns the core, below [`CORES`].
    #[must_use]
    pub const fn core(self) -> usize {
        self.core as usize
    }

    /// Returns the number of this incarnation of the core, from 1.
    #[must_use]
    pub const fn generation(self) -> u32 {
        self.generation
    }
}

/// A later incarnation of the same core is announced, or this one was marked dead: it must stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Outdated {
    /// The announced generation.
    pub current: u32,
}

impl core::fmt::Display for Outdated {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "generation {} of this core is announced", self.current)
    }
}

impl core::error::Error for Outdated {}

/// The incarnation table in the LMU.
#[derive(Clone, Copy, Debug)]
pub struct Incarnations<'a> {
    words: &'a [AtomicU32],
}

impl<'a> Incarnations<'a> {
    /// Words of the table.
    pub const WORDS: usize = LINE_WORDS;

    /// Attaches to the table in these words.
    ///
    /// # Errors
    /// [`FitError`] if the words are too few or not at a line boundary.
    pub fn attach(words: &'a [AtomicU32]) -> Result<Self, FitError> {
        Ok(Self {
            words: fit(words, Self::WORDS)?,
        })
    }

    /// Attaches to the table in words of a map, which have the right size and alignment.
    pub(crate) const fn new(words: &'a [AtomicU32]) -> Self {
        Self { words }
    }

    /// Announces an incarnation when it starts. From then on other cores may take over objects that
    /// earlier incarnations of this core owned. A second announcement changes nothing.
    ///
    /// A word whose generation is more than 7 ahead of this one is garbage and is overwritten.
    /// Garbage that is at most 7 ahead costs the core at most 8 resets.
    ///
    /// # Errors
    /// [`Outdated`] if this incarnation is not the latest, or was marked dead: it must stop.
    pub fn announce(&self, incarnation: Incarnation) -> Result<(), Outdated> {
        let word = &self.words[incarnation.core()];
        let new = incarnation.generation << 1;
        let mut seen = word.load(Ordering::Relaxed);
        // A retry is rare: only a supervisor that marks the core dead, or another incarnation of
        // the core, changes the word between load and exchange.
        for _ in 0..4 {
            if seen == new {
                return Ok(());
            }
            if (seen >> 1).wrapping_sub(incarnation.generation) <= MAX_LIVES_BEHIND {
                break;
            }
            // Release pairs with the Acquire in `is_announced` and `current`: a core that sees this
            // incarnation sees what this core did before.
            match word.compare_exchange(seen, new, Ordering::Release, Ordering::Relaxed) {
                Ok(_) => return Ok(()),
                Err(now) => seen = now,
            }
        }
        Err(Outdated { current: seen >> 1 })
    }

    /// Marks an incarnation as dead. The supervisor of the cores calls this when it has seen the
    /// incarnation end. Returns whether it was announced and alive; if not, nothing changes.
    pub fn mark_dead(&self, incarnation: Incarnation) -> bool {
        let alive = incarnation.generation << 1;
        // Release pairs with the Acquire in `is_announced`: a core that sees the mark sees what the
        // dead incarnation did, as far as the supervisor has seen it.
        self.words[incarnation.core()]
            .compare_exchange(alive, alive | DEAD, Ordering::Release, Ordering::Relaxed)
            .is_ok()
    }

    /// Returns whether this is the announced incarnation of its core and not marked dead.
    #[must_use]
    pub fn is_alive(&self, incarnation: Incarnation) -> bool {
        self.is_announced(incarnation.core(), incarnation.generation)
    }

    /// Returns the announced incarnation of a core, or `None` if it is marked dead.
    ///
    /// # Panics
    /// If `core` is not below [`CORES`].
    #[must_use]
    pub fn current(&self, core: usize) -> Option<Incarnation> {
        // Acquire pairs with the Release in `announce`.
        let word = self.words[core].load(Ordering::Acquire);
        if word & DEAD == 0 {
            Incarnation::new(core, word >> 1)
        } else {
            None
        }
    }

    /// Returns whether this generation of the core is announced and not marked dead. False for 0.
    ///
    /// # Panics
    /// If `core` is not below [`CORES`].
    fn is_announced(&self, core: usize, generation: u32) -> bool {
        // Acquire pairs with the Release in `announce` and `mark_dead`.
        let word = self.words[core].load(Ordering::Acquire);
        generation != 0 && word == generation << 1
    }
}

/// The incarnations that use one object: for each core, the generation that attached last.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Attached<'a> {
    generations: &'a [AtomicU32; CORES],
    incarnations: Incarnations<'a>,
}

impl<'a> Attached<'a> {
    pub(crate) const fn new(
        generations: &'a [AtomicU32; CORES],
        incarnations: Incarnations<'a>,
    ) -> Self {
        Self {
            generations,
            incarnations,
        }
    }

    pub(crate) const fn incarnations(&self) -> Incarnations<'a> {
        self.incarnations
    }

    /// Returns the generation that attached last, for [`Attached::insert`]. `None` if it is this
    /// incarnation, or if this one is not alive: it must not disown a later one that has attached.
    pub(crate) fn earlier(&self, incarnation: Incarnation) -> Option<u32> {
        // Acquire pairs with the Release in `insert`: a core that sees a later incarnation attached
        // also sees its announcement, so `is_alive` below returns false.
        let generation = self.generations[incarnation.core()].load(Ordering::Acquire);
        (generation != incarnation.generation && self.incarnations.is_alive(incarnation))
            .then_some(generation)
    }

    /// Marks this incarnation as attached. The caller has disowned everything that earlier
    /// incarnations of its core left in the object. Returns `false` if another incarnation, or
    /// another end of this one, attached first: then check again.
    #[must_use]
    pub(crate) fn insert(&self, incarnation: Incarnation, earlier: u32) -> bool {
        // Release pairs with the Acquire in `earlier`: a core that sees this incarnation attached
        // also sees what was disowned and that the incarnation was announced.
        self.generations[incarnation.core()]
            .compare_exchange(
                earlier,
                incarnation.generation,
                Ordering::Release,
                Ordering::Relaxed,
            )
            .is_ok()
    }

    /// Returns whether the incarnation of this core that attached last is alive. A later one that
    /// is announced but has not attached does not count.
    pub(crate) fn has_living(&self, core: usize) -> bool {
        let generation = self.generations[core].load(Ordering::Relaxed);
        self.incarnations.is_announced(core, generation)
    }

    /// Returns whether an owner word with `core` and these bits of a generation belongs to a living
    /// incarnation. False for a core that does not exist. The caller loaded the owner word with
    /// Acquire; its owner stored it with Release after it was announced and had attached.
    #[inline]
    pub(crate) fn is_alive(&self, core: usize, bits: u32, mask: u32) -> bool {
        let Some(word) = self.generations.get(core) else {
            return false;
        };
        let generation = word.load(Ordering::Relaxed);
        generation & mask == bits && self.incarnations.is_announced(core, generation)
    }
}

#[cfg(not(loom))]
#[cfg(test)]
mod tests {
    use super::*;
    use crate::fault::zeroed;

    fn incarnation(core: usize, generation: u32) -> Incarnation {
        Incarnation::new(core, generation).unwrap()
    }

    #[test]
    fn an_incarnation_is_alive_from_its_announcement_to_its_end() {
        let incarnations = Incarnations::attach(zeroed(Incarnations::WORDS)).unwrap();
        assert!(
            !incarnations.is_alive(incarnation(1, 1)),
            "zeroed memory has no incarnation"
        );
        assert_eq!(incarnations.current(1), None);
        incarnations.announce(incarnation(1, 1)).unwrap();
        incarnations.announce(incarnation(1, 1)).unwrap();
        assert!(incarnations.is_alive(incarnation(1, 1)));
        assert!(!incarnations.is_alive(incarnation(0, 1)));
        assert!(incarnations.mark_dead(incarnation(1, 1)));
        assert!(!incarnations.is_alive(incarnation(1, 1)));
        assert_eq!(
            incarnations.announce(incarnation(1, 1)),
            Err(Outdated { current: 1 }),
            "the dead stay dead"
        );
        incarnations.announce(incarnation(1, 2)).unwrap();
        assert!(
            !incarnations.mark_dead(incarnation(1, 1)),
            "a late mark does not hit the successor"
        );
        assert_eq!(incarnations.current(1), Some(incarnation(1, 2)));
        assert_eq!(
            incarnations.announce(incarnation(1, 1)),
            Err(Outdated { current: 2 })
        );
    }

    #[test]
    fn numbers_out_of_range_make_no_incarnation() {
        assert_eq!(Incarnation::new(CORES, 1), None);
        assert_eq!(Incarnation::new(0, 0), None);
        assert!(Incarnation::new(0, 0x3FFF_FFFF).is_some());
        assert_eq!(Incarnation::new(0, 0x4000_0000), None);
    }

    /// If the word of a core is overwritten with garbage, the core is alive again after at most 8
    /// refused resets.
    #[test]
    fn a_scribbled_word_locks_no_core_out() {
        let words = zeroed(Incarnations::WORDS);
        let incarnations = Incarnations::attach(words).unwrap();
        for generation in [1, 2, 1000, MAX_GENERATION - 100] {
            for scribble in (0..32).map(|bit| 1 << bit).chain([u32::MAX, 0x1234_5678]) {
                for scribble in [scribble, scribble ^ (generation << 1), !scribble] {
                    words[1].store(scribble, Ordering::Relaxed);
                    let mut resets =
                        (generation..).map(|g| incarnations.announce(incarnation(1, g)));
                    let refused = resets.by_ref().position(|end| end.is_ok()).unwrap();
                    assert!(
                        refused <= 8,
                        "{generation}: {scribble:#x}, {refused} resets"
                    );
                }
            }
        }
    }

    #[test]
    fn a_scribbled_word_is_no_incarnation() {
        let words = zeroed(Incarnations::WORDS);
        let incarnations = Incarnations::attach(words).unwrap();
        for word in [0, 1, u32::MAX, 1 << 31] {
            words[0].store(word, Ordering::Relaxed);
            assert!(!incarnations.is_alive(incarnation(0, 1)));
            let _ = incarnations.current(0);
        }
    }
}
