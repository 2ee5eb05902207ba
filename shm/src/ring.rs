//! A ring of stamped slots with one writer: the base of newest-value and broadcast channels.
//!
//! Value number k (from 0, wrapping) lies in slot k mod n. The slot's stamp is `k << 1` while the
//! value is written and `k << 1 | 1` when it is complete; `head` counts the complete values. A
//! reader checks the stamp, reads the words, and checks the stamp again: a sequence lock for each
//! slot, after H.-J. Boehm, "Can seqlocks get along with programming language memory models?" (MSPC
//! 2012), fig. 6. In zeroed memory no slot has the stamp of a complete value.
//!
//! Limit: a reader that is stopped between its two checks for exactly a multiple of 2^31 values
//! does not detect that its value was overwritten. At one value per microsecond that is 36 minutes;
//! the watchdog resets a core that stops for that long.

use core::marker::PhantomData;

use crate::payload::{Payload, WordsMut, store};
use crate::shape::{FitError, LINE_WORDS, Shape, fit, fit_exactly};
use crate::sync::{AtomicU32, Ordering, fence};

/// The claim of the writing end: the last word of the head's line, which slots do not use. A map
/// gives a region whole lines.
pub(crate) const CLAIM_AT: usize = LINE_WORDS - 1;

/// The ring in the LMU. `SLOTS` is the number of slots if the compiler knows it, and otherwise 0.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ring<'a, const SLOTS: usize = 0> {
    head: &'a AtomicU32,
    slots: &'a [AtomicU32],
    /// The line of a ring that [`is_short`](Self::is_short): an index needs no check.
    short: Option<&'a [AtomicU32; LINE_WORDS]>,
    shape: Shape,
    /// Words from one slot to the next.
    stride: usize,
}

impl<'a> Ring<'a> {
    pub(crate) const fn words(shape: Shape, stride: usize) -> usize {
        Self::first_slot(shape, stride) + shape.slots() * stride
    }

    /// Small slots share the line of the head, so that each value moves only one line.
    const fn first_slot(shape: Shape, stride: usize) -> usize {
        if shape.slots() * stride < CLAIM_AT {
            1
        } else {
            LINE_WORDS
        }
    }
}

impl<'a, const SLOTS: usize> Ring<'a, SLOTS> {
    pub(crate) fn attach(
        words: &'a [AtomicU32],
        shape: Shape,
        stride: usize,
    ) -> Result<Self, FitError> {
        let short = match Self::is_short(shape.slot_words()) {
            true => Some(fit_exactly(words)?),
            false => None,
        };
        let words = fit(words, Ring::words(shape, stride))?;
        Ok(Self {
            head: &words[0],
            slots: &words[Ring::first_slot(shape, stride)..],
            short,
            shape,
            stride,
        })
    }

    /// Returns whether the compiler knows that the slots, of `slot_words` words, are in the line of
    /// the head, as in a small newest-value channel.
    #[inline]
    pub(crate) const fn is_short(slot_words: usize) -> bool {
        SLOTS > 0 && SLOTS * (1 + slot_words) < CLAIM_AT
    }

    #[inline]
    const fn short(&self) -> &'a [AtomicU32; LINE_WORDS] {
        match self.short {
            Some(line) => line,
            None => unreachable!(),
        }
    }

    /// Returns this ring for code that is compiled once for all numbers of slots.
    pub(crate) const fn any(self) -> Ring<'a> {
        let Self {
            head,
            slots,
            shape,
            stride,
            short: _,
        } = self;
        Ring {
            head,
            slots,
            short: None,
            shape,
            stride,
        }
    }

    pub(crate) const fn slot_words(&self) -> usize {
        self.shape.slot_words()
    }

    pub(crate) const fn slots(&self) -> u32 {
        match SLOTS {
            0 => self.shape.slots() as u32,
            slots => slots as u32,
        }
    }

    /// Returns the number of complete values that the writer has published.
    #[inline]
    pub(crate) fn head(&self) -> u32 {
        self.head_of(self.shape.slot_words())
    }

    /// Like `head`, for values of `slot_words` words. A constant saves instructions.
    #[inline]
    pub(crate) fn head_of(&self, slot_words: usize) -> u32 {
        let head = match Self::is_short(slot_words) {
            true => &self.short()[0],
            false => self.head,
        };
        // Acquire pairs with the Release in `complete`.
        head.load(Ordering::Acquire)
    }

    /// Reader: loads the line of the head into the cache.
    #[inline]
    pub(crate) fn prefetch(&self) {
        // Relaxed, because the value is not used.
        core::hint::black_box(self.head.load(Ordering::Relaxed));
    }

    #[inline]
    fn at(&self, k: u32) -> usize {
        (k & (self.slots() - 1)) as usize * self.stride
    }

    #[inline]
    fn stamp(&self, k: u32) -> &'a AtomicU32 {
        &self.slots[self.at(k)]
    }

    /// Returns the words of value k.
    #[inline]
    pub(crate) fn payload(&self, k: u32) -> &'a [AtomicU32] {
        self.slot(k, self.shape.slot_words()).1
    }

    /// Returns the stamp and `count` words of value k. A constant `count` saves instructions.
    #[inline]
    fn slot(&self, k: u32, count: usize) -> (&'a AtomicU32, &'a [AtomicU32]) {
        let slot = if Self::is_short(count) {
            let number = (k & (self.slots() - 1)) as usize;
            &self.short()[1 + number * (1 + count)..][..1 + count]
        } else {
            &self.slots[self.at(k)..][..1 + count]
        };
        (&slot[0], &slot[1..])
    }

    /// Writer: marks value k as being written.
    #[inline]
    fn begin(&self, k: u32) {
        self.stamp(k).store(k << 1, Ordering::Relaxed);
        // Release pairs with the Acquire fence in `is_intact`: a core that sees a word stored after
        // this also sees the stamp.
        fence(Ordering::Release);
    }

    /// Writer: marks value k as complete and publishes it.
    #[inline]
    fn complete(&self, k: u32) {
        self.stamp(k).store(complete(k), Ordering::Relaxed);
        // Release pairs with the Acquire in `head`: a core that sees the head sees the stamp and
        // the words.
        self.head.store(k.wrapping_add(1), Ordering::Release);
    }

    /// Reader: returns the result of `f` for the first `count` words of value k, or `None` if its
    /// slot does not hold it. The caller has read a head above k.
    #[inline]
    pub(crate) fn read<R>(
        &self,
        k: u32,
        count: usize,
        f: impl FnOnce(&'a [AtomicU32]) -> R,
    ) -> Option<R> {
        let (stamp, words) = self.slot(k, count);
        for word in further_lines(words) {
            // Relaxed, because the value is not used.
            core::hint::black_box(word.load(Ordering::Relaxed));
        }
        // Relaxed, as in `is_complete`.
        if stamp.load(Ordering::Relaxed) != complete(k) {
            return None;
        }
        let value = f(words);
        is_intact(stamp, k).then_some(value)
    }

    /// Reader, before the read: returns whether value k is in its slot. The caller has read a head
    /// above k.
    #[inline]
    pub(crate) fn is_complete(&self, k: u32) -> bool {
        // Relaxed: the head was read with Acquire, so the words belong to value k or to later ones.
        self.stamp(k).load(Ordering::Relaxed) == complete(k)
    }

    /// Reader, after the read: returns whether all words that were read belong to value k.
    #[inline]
    pub(crate) fn is_intact(&self, k: u32) -> bool {
        is_intact(self.stamp(k), k)
    }
}

/// Returns a word of each line of a slot but the first, which holds the stamp. All are accessed
/// before the words in order: the lines of a long value then move at the same time.
#[inline]
fn further_lines(words: &[AtomicU32]) -> impl Iterator<Item = &AtomicU32> {
    words.iter().skip(LINE_WORDS - 1).step_by(LINE_WORDS)
}

/// Reader, after the read: as [`Ring::is_intact`], with the stamp of value k.
#[inline]
fn is_intact(stamp: &AtomicU32, k: u32) -> bool {
    // Acquire pairs with the Release fence in `begin`.
    fence(Ordering::Acquire);
    stamp.load(Ordering::Relaxed) == complete(k)
}

/// Returns the stamp of value k when it is complete.
#[inline]
const fn complete(k: u32) -> u32 {
    k << 1 | 1
}

/// The number of a value. The count wraps around and continues over all incarnations of the writer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Stamp(pub u32);

impl Stamp {
    /// Returns how many values were published after `earlier`, up to and including this one.
    #[must_use]
    pub const fn since(self, earlier: Self) -> u32 {
        self.0.wrapping_sub(earlier.0)
    }
}

/// The writing end. Each ring has one.
#[derive(Debug)]
pub struct Writer<'a, T = ()> {
    ring: Ring<'a>,
    next: u32,
    payload: PhantomData<fn(&T)>,
}

impl<'a, T> Writer<'a, T> {
    /// Attaches the writer. It continues after the published values. An earlier incarnation may
    /// have written the next value, but no reader saw it: the head does not count it.
    pub(crate) fn attach(ring: Ring<'a>) -> Self {
        Self {
            ring,
            next: ring.head.load(Ordering::Relaxed),
            payload: PhantomData,
        }
    }

    #[inline]
    fn complete(&mut self) -> Stamp {
        let stamp = Stamp(self.next);
        self.ring.complete(stamp.0);
        self.next = stamp.0.wrapping_add(1);
        stamp
    }

    /// Lends the slot of the next value to the caller, which fills it in place. Its words hold an
    /// old value. Only [`Loan::publish`] publishes the value. Never blocks.
    #[inline]
    pub fn loan(&mut self) -> Loan<'_, 'a, T> {
        self.ring.begin(self.next);
        Loan {
            words: WordsMut::new(self.ring.payload(self.next)),
            writer: self,
        }
    }
}

impl<T: Payload> Writer<'_, T> {
    /// Publishes `value` as the newest and returns its number. Never blocks.
    #[inline]
    pub fn publish(&mut self, value: &T) -> Stamp {
        self.ring.begin(self.next);
        let words = self.ring.slot(self.next, T::WORDS).1;
        for word in further_lines(words) {
            word.store(0, Ordering::Relaxed);
        }
        store(words, value);
        self.complete()
    }
}

/// A slot that is lent to the writer.
#[derive(Debug)]
#[must_use = "only `publish` shows what was filled in"]
pub struct Loan<'w, 'a, T> {
    words: WordsMut<'a>,
    writer: &'w mut Writer<'a, T>,
}

impl<'a, T> Loan<'_, 'a, T> {
    /// Returns the words to fill.
    #[inline]
    pub const fn words(&mut self) -> &mut WordsMut<'a> {
        &mut self.words
    }

    /// Publishes the value and returns its number.
    #[inline]
    pub fn publish(self) -> Stamp {
        self.writer.complete()
    }
}
