//! The plain queue: blocks of bytes that one core hands over to another, as plain slices.
//!
//! It is a [`fifo`](crate::fifo) whose slot belongs to one end at a time: to the producer from
//! [`Producer::loan`] to [`Loan::send`], to the consumer from [`Consumer::item`] to
//! [`Incoming::release`]. The holder alone may access the bytes, so it gets them as an ordinary
//! array, in place, and reads and writes them at the speed of the memory. The borrow ends with the
//! hand-over: bytes cannot be kept. The words of the protocol (stamps, the released count, claims)
//! stay atomic, and deaths are handled as in the FIFO.
//!
//! This is the only module with unsafe code. What it assumes stands at [`PlainMap::new`], and why
//! in decision 0044. Values that are overwritten while they are read (newest value, broadcast)
//! belong to nobody, so they have no plain slices.
//!
//! ```
//! # use core::sync::atomic::AtomicU32;
//! use tandem_shm::incarnation::Incarnation;
//! use tandem_shm::map::Map;
//! use tandem_shm::plain::PlainMap;
//! use tandem_shm::region::{Plain, Region};
//!
//! const IMAGES: Region<Plain<4096, 2>> = Region::first("images");
//! # #[repr(align(64))]
//! # struct Lmu([AtomicU32; IMAGES.end().total_words()]);
//! # let lmu = Lmu([const { AtomicU32::new(0) }; IMAGES.end().total_words()]);
//! # let words = &lmu.0;
//! let map = Map::format(words, IMAGES.end()).unwrap();
//! // SAFETY: only the two ends below access the region, and no end has a successor.
//! let map = unsafe { PlainMap::new(map) };
//! # let [one, two] = [0, 1].map(|core| Incarnation::new(core, 1).unwrap());
//! # for incarnation in [one, two] {
//! #     map.incarnations().announce(incarnation).unwrap();
//! # }
//! let mut to = IMAGES.producer(&map, one).unwrap();
//! let mut from = IMAGES.consumer(&map, two).unwrap();
//!
//! let mut loan = to.loan().unwrap();
//! loan.bytes_mut().fill(7);
//! loan.send();
//!
//! let image = from.item().unwrap();
//! assert_eq!(image.bytes(), &[7; 4096]);
//! image.release();
//! ```
//!
//! Bytes cannot be kept after they were sent:
//!
//! ```compile_fail,E0505
//! fn keep(to: &mut tandem_shm::plain::Producer<'_, 64>) {
//!     let mut loan = to.loan().unwrap();
//!     let bytes = loan.bytes_mut();
//!     loan.send();
//!     bytes[0] = 1;
//! }
//! ```
//!
//! nor after they were released:
//!
//! ```compile_fail,E0505
//! fn keep(from: &mut tandem_shm::plain::Consumer<'_, 64>) -> u8 {
//!     let item = from.item().unwrap();
//!     let bytes = item.bytes();
//!     item.release();
//!     bytes[0]
//! }
//! ```
//!
//! and a slot is not lent twice:
//!
//! ```compile_fail,E0499
//! fn lend_twice(to: &mut tandem_shm::plain::Producer<'_, 64>) {
//!     let (mut one, mut two) = (to.loan().unwrap(), to.loan().unwrap());
//!     core::mem::swap(one.bytes_mut(), two.bytes_mut());
//! }
//! ```

#![allow(
    unsafe_code,
    reason = "plain access to words that their holder alone uses"
)]

use core::fmt;
use core::ops::Deref;

use crate::fifo::{self, Full};
use crate::map::Map;
use crate::shape::{FitError, Shape};
use crate::sync::AtomicU32;

/// Bytes of a word.
const WORD: usize = size_of::<u32>();

/// Returns the shape of a queue of `slots` blocks of `bytes`.
pub(crate) const fn shape(bytes: usize, slots: usize) -> Shape {
    Shape::new(slots, bytes.div_ceil(WORD))
}

/// A map whose [plain regions](crate::region::Plain) are accessed only by their ends.
#[derive(Clone, Copy)]
pub struct PlainMap<'a>(Map<'a>);

impl<'a> PlainMap<'a> {
    /// Makes plain slices available. Call it where the memory is mapped, in a board: what follows
    /// is safe code that keeps these rules.
    ///
    /// # Safety
    /// While `'a` lasts, for each plain region that is attached through this map or a copy of it:
    ///
    /// - It is one of the chain of regions that made the map's layout.
    /// - On each core and in each process that maps the memory, only the ends of the region access
    ///   its words. No code uses the slice of which the map was made, [`Map::words`], a pointer or
    ///   another region for it, and the LMU is not formatted again.
    /// - An incarnation is declared dead, or followed by another one, only when it no longer runs.
    ///
    /// A memory protection unit or the rights of the shared file can enforce the second rule. A
    /// core that breaks it causes a data race: the bytes that a holder reads may then change
    /// between two reads. See decision 0044.
    #[must_use]
    pub const unsafe fn new(map: Map<'a>) -> Self {
        Self(map)
    }
}

impl<'a> Deref for PlainMap<'a> {
    type Target = Map<'a>;

    fn deref(&self) -> &Map<'a> {
        &self.0
    }
}

/// Returns the place of the bytes in these words.
#[cfg(not(loom))]
#[inline]
const fn place<const BYTES: usize>(words: &[AtomicU32]) -> *mut [u8; BYTES] {
    assert!(BYTES <= size_of_val(words), "a slot has room for its bytes");
    // Atomics may be changed through a shared reference, so the pointer may be written through.
    words.as_ptr().cast_mut().cast()
}

/// The sending end. Each queue has one.
pub struct Producer<'a, const BYTES: usize>(fifo::Producer<'a>);

impl<'a, const BYTES: usize> Producer<'a, BYTES> {
    /// Attaches the producer, as [`fifo::Producer`]. The words come from a [`PlainMap`].
    pub(crate) fn attach(words: &'a [AtomicU32], shape: Shape) -> Result<Self, FitError> {
        Ok(Self(fifo::Producer::attach(words, shape)?))
    }

    /// Lends the next block to the caller, which fills it in place. It holds old bytes. Only
    /// [`Loan::send`] hands it over. Never blocks.
    ///
    /// # Errors
    /// [`Full`]: the consumer has not released a block yet.
    #[inline]
    pub fn loan(&mut self) -> Result<Loan<'_, 'a, BYTES>, Full> {
        Ok(Loan(self.0.loan()?))
    }
}

/// A block that is lent to the producer.
#[must_use = "only `send` hands over what was filled in"]
pub struct Loan<'p, 'a, const BYTES: usize>(fifo::Loan<'p, 'a, ()>);

impl<const BYTES: usize> Loan<'_, '_, BYTES> {
    /// Returns the bytes of the block, which only the caller can access. They begin at a cache line
    /// if a block is longer than 60 bytes, else at a word.
    #[cfg(not(loom))]
    #[inline]
    pub const fn bytes_mut(&mut self) -> &mut [u8; BYTES] {
        // SAFETY: the words are in bounds, and every byte is a `u8`. By the protocol the consumer
        // has released the slot and does not read it before `send`, which consumes this loan;
        // nothing else accesses it, as the caller of `PlainMap::new` promised. The loan borrows the
        // only producer, and the slice borrows the loan, so there is no second slice.
        unsafe { &mut *place(self.0.words().as_slice()) }
    }

    /// In a loom model: an access to each word that no other thread may make at this time.
    #[cfg(loom)]
    pub fn bytes_mut(&mut self) {
        let words = self.0.words().as_slice();
        words.iter().for_each(AtomicU32::write_plainly);
    }

    /// Hands the block over to the consumer.
    #[inline]
    pub fn send(self) {
        self.0.send();
    }
}

/// The receiving end. Each queue has one.
pub struct Consumer<'a, const BYTES: usize>(fifo::Consumer<'a>);

impl<'a, const BYTES: usize> Consumer<'a, BYTES> {
    /// Attaches the consumer, as [`fifo::Consumer`]. The words come from a [`PlainMap`].
    pub(crate) fn attach(words: &'a [AtomicU32], shape: Shape) -> Result<Self, FitError> {
        Ok(Self(fifo::Consumer::attach(words, shape)?))
    }

    /// Returns the next block, to be read in place, or `None` if the queue is empty. Later calls
    /// return the same block until [`Incoming::release`]. Never blocks.
    #[inline]
    pub fn item(&mut self) -> Option<Incoming<'_, 'a, BYTES>> {
        self.0.item().map(Incoming)
    }
}

/// A block that was received and not yet released.
#[must_use = "only `release` frees the block"]
pub struct Incoming<'c, 'a, const BYTES: usize>(fifo::Incoming<'c, 'a, ()>);

impl<const BYTES: usize> Incoming<'_, '_, BYTES> {
    /// Returns the bytes of the block, which do not change before the release. Another core wrote
    /// them: they may have any value.
    #[cfg(not(loom))]
    #[inline]
    #[must_use]
    pub const fn bytes(&self) -> &[u8; BYTES] {
        // SAFETY: the words are in bounds, and every byte is a `u8`. By the protocol the producer
        // has sent the slot and does not write to it before `release`, which consumes this item;
        // nothing else accesses it, as the caller of `PlainMap::new` promised. The slice borrows
        // the item.
        unsafe { &*place(self.0.words().as_slice()) }
    }

    /// In a loom model: a read of each word that no other thread may write to at this time.
    #[cfg(loom)]
    pub fn bytes(&self) {
        let words = self.0.words().as_slice();
        words.iter().for_each(AtomicU32::read_plainly);
    }

    /// Gives the block back to the producer.
    #[inline]
    pub fn release(self) {
        self.0.release();
    }
}

/// Shows the name alone: the words of a block belong to its holder.
macro_rules! shows_no_words {
    ($($of:ty, $name:literal, [$($bytes:tt)*];)*) => {$(
        impl<$($bytes)*> fmt::Debug for $of {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.debug_struct($name).finish_non_exhaustive()
            }
        }
    )*};
}

shows_no_words! {
    PlainMap<'_>, "PlainMap", [];
    Producer<'_, BYTES>, "Producer", [const BYTES: usize];
    Loan<'_, '_, BYTES>, "Loan", [const BYTES: usize];
    Consumer<'_, BYTES>, "Consumer", [const BYTES: usize];
    Incoming<'_, '_, BYTES>, "Incoming", [const BYTES: usize];
}
