//! The map of the LMU: a header that describes the layout, and the regions.
//!
//! Words 0 ..= 15: magic, version, layout hash, ready. Words 16 ..= 31: the [incarnation
//! table](crate::incarnation). Then the regions in the order of the [`Layout`], each from a line
//! boundary on. The boot core (or the supply) formats the LMU once at power-on: it zeroes it,
//! writes the header, and publishes `ready` last; if it dies before that, its successor formats
//! again. The other cores attach, which checks that they were built with the same layout.

use crate::incarnation::Incarnations;
use crate::shape::{FitError, LINE_WORDS, fit, whole_lines};
use crate::sync::{AtomicU32, Ordering};

const MAGIC_AT: usize = 0;
const VERSION_AT: usize = 1;
const LAYOUT_AT: usize = 2;
const READY_AT: usize = 3;
const INCARNATIONS_AT: usize = LINE_WORDS;
const HEADER_WORDS: usize = INCARNATIONS_AT + Incarnations::WORDS;

/// "TLMU"
const MAGIC: u32 = 0x544C_4D55;
/// Increased whenever the meaning of a primitive's words changes.
const VERSION: u32 = 3;
/// A value that zeroed or erased memory does not have.
const READY: u32 = 0x5EAD_1E55;

/// The regions of an LMU, in order. Every image of a system must have the same layout. In Rust it
/// is a constant made by a chain of [regions](crate::region); C makes it at run time.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    words: usize,
    hash: u32,
}

impl Layout {
    /// A layout of the header without regions.
    pub const EMPTY: Self = Self {
        words: HEADER_WORDS,
        hash: 0x811C_9DC5,
    };

    /// Returns this layout with a further region of `words` words at its end. The hash is FNV-1a
    /// over names and sizes: images with different layouts must not share an LMU.
    #[must_use]
    pub const fn with(self, name: &str, words: usize) -> Self {
        let mut hash = self.hash;
        let name = name.as_bytes();
        let mut j = 0;
        while j < name.len() {
            hash = fnv(hash, name[j]);
            j += 1;
        }
        // 0xFF ends the name: UTF-8 never contains it.
        hash = fnv(hash, 0xFF);
        let size = (words as u32).to_le_bytes();
        let mut j = 0;
        while j < size.len() {
            hash = fnv(hash, size[j]);
            j += 1;
        }
        Self {
            words: self.words + whole_lines(words),
            hash,
        }
    }

    /// Returns the number of words that the layout needs, including the header.
    #[must_use]
    pub const fn total_words(&self) -> usize {
        self.words
    }

    /// Returns a hash. It very probably differs if names, sizes or order of the regions differ.
    #[must_use]
    pub const fn hash(&self) -> u32 {
        self.hash
    }
}

const fn fnv(hash: u32, byte: u8) -> u32 {
    (hash ^ byte as u32).wrapping_mul(0x0100_0193)
}

/// Why a core cannot attach to an LMU.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum MapError {
    /// The LMU has fewer words than the layout needs.
    TooSmall,
    /// The LMU does not begin at a boundary of 64 bytes.
    Misaligned,
    /// The LMU is not formatted yet: try again later.
    NotReady,
    /// The ready word is set, but this is not an LMU of this project.
    WrongMagic,
    /// Another version of this crate formatted the LMU.
    WrongVersion,
    /// An image with another layout formatted the LMU.
    WrongLayout,
}

impl core::fmt::Display for MapError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::TooSmall => "the LMU has fewer words than the layout needs",
            Self::Misaligned => "the LMU does not begin at a boundary of 64 bytes",
            Self::NotReady => "the LMU is not formatted yet",
            Self::WrongMagic => "this is not an LMU of this project",
            Self::WrongVersion => "another version of this crate formatted the LMU",
            Self::WrongLayout => "an image with another layout formatted the LMU",
        })
    }
}

impl core::error::Error for MapError {}

impl From<FitError> for MapError {
    fn from(error: FitError) -> Self {
        match error {
            FitError::TooSmall => Self::TooSmall,
            FitError::Misaligned => Self::Misaligned,
        }
    }
}

/// An LMU that is formatted with a known layout.
#[derive(Clone, Copy, Debug)]
pub struct Map<'a> {
    words: &'a [AtomicU32],
    layout: Layout,
}

impl<'a> Map<'a> {
    /// Formats an LMU: zeroes it and publishes the layout. The boot core or the supply calls this
    /// at power-on, before any other core uses the LMU. If only the boot core is reset, it must
    /// [attach](Map::attach) instead.
    ///
    /// # Errors
    /// [`FitError`] if the LMU is too small for the layout or not at a line boundary.
    pub fn format(words: &'a [AtomicU32], layout: Layout) -> Result<Self, FitError> {
        let words = fit(words, layout.total_words())?;
        words[READY_AT].store(0, Ordering::Relaxed);
        for word in words {
            word.store(0, Ordering::Relaxed);
        }
        words[MAGIC_AT].store(MAGIC, Ordering::Relaxed);
        words[VERSION_AT].store(VERSION, Ordering::Relaxed);
        words[LAYOUT_AT].store(layout.hash(), Ordering::Relaxed);
        // Release pairs with the Acquire in `attach`: a core that sees ready sees all other words.
        words[READY_AT].store(READY, Ordering::Release);
        Ok(Self { words, layout })
    }

    /// Attaches to an LMU that was formatted with the same layout. Never blocks.
    ///
    /// # Errors
    /// [`MapError`]. Only [`MapError::NotReady`] can disappear without a change of the images.
    pub fn attach(words: &'a [AtomicU32], layout: Layout) -> Result<Self, MapError> {
        let words = fit(words, layout.total_words())?;
        // Acquire pairs with the Release in `format`.
        if words[READY_AT].load(Ordering::Acquire) != READY {
            return Err(MapError::NotReady);
        }
        if words[MAGIC_AT].load(Ordering::Relaxed) != MAGIC {
            return Err(MapError::WrongMagic);
        }
        if words[VERSION_AT].load(Ordering::Relaxed) != VERSION {
            return Err(MapError::WrongVersion);
        }
        if words[LAYOUT_AT].load(Ordering::Relaxed) != layout.hash() {
            return Err(MapError::WrongLayout);
        }
        Ok(Self { words, layout })
    }

    /// Returns the words of a region of `count` words that begins at word `begin`, rounded up to
    /// whole cache lines. Needed only for a layout that was made at run time, because a
    /// [`Region`](crate::region::Region) holds both numbers.
    ///
    /// # Errors
    /// [`FitError`] if the layout ends before this region does.
    pub fn words(&self, begin: usize, count: usize) -> Result<&'a [AtomicU32], FitError> {
        let words = &self.words[..self.layout.total_words()];
        let end = begin.saturating_add(whole_lines(count));
        words.get(begin..end).ok_or(FitError::TooSmall)
    }

    /// Returns the incarnation table of the cores.
    #[must_use]
    pub fn incarnations(&self) -> Incarnations<'a> {
        Incarnations::new(&self.words[INCARNATIONS_AT..INCARNATIONS_AT + Incarnations::WORDS])
    }
}

#[cfg(not(loom))]
#[cfg(test)]
mod tests {
    use super::*;
    use crate::fault::{kill_at, zeroed};

    const A: Layout = Layout::EMPTY.with("a", 3);
    const LAYOUT: Layout = A.with("b", 17);
    const OTHER: Layout = A.with("b", 18);
    const WORDS: usize = LAYOUT.total_words();

    #[test]
    fn regions_begin_at_lines_and_do_not_overlap() {
        assert_eq!(Layout::EMPTY.total_words(), 32);
        assert_eq!(A.total_words(), 48);
        assert_eq!(WORDS, 80);
        let map = Map::format(zeroed(WORDS), LAYOUT).unwrap();
        assert_eq!(map.words(32, 3).unwrap().len(), 16);
        assert_eq!(map.words(48, 17).unwrap().len(), 32);
        assert_eq!(map.words(48, 17).unwrap().as_ptr().addr() % 64, 0);
        assert_eq!(map.words(48, 33).unwrap_err(), FitError::TooSmall);
        assert_eq!(map.words(96, 1).unwrap_err(), FitError::TooSmall);
    }

    #[test]
    fn names_and_sizes_make_the_hash() {
        assert_ne!(LAYOUT.hash(), OTHER.hash());
        assert_ne!(A.hash(), Layout::EMPTY.with("ab", 3).hash());
        assert_ne!(Layout::EMPTY.hash(), A.hash());
    }

    /// The hash of "foobar" equals the test value that the authors of FNV-1a publish.
    #[test]
    fn the_hash_is_fnv_1a() {
        let hash = b"foobar"
            .iter()
            .fold(0x811C_9DC5, |hash, byte| fnv(hash, *byte));
        assert_eq!(hash, 0xBF9C_F968);
    }

    #[test]
    fn attach_returns_what_is_wrong() {
        let words = zeroed(WORDS);
        let attach = |layout| Map::attach(words, layout).map(|_| ());
        assert_eq!(attach(LAYOUT), Err(MapError::NotReady));
        Map::format(words, LAYOUT).unwrap();
        assert_eq!(attach(LAYOUT), Ok(()));
        assert_eq!(attach(OTHER), Err(MapError::WrongLayout));
        words[VERSION_AT].store(VERSION + 1, Ordering::Relaxed);
        assert_eq!(attach(LAYOUT), Err(MapError::WrongVersion));
        words[MAGIC_AT].store(0, Ordering::Relaxed);
        assert_eq!(attach(LAYOUT), Err(MapError::WrongMagic));
        assert_eq!(
            Map::attach(&words[..WORDS - 1], LAYOUT).map(|_| ()),
            Err(MapError::TooSmall)
        );
        assert_eq!(
            Map::attach(&zeroed(WORDS + 1)[1..], LAYOUT).map(|_| ()),
            Err(MapError::Misaligned)
        );
    }

    #[test]
    fn format_forgets_what_was_there() {
        let words = zeroed(WORDS);
        for word in words {
            word.store(u32::MAX, Ordering::Relaxed);
        }
        let map = Map::format(words, LAYOUT).unwrap();
        assert!(
            map.words(48, 17)
                .unwrap()
                .iter()
                .all(|word| word.load(Ordering::Relaxed) == 0)
        );
        assert_eq!(map.incarnations().current(0), None);
    }

    #[test]
    fn killed_at_every_step_of_format_no_core_attaches_and_the_successor_formats() {
        // Miri takes long for each step, so it runs only some of those that zero the memory.
        for at in (0..).step_by(if cfg!(miri) { 17 } else { 1 }) {
            let words = zeroed(WORDS);
            for word in words {
                word.store(u32::MAX, Ordering::Relaxed);
            }
            let done = kill_at(at, || Map::format(words, LAYOUT).is_ok());
            if done.is_some() {
                assert!(at > WORDS);
                break;
            }
            assert_eq!(
                Map::attach(words, LAYOUT).map(|_| ()),
                Err(MapError::NotReady)
            );
            Map::format(words, LAYOUT).unwrap();
            assert!(Map::attach(words, LAYOUT).is_ok());
        }
    }
}
