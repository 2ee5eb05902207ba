//! Payloads in the LMU: access to the words of a slot in place, and the codec of a payload.

use crate::sync::{AtomicU32, Ordering};

/// A word has a value that its writer cannot have written, so the whole value is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Corrupt;

impl core::fmt::Display for Corrupt {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("a word has an impossible value")
    }
}

impl core::error::Error for Corrupt {}

/// A type that crosses the LMU as a fixed number of words: the codec of a payload.
///
/// ```
/// use tandem_shm::region::{Fifo, Region};
/// use tandem_shm::{Corrupt, Payload};
///
/// struct Order {
///     speed: u32,
///     brakes: bool,
/// }
///
/// impl Payload for Order {
///     const WORDS: usize = 2;
///
///     fn store(&self, put: &mut impl FnMut(u32)) {
///         put(self.speed);
///         put(self.brakes.into());
///     }
///
///     fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
///         let speed = take();
///         let brakes = match take() {
///             0 => false,
///             1 => true,
///             _ => return Err(Corrupt),
///         };
///         Ok(Self { speed, brakes })
///     }
/// }
///
/// const ORDERS: Region<Fifo<Order, 8>> = Region::first("orders");
/// ```
pub trait Payload: Sized {
    /// Number of words of a value; at least 1.
    const WORDS: usize;

    /// Writes the value: calls `put` with each word, in order.
    fn store(&self, put: &mut impl FnMut(u32));

    /// Reads a value: calls `take` for each word, in order. Another core wrote the words and they
    /// may be garbage: refuse words that are not a value of the type.
    ///
    /// # Errors
    /// [`Corrupt`] if a word has an impossible value.
    fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt>;
}

impl Payload for u32 {
    const WORDS: usize = 1;

    #[inline]
    fn store(&self, put: &mut impl FnMut(u32)) {
        put(*self);
    }

    #[inline]
    fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        Ok(take())
    }
}

impl<const N: usize> Payload for [u32; N] {
    const WORDS: usize = N;

    #[inline]
    fn store(&self, put: &mut impl FnMut(u32)) {
        self.iter().copied().for_each(put);
    }

    #[inline]
    fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        Ok(core::array::from_fn(|_| take()))
    }
}

/// Words of a slot that the caller reads in place. Another core wrote them; they may be garbage.
#[derive(Clone, Copy, Debug)]
pub struct WordsRef<'a>(&'a [AtomicU32]);

/// Words of a slot that the caller fills in place. They are not yet a value for other cores.
#[derive(Debug)]
pub struct WordsMut<'a>(&'a [AtomicU32]);

impl<'a> WordsRef<'a> {
    pub(crate) const fn new(words: &'a [AtomicU32]) -> Self {
        Self(words)
    }

    /// Returns the word at `index`.
    ///
    /// # Panics
    /// If the slot has no such word.
    #[inline]
    #[must_use]
    pub fn get(&self, index: usize) -> u32 {
        self.0[index].load(Ordering::Relaxed)
    }

    /// Returns all words in order.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = u32> + use<'a> {
        self.0.iter().map(|word| word.load(Ordering::Relaxed))
    }

    /// Returns the words as a slice, for a caller that cannot keep a view, such as C. They stay
    /// mapped, but they hold this value only while the view is valid.
    #[inline]
    #[must_use]
    pub const fn as_slice(&self) -> &'a [AtomicU32] {
        self.0
    }
}

impl<'a> WordsMut<'a> {
    pub(crate) const fn new(words: &'a [AtomicU32]) -> Self {
        Self(words)
    }

    /// Sets the word at `index`.
    ///
    /// # Panics
    /// If the slot has no such word.
    #[inline]
    pub fn set(&mut self, index: usize, value: u32) {
        self.0[index].store(value, Ordering::Relaxed);
    }

    /// Returns the words as a slice, for a caller that cannot keep a view, such as C. The caller
    /// may write to them only until the value is sent.
    #[inline]
    #[must_use]
    pub const fn as_slice(&self) -> &'a [AtomicU32] {
        self.0
    }
}

/// Stores a value in its words.
#[inline]
pub(crate) fn store<T: Payload>(words: &[AtomicU32], value: &T) {
    let mut at = 0;
    value.store(&mut |value| {
        if let Some(word) = words.get(at) {
            word.store(value, Ordering::Relaxed);
        }
        at += 1;
    });
}

/// Loads a value from its words.
#[inline]
pub(crate) fn load<T: Payload>(words: &[AtomicU32]) -> Result<T, Corrupt> {
    let mut at = 0;
    T::load(&mut || {
        at += 1;
        words
            .get(at - 1)
            .map_or(0, |word| word.load(Ordering::Relaxed))
    })
}
