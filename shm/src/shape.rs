//! Size and alignment of regions of the LMU, and the shape of a region that is a ring of slots.

use crate::sync::AtomicU32;

/// Words of a cache line of 64 bytes, the unit in which regions are laid out.
pub const LINE_WORDS: usize = 16;

/// Returns `words` rounded up to whole cache lines.
#[inline]
pub(crate) const fn whole_lines(words: usize) -> usize {
    words.div_ceil(LINE_WORDS) * LINE_WORDS
}

/// Why a primitive does not fit the given words. The caller's layout is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FitError {
    /// Fewer words than the primitive's `words(...)` returns.
    TooSmall,
    /// The first word is not at a cache line of 64 bytes.
    Misaligned,
}

impl core::fmt::Display for FitError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::TooSmall => "fewer words than the primitive needs",
            Self::Misaligned => "the first word is not at a cache line of 64 bytes",
        })
    }
}

impl core::error::Error for FitError {}

/// Returns the first `needed` words, if there are enough and they start at a cache line.
#[inline]
pub(crate) fn fit(words: &[AtomicU32], needed: usize) -> Result<&[AtomicU32], FitError> {
    // loom's atomics are larger than a word, so lines have no meaning for them.
    if cfg!(not(loom)) && !words.as_ptr().addr().is_multiple_of(4 * LINE_WORDS) {
        return Err(FitError::Misaligned);
    }
    words.get(..needed).ok_or(FitError::TooSmall)
}

/// Like [`fit`], but returns an array, so that an index into it can be checked at compile time.
pub(crate) fn fit_exactly<const WORDS: usize>(
    words: &[AtomicU32],
) -> Result<&[AtomicU32; WORDS], FitError> {
    fit(words, WORDS)?.first_chunk().ok_or(FitError::TooSmall)
}

/// The number of slots of a channel and of words in each slot. All ends of a channel must get the
/// same shape; it is part of the build, not of the shared memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    slots: usize,
    slot_words: usize,
}

impl Shape {
    /// Returns the shape with `slots` slots (a power of two, 2 ..= 65536) of `slot_words` words
    /// each (at least 1), at most 2^28 words in all.
    ///
    /// # Panics
    /// If a number is out of its range; in a constant that is a compile error.
    #[must_use]
    #[inline]
    pub const fn new(slots: usize, slot_words: usize) -> Self {
        assert!(slots >= 2 && slots <= 1 << 16 && slots.is_power_of_two());
        assert!(slot_words >= 1 && slot_words <= (1 << 28) / slots);
        Self { slots, slot_words }
    }

    /// Returns the number of slots.
    #[must_use]
    #[inline]
    pub const fn slots(self) -> usize {
        self.slots
    }

    /// Returns the number of words of one slot.
    #[must_use]
    #[inline]
    pub const fn slot_words(self) -> usize {
        self.slot_words
    }
}
