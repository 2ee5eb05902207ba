//! The incarnation table: which incarnation of each core is the current one, and whether it still
//! runs.
//!
//! One word for each core: `generation << 1 | dead`, 0 before the first incarnation. A core
//! announces its generation when it starts; a supervisor that has seen it die marks it dead. An
//! incarnation is alive while it is the announced one and not marked. Any core may take over words
//! in the LMU whose owner is not alive.
//!
//! An owner word of a lock or a pool has room for only a few bits of a generation. Beside it,
//! `Attached` keeps for each core the whole generation of the last incarnation that attached. The
//! first attachment of an incarnation disowns everything that its predecessors left. So no later
//! incarnation is mistaken for the owner, however many incarnations are between them.

use crate::shape::{FitError, LINE_WORDS, fit};
use crate::sync::{AtomicU32, Ordering};

/// How many cores share an LMU.
pub const CORES: usize = 3;

/// The largest generation: 30 bits. At one reset a second that is 34 years.
pub const MAX_GENERATION: u32 = (1 << 30) - 1;

const DEAD: u32 = 1;

/// How many incarnations a straggler may be behind and still be refused. A word that is further
/// ahead of a core's generation is garbage: it must not lock the core out.
const MAX_LIVES_BEHIND: u32 = 7;

/// One incarnation of one core.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Incarnation {
    core: u8,
    generation: u32,
}

impl Incarnation {
    /// Incarnation number `generation` (1 ..= [`MAX_GENERATION`]) of core `core` (below [`CORES`]);
    /// `None` if a number is out of its range.
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

    /// The core, below [`CORES`].
    #[must_use]
    pub const fn core(self) -> usize {
        self.core as usize
    }

    /// Which of the core's incarnations, from 1 on.
    #[must_use]
    pub const fn generation(self) -> u32 {
        self.generation
    }
}

/// A later incarnation of the same core is already announced: this one was given up and must stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Outdated {
    /// The announced generation.
    pub current: u32,
}

/// The incarnation table in the LMU.
#[derive(Clone, Copy, Debug)]
pub struct Incarnations<'a> {
    words: &'a [AtomicU32],
}

impl<'a> Incarnations<'a> {
    /// Words that the table takes.
    pub const WORDS: usize = LINE_WORDS;

    /// The table in these words.
    ///
    /// # Errors
    /// [`FitError`] if the words are too few or not at a line boundary.
    pub fn attach(words: &'a [AtomicU32]) -> Result<Self, FitError> {
        Ok(Self {
            words: fit(words, Self::WORDS)?,
        })
    }

    /// The table in words that come from a map.
    pub(crate) const fn new(words: &'a [AtomicU32]) -> Self {
        Self { words }
    }

    /// Announces an incarnation at its start. From here on other cores may take over objects that
    /// earlier incarnations of this core owned. Announcing the same incarnation again changes
    /// nothing, unless it was marked dead.
    ///
    /// A generation that is more than 7 ahead of this one does not belong to a later incarnation:
    /// the word is garbage, and is overwritten. Smaller garbage costs the core at most 8 resets.
    ///
    /// # Errors
    /// [`Outdated`] if this incarnation is not the latest, or was marked dead: it must stop.
    pub fn announce(&self, incarnation: Incarnation) -> Result<(), Outdated> {
        let word = &self.words[incarnation.core()];
        let new = incarnation.generation << 1;
        let mut seen = word.load(Ordering::Relaxed);
        // Only a supervisor's mark or a competing incarnation can change the word here; both are
        // rare.
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

    /// Marks an incarnation as dead: it was seen to end and will not run again. Returns whether it
    /// was the announced incarnation; if not, nothing changes. For the supervisor of the cores.
    pub fn mark_dead(&self, incarnation: Incarnation) -> bool {
        let alive = incarnation.generation << 1;
        // Release pairs with the Acquire in `is_announced`: a core that sees the mark sees what the
        // dead incarnation did, as far as the supervisor has seen it.
        self.words[incarnation.core()]
            .compare_exchange(alive, alive | DEAD, Ordering::Release, Ordering::Relaxed)
            .is_ok()
    }

    /// Whether this is the announced incarnation of its core and not marked dead.
    #[must_use]
    pub fn is_alive(&self, incarnation: Incarnation) -> bool {
        self.is_announced(incarnation.core(), incarnation.generation)
    }

    /// The announced incarnation of a core, if it is not marked dead.
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

    /// Whether this generation of the core is announced and not marked dead. False for 0.
    ///
    /// # Panics
    /// If `core` is not below [`CORES`].
    fn is_announced(&self, core: usize, generation: u32) -> bool {
        // Acquire pairs with the Release in `announce` and `mark_dead`.
        let word = self.words[core].load(Ordering::Acquire);
        generation != 0 && word == generation << 1
    }
}

/// The incarnations that use one object: for each core the generation that attached last.
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

    /// The argument for [`Attached::insert`]. `None` if this incarnation has attached, or is not
    /// alive: a later incarnation may have attached, which must not be disowned.
    pub(crate) fn earlier(&self, incarnation: Incarnation) -> Option<u32> {
        // Acquire pairs with the Release in `insert`: a core that sees a later incarnation attached
        // sees below that it was announced.
        let generation = self.generations[incarnation.core()].load(Ordering::Acquire);
        (generation != incarnation.generation && self.incarnations.is_alive(incarnation))
            .then_some(generation)
    }

    /// Marks this incarnation as attached, after everything that earlier incarnations of its core
    /// left in the object is disowned. `false` if another incarnation, or another end of this one,
    /// was first: then check again.
    #[must_use]
    pub(crate) fn insert(&self, incarnation: Incarnation, earlier: u32) -> bool {
        // Release pairs with the Acquire in `earlier`: a core that sees this incarnation attached
        // sees what was disowned, and that this incarnation was announced.
        self.generations[incarnation.core()]
            .compare_exchange(
                earlier,
                incarnation.generation,
                Ordering::Release,
                Ordering::Relaxed,
            )
            .is_ok()
    }

    /// Whether the incarnation of this core that attached last is alive. A later incarnation that
    /// is announced but has not attached does not count.
    pub(crate) fn has_living(&self, core: usize) -> bool {
        let generation = self.generations[core].load(Ordering::Relaxed);
        self.incarnations.is_announced(core, generation)
    }

    /// Whether an owner word with `core` and these bits of a generation belongs to an incarnation
    /// that is alive. False for a core that does not exist. The caller has acquired the owner word,
    /// and its owner has released that word after it was announced and had attached.
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

    /// After garbage in its word, a core is alive again after a few resets.
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
