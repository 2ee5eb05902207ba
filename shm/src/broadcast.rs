//! The broadcast ring: one sender, any number of receivers, each with a private cursor.
//!
//! Value number k lies in slot k mod n, with a stamp `k << 1` while it is written and `k << 1 | 1`
//! when it is complete. The sender waits for nobody and overwrites the oldest slot; receivers write
//! nothing. A receiver checks the stamp before and after it reads in place; when the sender has
//! overtaken it, it is told how many values it lost and goes on half a ring behind the newest, so
//! that it does not lose the very next one. A sender that dies leaves all complete values, and its
//! successor goes on with the next number.

use crate::region::{FitError, Shape};
use crate::ring::Ring;
use crate::sync::AtomicU32;
use crate::view::{WordsMut, WordsRef};

/// Words of a ring of this shape.
#[inline]
#[must_use]
pub const fn words(shape: Shape) -> usize {
    Ring::words(shape, stride(shape))
}

const fn stride(shape: Shape) -> usize {
    1 + shape.slot_words()
}

/// The sending end. There is one at a time.
#[derive(Debug)]
pub struct Sender<'a> {
    ring: Ring<'a>,
    next: u32,
}

impl<'a> Sender<'a> {
    /// Attaches to the ring, after the values of earlier incarnations.
    ///
    /// # Errors
    /// [`FitError`] if the words are too few or not at a line boundary.
    pub fn attach(words: &'a [AtomicU32], shape: Shape) -> Result<Self, FitError> {
        let ring = Ring::attach(words, shape, stride(shape))?;
        Ok(Self {
            ring,
            next: ring.resume(),
        })
    }

    /// Lends the slot of the next value, to be filled in place. Its words hold an old value.
    /// Without [`Loan::send`] nothing is sent. Never blocks.
    #[inline]
    pub fn loan(&mut self) -> Loan<'_, 'a> {
        self.ring.begin(self.next);
        Loan {
            words: WordsMut::new(self.ring.payload(self.next)),
            sender: self,
        }
    }

    /// Sends a copy of `value`; what it lacks of the slot is filled with zeros, what it has too
    /// much is cut off. Returns the value's number. Never blocks.
    #[inline]
    pub fn send(&mut self, value: &[u32]) -> u32 {
        let mut loan = self.loan();
        let copied = loan.words.copy_from(value);
        loan.words.zero_from(copied);
        loan.send()
    }
}

/// A slot that is lent to the sender.
#[derive(Debug)]
#[must_use = "only `send` sends what was filled in"]
pub struct Loan<'s, 'a> {
    words: WordsMut<'a>,
    sender: &'s mut Sender<'a>,
}

impl<'a> Loan<'_, 'a> {
    /// The words to fill.
    #[inline]
    pub const fn words(&mut self) -> &mut WordsMut<'a> {
        &mut self.words
    }

    /// Sends the value and returns its number.
    #[inline]
    pub fn send(self) -> u32 {
        let k = self.sender.next;
        self.sender.ring.complete(k);
        self.sender.next = k.wrapping_add(1);
        k
    }
}

/// The sender was faster: so many values are lost to this receiver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lost {
    /// How many; at least 1. Not exact if the ring's words were scribbled on.
    pub count: u32,
}

/// A receiving end with its own cursor. Any number of them, in any core, at no cost to the sender.
#[derive(Clone, Debug)]
pub struct Receiver<'a> {
    ring: Ring<'a>,
    /// The number of the next value to receive.
    cursor: u32,
    /// The last head that was seen: values below it need no new look.
    head: u32,
}

impl<'a> Receiver<'a> {
    /// Attaches to the ring, to receive what is sent from now on.
    ///
    /// # Errors
    /// [`FitError`] if the words are too few or not at a line boundary.
    pub fn attach(words: &'a [AtomicU32], shape: Shape) -> Result<Self, FitError> {
        let ring = Ring::attach(words, shape, stride(shape))?;
        let head = ring.head();
        Ok(Self {
            ring,
            cursor: head,
            head,
        })
    }

    /// Attaches to the ring, to receive the oldest value that is still there first.
    ///
    /// # Errors
    /// [`FitError`] if the words are too few or not at a line boundary.
    pub fn attach_oldest(words: &'a [AtomicU32], shape: Shape) -> Result<Self, FitError> {
        let mut receiver = Self::attach(words, shape)?;
        // The slot before these may be under way already.
        for back in (1..receiver.ring.slots()).rev() {
            let k = receiver.head.wrapping_sub(back);
            if receiver.ring.is_complete(k) {
                receiver.cursor = k;
                break;
            }
        }
        Ok(receiver)
    }

    /// The next value, to be read in place; `None` if there is none yet. Never blocks. What is read
    /// counts, and the cursor goes on, only with [`Item::finish`].
    ///
    /// # Errors
    /// [`Lost`] if values were overwritten before they were received; the next call goes on behind
    /// them.
    #[inline]
    pub fn receive(&mut self) -> Result<Option<Item<'_, 'a>>, Lost> {
        if self.cursor == self.head {
            self.head = self.ring.head();
            if self.cursor == self.head {
                return Ok(None);
            }
        }
        if self.ring.is_complete(self.cursor) {
            Ok(Some(Item { receiver: self }))
        } else {
            Err(self.skip())
        }
    }

    /// Copies the next value, as many words as both have, and returns its number; `None` if there
    /// is none yet. Never blocks.
    ///
    /// # Errors
    /// [`Lost`] as [`Receiver::receive`]; the content of `into` is void.
    #[inline]
    pub fn receive_into(&mut self, into: &mut [u32]) -> Result<Option<u32>, Lost> {
        let Some(item) = self.receive()? else {
            return Ok(None);
        };
        item.words().copy_to(into);
        item.finish().map(Some)
    }

    /// Puts the cursor where values are to be had again.
    fn skip(&mut self) -> Lost {
        self.head = self.ring.head();
        let behind = self.head.wrapping_sub(self.cursor);
        let keep = self.ring.slots() / 2;
        let (cursor, count) = if behind == 0 || behind > u32::MAX / 2 {
            // The head went back: nobody knows what is lost.
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

/// A value that is being received in place.
#[derive(Debug)]
#[must_use = "what was read counts only after `finish`"]
pub struct Item<'r, 'a> {
    receiver: &'r mut Receiver<'a>,
}

impl<'a> Item<'_, 'a> {
    /// The words; parts of a newer value may appear in them until [`Item::finish`] has said no.
    #[inline]
    #[must_use]
    pub fn words(&self) -> WordsRef<'a> {
        WordsRef::new(self.receiver.ring.payload(self.receiver.cursor))
    }

    /// Ends the reading and returns the number of the value. Without this the same value comes
    /// again.
    ///
    /// # Errors
    /// [`Lost`] if the sender overtook: forget what was read.
    #[inline]
    pub fn finish(self) -> Result<u32, Lost> {
        let k = self.receiver.cursor;
        if self.receiver.ring.is_intact(k) {
            self.receiver.cursor = k.wrapping_add(1);
            Ok(k)
        } else {
            Err(self.receiver.skip())
        }
    }
}

#[cfg(test)]
#[cfg(not(loom))]
mod tests {
    use super::*;
    use crate::step::{freeze_at, kill_at, zeroed};
    use crate::sync::Ordering;

    const SHAPE: Shape = Shape::new(4, 2);

    fn ring() -> (&'static [AtomicU32], Sender<'static>, Receiver<'static>) {
        let words = zeroed(words(SHAPE));
        (
            words,
            Sender::attach(words, SHAPE).unwrap(),
            Receiver::attach(words, SHAPE).unwrap(),
        )
    }

    #[inline]
    fn receive(receiver: &mut Receiver<'_>) -> Result<Option<(u32, [u32; 2])>, Lost> {
        let mut value = [0; 2];
        Ok(receiver
            .receive_into(&mut value)?
            .map(|number| (number, value)))
    }

    #[test]
    fn every_receiver_gets_every_value_in_order() {
        let (words, mut sender, mut one) = ring();
        let mut other = one.clone();
        assert_eq!(receive(&mut one), Ok(None));
        for k in 0..10 {
            assert_eq!(sender.send(&[k]), k);
            assert_eq!(receive(&mut one), Ok(Some((k, [k, 0]))));
            if k % 3 == 2 {
                for k in k - 2..=k {
                    assert_eq!(receive(&mut other), Ok(Some((k, [k, 0]))));
                }
            }
        }
        let mut late = Receiver::attach(words, SHAPE).unwrap();
        assert_eq!(
            receive(&mut late),
            Ok(None),
            "attached for what comes from now on"
        );
        let mut oldest = Receiver::attach_oldest(words, SHAPE).unwrap();
        assert_eq!(receive(&mut oldest), Ok(Some((7, [7, 0]))));
    }

    #[test]
    fn an_item_that_is_not_finished_comes_again() {
        let (_, mut sender, mut receiver) = ring();
        sender.send(&[5, 6]);
        assert_eq!(receiver.receive().unwrap().unwrap().words().get(1), 6);
        assert_eq!(receive(&mut receiver), Ok(Some((0, [5, 6]))));
    }

    /// Received and lost values add up to what was sent.
    #[test]
    fn a_slow_receiver_is_told_how_many_values_it_lost() {
        let (_, mut sender, mut receiver) = ring();
        for k in 0..11 {
            sender.send(&[k]);
        }
        assert_eq!(receive(&mut receiver), Err(Lost { count: 9 }));
        assert_eq!(receive(&mut receiver), Ok(Some((9, [9, 0]))));
        assert_eq!(receive(&mut receiver), Ok(Some((10, [10, 0]))));
        assert_eq!(receive(&mut receiver), Ok(None));
    }

    #[test]
    fn a_receiver_frozen_at_every_step_gets_whole_values_and_counts_the_rest() {
        for at in 0.. {
            let (words, mut sender, mut receiver) = ring();
            sender.send(&[0, 0]);
            let lap = move || {
                let mut sender = Sender::attach(words, SHAPE).unwrap();
                for k in 1..8 {
                    sender.send(&[k, k]);
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
                sender.send(&[k, k]);
                let _ = receive(&mut receiver);
            });
            let done = kill_at(at, || sender.send(&[6, 6])).is_some();
            Sender::attach(words, SHAPE).unwrap().send(&[7, 7]);
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
            sender.send(&[1; 2]);
            words
                .iter()
                .for_each(|word| word.store(scribble, Ordering::Relaxed));
            // Each call takes a value, skips, or says that there is none: it comes to an end.
            sender.send(&[2; 2]);
            let calls = (0..10)
                .take_while(|_| receive(&mut receiver) != Ok(None))
                .count();
            assert!(calls < 10, "after {scribble}");
            let number = sender.send(&[3; 2]);
            assert_eq!(
                receive(&mut receiver),
                Ok(Some((number, [3; 2]))),
                "after {scribble}"
            );
        }
    }
}
