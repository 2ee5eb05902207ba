//! The broadcast ring: one sender, any number of receivers, each with a private cursor.
//!
//! Value number k lies in slot k mod n, with a stamp `k << 1` while it is written and `k << 1 | 1`
//! when it is complete. The sender never waits and overwrites the oldest slot; receivers write
//! nothing. A receiver checks the stamp before and after it reads in place. If the sender has
//! overtaken it, the receiver returns how many values were lost, and continues half a ring behind
//! the newest, so that the next value is not lost at once. If the sender dies, all complete values
//! remain, and its successor continues with the next number.

use core::marker::PhantomData;

use crate::payload::{Payload, WordsRef, load};
use crate::ring::Ring;
pub use crate::ring::{Loan, Stamp, Writer};
use crate::shape::{FitError, Shape};
use crate::sync::AtomicU32;

/// Returns the number of words of a ring of this shape.
#[inline]
#[must_use]
pub const fn words(shape: Shape) -> usize {
    Ring::words(shape, stride(shape))
}

const fn stride(shape: Shape) -> usize {
    1 + shape.slot_words()
}

pub(crate) fn ring(words: &[AtomicU32], shape: Shape) -> Result<Ring<'_>, FitError> {
    Ring::attach(words, shape, stride(shape))
}

/// This receiver lost values: the writer overwrote them, or a value was not of the payload's type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Lost {
    /// Number of lost values, at least 1. Not exact if garbage overwrote the ring's words.
    pub count: u32,
}

impl core::fmt::Display for Lost {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{} values were lost", self.count)
    }
}

impl core::error::Error for Lost {}

/// A receiving end with its own cursor. Any number may exist on any core, at no cost to the writer.
#[derive(Debug)]
pub struct Receiver<'a, T = ()> {
    ring: Ring<'a>,
    /// The number of the next value to receive.
    cursor: u32,
    /// The head when it was last loaded. Values below it can be received without another load.
    head: u32,
    payload: PhantomData<fn() -> T>,
}

impl<'a, T> Receiver<'a, T> {
    /// Attaches a receiver for values that are sent from now on.
    pub(crate) fn attach(ring: Ring<'a>) -> Self {
        let head = ring.head();
        Self {
            ring,
            cursor: head,
            head,
            payload: PhantomData,
        }
    }

    /// Moves the cursor back to the oldest value that is still in the ring.
    #[must_use]
    pub fn from_oldest(mut self) -> Self {
        // The loop skips the oldest slot, because the writer may already be filling it.
        for back in (1..self.ring.slots()).rev() {
            let k = self.head.wrapping_sub(back);
            if self.ring.is_complete(k) {
                self.cursor = k;
                break;
            }
        }
        self
    }

    /// Returns the next value, to be read in place, or `None` if there is none yet. Never blocks.
    /// Only [`Incoming::finish`] confirms the read and advances the cursor.
    ///
    /// # Errors
    /// [`Lost`] if values were overwritten before they were received; the next call continues
    /// after them.
    #[inline]
    pub fn item(&mut self) -> Result<Option<Incoming<'_, 'a, T>>, Lost> {
        if !self.is_there() {
            return Ok(None);
        }
        if self.ring.is_complete(self.cursor) {
            Ok(Some(Incoming { receiver: self }))
        } else {
            Err(self.skip())
        }
    }

    /// Returns whether the value at the cursor was published.
    #[inline]
    fn is_there(&mut self) -> bool {
        if self.cursor == self.head {
            self.head = self.ring.head();
        }
        self.cursor != self.head
    }

    /// Moves the cursor past lost values to one that is available.
    fn skip(&mut self) -> Lost {
        self.head = self.ring.head();
        let behind = self.head.wrapping_sub(self.cursor);
        let keep = self.ring.slots() / 2;
        let (cursor, count) = if behind == 0 || behind > u32::MAX / 2 {
            // The head is not ahead of the cursor: the number of lost values is unknown.
            (self.head, 1)
        } else if behind <= keep {
            (self.cursor.wrapping_add(1), 1)
        } else {
            (self.head.wrapping_sub(keep), behind - keep)
        };
        self.cursor = cursor;
        Lost { count }
    }
}

impl<T: Payload> Receiver<'_, T> {
    /// Receives the next value with its number; `None` if there is none yet. Never blocks.
    ///
    /// # Errors
    /// [`Lost`] as in [`Receiver::item`], and if the words are not a value of the type.
    #[inline]
    pub fn receive(&mut self) -> Result<Option<(Stamp, T)>, Lost> {
        let k = self.cursor;
        if !self.is_there() {
            return Ok(None);
        }
        match self.ring.read(k, T::WORDS, load) {
            Some(value) => {
                self.cursor = k.wrapping_add(1);
                let value = value.map_err(|_| Lost { count: 1 })?;
                Ok(Some((Stamp(k), value)))
            }
            None => Err(self.skip()),
        }
    }
}

/// A value that is being received in place.
#[derive(Debug)]
#[must_use = "what was read counts only after `finish`"]
pub struct Incoming<'r, 'a, T> {
    receiver: &'r mut Receiver<'a, T>,
}

impl<'a, T> Incoming<'_, 'a, T> {
    /// Returns the words. They may contain parts of a newer value; then [`Incoming::finish`]
    /// returns an error.
    #[inline]
    #[must_use]
    pub fn words(&self) -> WordsRef<'a> {
        WordsRef::new(self.receiver.ring.payload(self.receiver.cursor))
    }

    /// Ends the read and returns the number of the value. Without this call the receiver returns
    /// the same value again.
    ///
    /// # Errors
    /// [`Lost`] if the sender has overwritten the value: discard everything that was read.
    #[inline]
    pub fn finish(self) -> Result<Stamp, Lost> {
        let k = self.receiver.cursor;
        if self.receiver.ring.is_intact(k) {
            self.receiver.cursor = k.wrapping_add(1);
            Ok(Stamp(k))
        } else {
            Err(self.receiver.skip())
        }
    }
}

#[cfg(not(loom))]
#[cfg(test)]
mod tests {
    use super::*;
    use crate::fault::{freeze_at, kill_at, zeroed};
    use crate::sync::Ordering;

    const SHAPE: Shape = Shape::new(4, 2);

    type Value = [u32; 2];

    fn sender(words: &'static [AtomicU32]) -> Writer<'static, Value> {
        Writer::attach(super::ring(words, SHAPE).unwrap())
    }

    fn receiver(words: &'static [AtomicU32]) -> Receiver<'static, Value> {
        Receiver::attach(super::ring(words, SHAPE).unwrap())
    }

    fn ring() -> (
        &'static [AtomicU32],
        Writer<'static, Value>,
        Receiver<'static, Value>,
    ) {
        let words = zeroed(words(SHAPE));
        (words, sender(words), receiver(words))
    }

    fn receive(receiver: &mut Receiver<'_, Value>) -> Result<Option<(u32, Value)>, Lost> {
        let received = receiver.receive()?;
        Ok(received.map(|(stamp, value)| (stamp.0, value)))
    }

    #[test]
    fn every_receiver_gets_every_value_in_order() {
        let (words, mut sender, mut one) = ring();
        let mut other = receiver(words);
        assert_eq!(receive(&mut one), Ok(None));
        for k in 0..10 {
            assert_eq!(sender.publish(&[k, 0]), Stamp(k));
            assert_eq!(receive(&mut one), Ok(Some((k, [k, 0]))));
            if k % 3 == 2 {
                for k in k - 2..=k {
                    assert_eq!(receive(&mut other), Ok(Some((k, [k, 0]))));
                }
            }
        }
        let mut late = receiver(words);
        assert_eq!(
            receive(&mut late),
            Ok(None),
            "attached for values from now on"
        );
        let mut oldest = receiver(words).from_oldest();
        assert_eq!(receive(&mut oldest), Ok(Some((7, [7, 0]))));
    }

    #[test]
    fn an_item_that_is_not_finished_is_received_again() {
        let (_, mut sender, mut receiver) = ring();
        sender.publish(&[5, 6]);
        assert_eq!(receiver.item().unwrap().unwrap().words().get(1), 6);
        assert_eq!(receive(&mut receiver), Ok(Some((0, [5, 6]))));
    }

    /// Received and lost values add up to the number sent.
    #[test]
    fn a_slow_receiver_learns_how_many_values_it_lost() {
        let (_, mut sender, mut receiver) = ring();
        for k in 0..11 {
            sender.publish(&[k, 0]);
        }
        assert_eq!(receive(&mut receiver), Err(Lost { count: 9 }));
        assert_eq!(receive(&mut receiver), Ok(Some((9, [9, 0]))));
        assert_eq!(receive(&mut receiver), Ok(Some((10, [10, 0]))));
        assert_eq!(receive(&mut receiver), Ok(None));
    }

    /// A receiver whose next value is lost continues at a later one and counts the lost values.
    #[test]
    fn a_receiver_continues_behind_what_it_lost() {
        const FAR: u32 = u32::MAX / 2;
        for (cursor, head, expected) in [
            (5, 5, (5, 1)),
            (5, 4, (4, 1)),
            (5, 6, (6, 1)),
            (5, 7, (6, 1)),
            (5, 8, (6, 1)),
            (5, 9, (7, 2)),
            (0, FAR, (FAR - 2, FAR - 2)),
            (0, FAR + 1, (FAR + 1, 1)),
        ] {
            let (words, _, mut receiver) = ring();
            words[0].store(head, Ordering::Relaxed);
            receiver.cursor = cursor;
            let Lost { count } = receiver.skip();
            assert_eq!((receiver.cursor, count), expected, "{cursor} of {head}");
        }
    }

    #[test]
    fn a_receiver_frozen_at_every_step_gets_whole_values_and_counts_the_rest() {
        for at in 0.. {
            let (words, mut sender, mut receiver) = ring();
            sender.publish(&[0, 0]);
            let lap = move || {
                let mut sender = self::sender(words);
                for k in 1..8 {
                    sender.publish(&[k, k]);
                }
            };
            let (first, hit) = freeze_at(at, lap, || receive(&mut receiver));
            let mut seen = 0;
            let mut next = Some(first);
            while let Some(result) = next.take() {
                match result {
                    Ok(None) => break,
                    Ok(Some((number, value))) => {
                        assert_eq!(value, [number; 2], "frozen at {at}");
                        assert_eq!(number, seen);
                        seen += 1;
                    }
                    Err(Lost { count }) => seen += count,
                }
                next = Some(receive(&mut receiver));
            }
            if !hit {
                break;
            }
            assert_eq!(seen, 8, "frozen at {at}");
        }
    }

    #[test]
    fn a_sender_killed_at_every_step_leaves_whole_values_and_no_number_twice() {
        for at in 0.. {
            let (words, mut sender, mut receiver) = ring();
            (0..6).for_each(|k| {
                sender.publish(&[k, k]);
                let _ = receive(&mut receiver);
            });
            let done = kill_at(at, || sender.publish(&[6, 6])).is_some();
            self::sender(words).publish(&[7, 7]);
            match receive(&mut receiver).unwrap().unwrap() {
                (6, [6, 6]) => assert_eq!(receive(&mut receiver), Ok(Some((7, [7, 7])))),
                other => assert_eq!(other, (6, [7, 7]), "killed at {at}"),
            }
            assert_eq!(receive(&mut receiver), Ok(None));
            if done {
                break;
            }
        }
    }

    #[test]
    fn scribbled_words_are_lost_values_and_heal() {
        let (words, mut sender, mut receiver) = ring();
        for scribble in [0, 1, 12345, u32::MAX, 1 << 31] {
            sender.publish(&[1; 2]);
            words
                .iter()
                .for_each(|word| word.store(scribble, Ordering::Relaxed));
            // Each call receives a value, skips, or finds none, so the loop ends.
            sender.publish(&[2; 2]);
            let calls = (0..10)
                .take_while(|_| receive(&mut receiver) != Ok(None))
                .count();
            assert!(calls < 10, "after {scribble}");
            let Stamp(number) = sender.publish(&[3; 2]);
            assert_eq!(
                receive(&mut receiver),
                Ok(Some((number, [3; 2]))),
                "after {scribble}"
            );
        }
    }
}
