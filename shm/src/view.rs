//! Views of a slot's words, for working in place.

use crate::sync::{AtomicU32, Ordering};

/// Words of a slot to read in place. What they hold may be an allegation of another core.
#[derive(Clone, Copy, Debug)]
pub struct WordsRef<'a>(&'a [AtomicU32]);

/// Words of a slot to fill in place; not yet visible as a value to anyone else.
#[derive(Debug)]
pub struct WordsMut<'a>(&'a [AtomicU32]);

#[allow(clippy::len_without_is_empty, reason = "a slot is never empty")]
impl<'a> WordsRef<'a> {
    pub(crate) const fn new(words: &'a [AtomicU32]) -> Self {
        Self(words)
    }

    /// How many words; at least 1.
    #[inline]
    #[must_use]
    pub const fn len(&self) -> usize {
        self.0.len()
    }

    /// The word at `index`.
    ///
    /// # Panics
    /// If `index` is not below [`WordsRef::len`].
    #[inline]
    #[must_use]
    pub fn get(&self, index: usize) -> u32 {
        self.0[index].load(Ordering::Relaxed)
    }

    /// Copies from the first word on, as many as both have, and returns how many.
    #[inline]
    pub fn copy_to(&self, into: &mut [u32]) -> usize {
        // One comparison for the usual case, in which the caller's length is often a constant.
        if let Some(words) = self.0.get(..into.len()) {
            for (to, from) in into.iter_mut().zip(words) {
                *to = from.load(Ordering::Relaxed);
            }
            return into.len();
        }
        for (to, from) in into.iter_mut().zip(self.0) {
            *to = from.load(Ordering::Relaxed);
        }
        self.0.len()
    }

    /// The words themselves, for a caller that cannot keep a view, such as C. They stay mapped, but
    /// what is in them is this value only as long as the view says so.
    #[inline]
    #[must_use]
    pub const fn as_slice(&self) -> &'a [AtomicU32] {
        self.0
    }

    /// All words in order.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = u32> + use<'a> {
        self.0.iter().map(|word| word.load(Ordering::Relaxed))
    }
}

#[allow(clippy::len_without_is_empty, reason = "a slot is never empty")]
impl<'a> WordsMut<'a> {
    pub(crate) const fn new(words: &'a [AtomicU32]) -> Self {
        Self(words)
    }

    /// How many words; at least 1.
    #[inline]
    #[must_use]
    pub const fn len(&self) -> usize {
        self.0.len()
    }

    /// The word at `index`: what was set, or what an earlier value left there.
    ///
    /// # Panics
    /// If `index` is not below [`WordsMut::len`].
    #[inline]
    #[must_use]
    pub fn get(&self, index: usize) -> u32 {
        self.0[index].load(Ordering::Relaxed)
    }

    /// Sets the word at `index`.
    ///
    /// # Panics
    /// If `index` is not below [`WordsMut::len`].
    #[inline]
    pub fn set(&mut self, index: usize, value: u32) {
        self.0[index].store(value, Ordering::Relaxed);
    }

    /// The words themselves, for a caller that cannot keep a view, such as C. They are the caller's
    /// to write only until the value is sent.
    #[inline]
    #[must_use]
    pub const fn as_slice(&self) -> &'a [AtomicU32] {
        self.0
    }

    /// Copies `from` to the first words, as many as both have, and returns how many. The rest
    /// stays.
    #[inline]
    pub fn copy_from(&mut self, from: &[u32]) -> usize {
        if let Some(words) = self.0.get(..from.len()) {
            for (to, from) in words.iter().zip(from) {
                to.store(*from, Ordering::Relaxed);
            }
            return from.len();
        }
        for (to, from) in self.0.iter().zip(from) {
            to.store(*from, Ordering::Relaxed);
        }
        self.0.len()
    }

    /// Zeroes the words from `first` on.
    #[inline]
    pub(crate) fn zero_from(&mut self, first: usize) {
        for word in &self.0[first..] {
            word.store(0, Ordering::Relaxed);
        }
    }
}
