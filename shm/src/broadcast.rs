//! The broadcast ring: one sender, any number of receivers, each with a private cursor.
//!
//! Value number k lies in slot k mod n, with a stamp `k << 1` while it is written and `k << 1 | 1` when
//! it is complete. The sender waits for nobody and overwrites the oldest slot; receivers write
//! nothing. A receiver checks the stamp before and after it reads in place; when the sender has
//! overtaken it, it is told how many values it lost and goes on half a ring behind the newest, so that
//! it does not lose the very next one. A sender that dies leaves all complete values, and its successor
//! goes on with the next number.

use crate::region::{FitError, Shape};
use crate::ring::Ring;
use crate::sync::AtomicU32;
use crate::view::{WordsMut, WordsRef};

/// Words of a ring of this shape.
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
    /// Attaches to the ring, after the values of earlier lives.
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

    /// Lends the slot of the next value, to be filled in place. Its words hold an old value. Without
    /// [`Loan::send`] nothing is sent. Never blocks.
    pub fn loan(&mut self) -> Loan<'_, 'a> {
        self.ring.begin(self.next);
        Loan {
            words: WordsMut::new(self.ring.payload(self.next)),
            sender: self,
        }
    }

    /// Sends a copy of `value`; what it lacks of the slot is filled with zeros, what it has too much is
    /// cut off. Returns the value's number. Never blocks.
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
    pub const fn words(&mut self) -> &mut WordsMut<'a> {
        &mut self.words
    }

    /// Sends the value and returns its number.
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
    /// [`Lost`] if values were overwritten before they were received; the next call goes on behind them.
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

    /// Copies the next value, as many words as both have, and returns its number; `None` if there is
    /// none yet. Never blocks.
    ///
    /// # Errors
    /// [`Lost`] as [`Receiver::receive`]; the content of `into` is void.
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
    #[must_use]
    pub fn words(&self) -> WordsRef<'a> {
        WordsRef::new(self.receiver.ring.payload(self.receiver.cursor))
    }

    /// Ends the reading and returns the number of the value. Without this the same value comes again.
    ///
    /// # Errors
    /// [`Lost`] if the sender overtook: forget what was read.
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
