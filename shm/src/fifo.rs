//! The FIFO channel: one producer sends values to one consumer in order, or finds the queue full.
//!
//! Value number k (from 0, wrapping) lies in slot k mod n, followed by its stamp, !k. The stamp
//! shows that the value is complete, so the consumer polls only the next slot: a small value and
//! its stamp share one cache line, and only that line moves (J. Giacomoni et al., "FastForward for
//! efficient pipeline parallelism", PPoPP 2008). In the other direction the consumer publishes how
//! many values it has released. The producer keeps a copy of that index and reads it again only
//! when the queue is full according to the copy.
//!
//! A queue of 64 or more slots moves fewer cache lines: its consumer publishes releases in groups
//! of 8, and the rest when it finds the queue empty. Until then up to 7 free slots look full to the
//! producer, so a protocol must not rely on the last 7 slots if its consumer never polls an empty
//! queue. In smaller queues the consumer publishes every release.
//!
//! Each end trusts only its private copy of its own index, not the other end's words: if the
//! distance between both indices is impossible (greater than the number of slots), the producer
//! returns full. If words were overwritten with garbage, the ends repair them. A consumer that
//! polls an empty queue publishes its index again. After every [`LOOKS_PER_DOUBT`] empty polls it
//! also checks one slot, each slot in turn. If that slot holds a complete value that is not the
//! last one received from it, the consumer continues with the nearest such value. The producer of a
//! full queue stamps its oldest value again.
//!
//! If the producer dies, only its unsent values are lost. If the consumer dies, its successor
//! receives the values that were not released, or not yet published as released: each value is
//! received at least once.

use core::marker::PhantomData;

use crate::payload::{Corrupt, Payload, WordsMut, WordsRef, load, store};
use crate::shape::{FitError, LINE_WORDS, Shape, fit, fit_exactly, whole_lines};
use crate::sync::{AtomicU32, Ordering};

/// The number of released values, in line 0, which the consumer writes.
const RELEASED_AT: usize = 0;
/// The claims of the ends: words of line 0 that neither sending nor receiving reads.
pub(crate) const PRODUCER_CLAIM_AT: usize = 1;
pub(crate) const CONSUMER_CLAIM_AT: usize = 2;
const SLOTS_AT: usize = LINE_WORDS;

/// Number of empty polls after which the consumer checks another slot.
#[cfg(not(loom))]
pub const LOOKS_PER_DOUBT: u32 = 32;
/// In loom models every empty poll checks another slot, so that the repair is modelled too.
#[cfg(loom)]
pub const LOOKS_PER_DOUBT: u32 = 1;

/// Returns the number of words of a queue of this shape: whole lines.
#[inline]
#[must_use]
pub const fn words(shape: Shape) -> usize {
    whole_lines(SLOTS_AT + shape.slots() * stride(shape.slot_words()))
}

/// Returns the distance between slots, in words. Only a slot longer than a line crosses a boundary.
#[inline]
const fn stride(slot_words: usize) -> usize {
    let slot = slot_words + 1;
    if slot <= LINE_WORDS {
        slot.next_power_of_two()
    } else {
        whole_lines(slot)
    }
}

/// A queue whose ends know the number of slots when they are compiled; 0: only when they attach.
#[derive(Clone, Copy, Debug)]
struct Queue<'a, const SLOTS: usize> {
    /// Lines 0 and 1: all of a queue that [`is_short`](Self::is_short). An index needs no check.
    lines: &'a [AtomicU32; SLOTS_AT + LINE_WORDS],
    slots: &'a [AtomicU32],
    slot_words: usize,
    stride: usize,
    /// The number of slots less 1: a mask, because the number of slots is a power of two.
    mask: u32,
}

impl<'a, const SLOTS: usize> Queue<'a, SLOTS> {
    fn attach(words: &'a [AtomicU32], shape: Shape) -> Result<Self, FitError> {
        let words = fit(words, self::words(shape))?;
        Ok(Self {
            lines: fit_exactly(words)?,
            slots: &words[SLOTS_AT..],
            slot_words: shape.slot_words(),
            stride: stride(shape.slot_words()),
            mask: shape.slots() as u32 - 1,
        })
    }

    /// Returns whether the compiler knows that all slots, of `slot_words` words, are in one line.
    #[inline]
    const fn is_short(slot_words: usize) -> bool {
        SLOTS > 0 && SLOTS * stride(slot_words) <= LINE_WORDS
    }

    #[inline]
    const fn mask(&self) -> u32 {
        match SLOTS {
            0 => self.mask,
            slots => slots as u32 - 1,
        }
    }

    /// Returns the word that counts the released values.
    #[inline]
    const fn released(&self) -> &'a AtomicU32 {
        &self.lines[RELEASED_AT]
    }

    #[inline]
    const fn is_full(&self, tail: u32, released: u32) -> bool {
        tail.wrapping_sub(released) > self.mask()
    }

    /// Returns the words and the stamp of value k.
    #[inline]
    fn slot(&self, k: u32) -> (&'a [AtomicU32], &'a AtomicU32) {
        self.slot_of(k, self.slot_words)
    }

    /// Like `slot`, for slots of `slot_words` words. A constant saves instructions. Always inlined:
    /// a call would need the queue in memory.
    #[inline(always)]
    fn slot_of(&self, k: u32, slot_words: usize) -> (&'a [AtomicU32], &'a AtomicU32) {
        let number = (k & self.mask()) as usize;
        let slot = if Self::is_short(slot_words) {
            &self.lines[SLOTS_AT + number * stride(slot_words)..][..slot_words + 1]
        } else {
            &self.slots[number * self.stride..][..slot_words + 1]
        };
        (&slot[..slot_words], &slot[slot_words])
    }

    #[inline]
    fn stamp(&self, k: u32) -> &'a AtomicU32 {
        self.slot(k).1
    }

    /// Returns whether the consumer publishes this released count now, or waits for a group of 8.
    #[inline]
    const fn is_group(&self, released: u32) -> bool {
        released.is_multiple_of(8) || self.mask() < 63
    }

    /// Consumer: publishes how many values it has released.
    #[inline]
    fn publish(&self, released: u32) {
        // Release pairs with the Acquire in `make_room`: the slot is read before it is
        // refilled.
        self.released().store(released, Ordering::Release);
    }

    /// Returns the number of the first value that does not fit, if the queue is not full.
    #[inline]
    const fn limit(&self, released: u32) -> u32 {
        released.wrapping_add(self.mask()).wrapping_add(1)
    }

    /// Returns how far the value in this slot is ahead of `head`. Returns `None` if the value is
    /// not complete or was received: received values stay in the slots of an empty queue.
    fn ahead(&self, slot: u32, head: u32) -> Option<u32> {
        // Acquire pairs with the Release in `complete`: a core that sees a value sees all earlier
        // values.
        let k = complete(self.stamp(slot).load(Ordering::Acquire));
        let ahead = k.wrapping_sub(head);
        let mask = self.mask();
        let is_ahead = k & mask == slot & mask && ahead < !mask;
        is_ahead.then_some(ahead)
    }

    /// Returns the number of the value with which a consumer continues if value `head` is missing.
    #[cold]
    fn nearest(self, head: u32) -> u32 {
        let ahead = (0..=self.mask()).filter_map(|slot| self.ahead(slot, head));
        let ahead = ahead.min().unwrap_or(0);
        // Value `head` may have arrived while the other slots were checked.
        match self.ahead(head, head) {
            Some(0) => head,
            _ => head.wrapping_add(ahead),
        }
    }
}

/// Converts a value's number to its stamp, and back. The stamp is not k + 1, because the compiler
/// would derive the next index from it, and each poll would wait for the previous value's line.
#[inline]
const fn complete(k: u32) -> u32 {
    !k
}

/// Repairs the stamp of value k, the oldest of a full queue, if it was overwritten.
#[cold]
#[inline(never)]
fn restore(stamp: &AtomicU32, k: u32) {
    if stamp.load(Ordering::Relaxed) != complete(k) {
        // Release pairs with the Acquire of the consumer that reads the stamp.
        stamp.store(complete(k), Ordering::Release);
    }
}

/// The queue is full: every slot holds a value that is not yet released.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Full;

impl core::fmt::Display for Full {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("the queue is full")
    }
}

impl core::error::Error for Full {}

/// The sending end. Each queue has one. `SLOTS` is the number of slots if the compiler knows it,
/// and 0 for an end of [`bare`](crate::bare).
#[derive(Debug)]
pub struct Producer<'a, T = (), const SLOTS: usize = 0> {
    queue: Queue<'a, SLOTS>,
    /// The number of the next value.
    tail: u32,
    /// Number of the first value that does not fit, according to the copy of the released index.
    limit: u32,
    payload: PhantomData<fn(&T)>,
}

impl<'a, T, const SLOTS: usize> Producer<'a, T, SLOTS> {
    /// Attaches the producer. It continues after the last value that an earlier incarnation sent.
    /// Loads the stamp of each slot at most once.
    pub(crate) fn attach(words: &'a [AtomicU32], shape: Shape) -> Result<Self, FitError> {
        let queue = Queue::attach(words, shape)?;
        // Acquire pairs with the Release in `publish`.
        let released = queue.released().load(Ordering::Acquire);
        let mut tail = released;
        while !queue.is_full(tail, released)
            && queue.stamp(tail).load(Ordering::Relaxed) == complete(tail)
        {
            tail = tail.wrapping_add(1);
        }
        Ok(Self {
            queue,
            tail,
            limit: match queue.is_full(tail, released) {
                true => tail,
                false => queue.limit(released),
            },
            payload: PhantomData,
        })
    }

    /// Returns the number of values, wrapping, that all incarnations of the producer have sent.
    #[must_use]
    pub const fn sent(&self) -> u32 {
        self.tail
    }

    /// Lends the next slot to the caller, which fills it in place. Its words hold an old value.
    /// Only [`Loan::send`] sends the value. Never blocks.
    ///
    /// # Errors
    /// [`Full`]
    #[inline]
    pub fn loan(&mut self) -> Result<Loan<'_, 'a, T, SLOTS>, Full> {
        self.make_room(self.queue.slot_words)?;
        let (words, stamp) = self.queue.slot(self.tail);
        Ok(Loan {
            words: WordsMut::new(words),
            stamp,
            producer: self,
        })
    }

    #[inline]
    fn make_room(&mut self, slot_words: usize) -> Result<(), Full> {
        let (queue, tail) = (self.queue, self.tail);
        if tail == self.limit {
            // Acquire pairs with the Release in `publish`: the consumer has finished with the slot.
            let released = queue.released().load(Ordering::Acquire);
            if queue.is_full(tail, released) {
                let oldest = tail.wrapping_sub(queue.mask()).wrapping_sub(1);
                restore(queue.slot_of(oldest, slot_words).1, oldest);
                return Err(Full);
            }
            self.limit = queue.limit(released);
        }
        Ok(())
    }

    #[inline]
    fn complete(&mut self, stamp: &AtomicU32) {
        // Release pairs with the Acquire in `item` and `receive`: a core that sees the stamp sees
        // the words.
        stamp.store(complete(self.tail), Ordering::Release);
        self.tail = self.tail.wrapping_add(1);
    }
}

impl<T: Payload, const SLOTS: usize> Producer<'_, T, SLOTS> {
    /// Sends `value`. Never blocks.
    ///
    /// # Errors
    /// [`Full`]; the value was not sent.
    #[inline]
    pub fn send(&mut self, value: &T) -> Result<(), Full> {
        self.make_room(T::WORDS)?;
        let (words, stamp) = self.queue.slot_of(self.tail, T::WORDS);
        store(words, value);
        self.complete(stamp);
        Ok(())
    }
}

/// A slot that is lent to the producer.
#[derive(Debug)]
#[must_use = "only `send` sends what was filled in"]
pub struct Loan<'p, 'a, T, const SLOTS: usize = 0> {
    words: WordsMut<'a>,
    stamp: &'a AtomicU32,
    producer: &'p mut Producer<'a, T, SLOTS>,
}

impl<'a, T, const SLOTS: usize> Loan<'_, 'a, T, SLOTS> {
    /// Returns the words to fill.
    #[inline]
    pub const fn words(&mut self) -> &mut WordsMut<'a> {
        &mut self.words
    }

    /// Sends the value.
    #[inline]
    pub fn send(self) {
        self.producer.complete(self.stamp);
    }
}

/// The receiving end. Each queue has one. `SLOTS` is as in [`Producer`].
#[derive(Debug)]
pub struct Consumer<'a, T = (), const SLOTS: usize = 0> {
    queue: Queue<'a, SLOTS>,
    /// The number of the next value.
    head: u32,
    /// Number of polls that found the queue empty.
    empty_polls: u32,
    payload: PhantomData<fn() -> T>,
}

impl<'a, T, const SLOTS: usize> Consumer<'a, T, SLOTS> {
    /// Attaches the consumer. It continues with the oldest value that is not released.
    pub(crate) fn attach(words: &'a [AtomicU32], shape: Shape) -> Result<Self, FitError> {
        let queue = Queue::attach(words, shape)?;
        let head = queue.released().load(Ordering::Relaxed);
        Ok(Self {
            queue,
            head,
            empty_polls: 0,
            payload: PhantomData,
        })
    }

    /// Returns the next value, to be read in place, or `None` if the queue is empty. Later calls
    /// return the same value until [`Incoming::release`]. Never blocks.
    #[inline]
    pub fn item(&mut self) -> Option<Incoming<'_, 'a, T, SLOTS>> {
        let (words, stamp) = self.queue.slot(self.head);
        // Acquire pairs with the Release in `complete`.
        if stamp.load(Ordering::Acquire) != complete(self.head) {
            self.found_nothing();
            return None;
        }
        Some(Incoming {
            words: WordsRef::new(words),
            consumer: self,
        })
    }

    #[inline]
    fn found_nothing(&mut self) {
        if self.queue.released().load(Ordering::Relaxed) != self.head {
            self.queue.publish(self.head);
        }
        self.empty_polls = self.empty_polls.wrapping_add(1);
        if self.empty_polls.is_multiple_of(LOOKS_PER_DOUBT) {
            self.check_slot(self.empty_polls / LOOKS_PER_DOUBT);
        }
    }

    /// Continues with the nearest value if this slot holds one that was not received. Not inlined,
    /// so that the usual poll saves no registers.
    #[cold]
    #[inline(never)]
    fn check_slot(&mut self, slot: u32) {
        if self.queue.ahead(slot, self.head).is_some() {
            self.head = self.queue.nearest(self.head);
        }
    }

    /// Releases value `head` of the queue `queue`: copies that the caller has in registers.
    #[inline]
    fn release(&mut self, queue: Queue<'a, SLOTS>, head: u32) {
        self.head = head.wrapping_add(1);
        if queue.is_group(self.head) {
            queue.publish(self.head);
        }
    }
}

impl<T: Payload, const SLOTS: usize> Consumer<'_, T, SLOTS> {
    /// Receives the next value, or returns `None` if the queue is empty. Never blocks.
    ///
    /// # Errors
    /// [`Corrupt`] if the words are not a value of the type; the slot is released in this case too.
    #[inline]
    pub fn receive(&mut self) -> Result<Option<T>, Corrupt> {
        // Copies: the compiler reads fields again after a fence.
        let (queue, head) = (self.queue, self.head);
        let (words, stamp) = queue.slot_of(head, T::WORDS);
        // Acquire pairs with the Release in `complete`.
        if stamp.load(Ordering::Acquire) != complete(head) {
            self.found_nothing();
            return Ok(None);
        }
        let value = load(words);
        self.release(queue, head);
        value.map(Some)
    }
}

/// A value that was received and not yet released.
#[derive(Debug)]
#[must_use = "only `release` frees the slot"]
pub struct Incoming<'c, 'a, T, const SLOTS: usize = 0> {
    words: WordsRef<'a>,
    consumer: &'c mut Consumer<'a, T, SLOTS>,
}

impl<'a, T, const SLOTS: usize> Incoming<'_, 'a, T, SLOTS> {
    /// Returns the words. The producer does not write to them before the release.
    #[inline]
    #[must_use]
    pub const fn words(&self) -> WordsRef<'a> {
        self.words
    }

    /// Frees the slot for the producer.
    #[inline]
    pub fn release(self) {
        let Consumer { queue, head, .. } = *self.consumer;
        self.consumer.release(queue, head);
    }
}

#[cfg(not(loom))]
#[cfg(test)]
mod tests;
