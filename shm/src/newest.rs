//! The newest-value channel: one writer, any number of readers, in place, never torn.
//!
//! A ring of stamped slots (the stamps are those of [`broadcast`](crate::broadcast)). The
//! writer fills the slot after the newest one and then publishes it; it waits for nobody, its cost does
//! not depend on readers, and readers write nothing, so a dead reader leaves no trace. A reader reads
//! the newest slot in place and checks afterwards that it was not overwritten meanwhile: with n slots
//! that takes n - 1 new values during one read. A writer that dies while it fills a slot leaves the
//! newest value as it was; its successor goes on with the next number.

use crate::region::{FitError, Shape, whole_lines};
use crate::ring::Ring;
use crate::sync::AtomicU32;
use crate::view::{WordsMut, WordsRef};

/// How often [`Reader::read`] begins again when the writer overtakes it.
const ATTEMPTS: u32 = 4;

/// Words of a channel of this shape. Each slot has its own cache lines; 4 slots are a good number.
#[must_use]
pub const fn words(shape: Shape) -> usize {
    Ring::words(shape, stride(shape))
}

const fn stride(shape: Shape) -> usize {
    whole_lines(1 + shape.slot_words())
}

/// Which value it was: the writer counts them, wrapping around, over all its lives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamp(pub u32);

impl Stamp {
    /// How many values were published after `earlier` up to this one.
    #[must_use]
    pub const fn since(self, earlier: Self) -> u32 {
        self.0.wrapping_sub(earlier.0)
    }
}

/// The writing end. There is one at a time.
#[derive(Debug)]
pub struct Writer<'a> {
    ring: Ring<'a>,
    next: u32,
}

impl<'a> Writer<'a> {
    /// Attaches to the channel, after the values of earlier lives.
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
    /// [`Loan::send`] nothing is published. Never blocks.
    pub fn loan(&mut self) -> Loan<'_, 'a> {
        self.ring.begin(self.next);
        Loan {
            words: WordsMut::new(self.ring.payload(self.next)),
            writer: self,
        }
    }

    /// Publishes a copy of `value`; what it lacks of the slot is filled with zeros, what it has too much
    /// is cut off. Never blocks.
    pub fn publish(&mut self, value: &[u32]) -> Stamp {
        let mut loan = self.loan();
        let copied = loan.words.copy_from(value);
        loan.words.zero_from(copied);
        loan.send()
    }
}

/// A slot that is lent to the writer.
#[derive(Debug)]
#[must_use = "only `send` publishes what was filled in"]
pub struct Loan<'w, 'a> {
    words: WordsMut<'a>,
    writer: &'w mut Writer<'a>,
}

impl<'a> Loan<'_, 'a> {
    /// The words to fill.
    pub const fn words(&mut self) -> &mut WordsMut<'a> {
        &mut self.words
    }

    /// Publishes the value.
    pub fn send(self) -> Stamp {
        let stamp = Stamp(self.writer.next);
        self.writer.ring.complete(stamp.0);
        self.writer.next = stamp.0.wrapping_add(1);
        stamp
    }
}

/// Why there was nothing to read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReadError {
    /// Nothing was ever published.
    Empty,
    /// The writer overtook the reader every time, or the channel's words were scribbled on: what was
    /// read is void. The next read may succeed.
    Overrun,
}

/// A reading end. Any number of them, in any core, at no cost to the writer.
#[derive(Clone, Copy, Debug)]
pub struct Reader<'a> {
    ring: Ring<'a>,
}

impl<'a> Reader<'a> {
    /// Attaches to the channel.
    ///
    /// # Errors
    /// [`FitError`] if the words are too few or not at a line boundary.
    pub fn attach(words: &'a [AtomicU32], shape: Shape) -> Result<Self, FitError> {
        Ok(Self {
            ring: Ring::attach(words, shape, stride(shape))?,
        })
    }

    /// The stamp of the newest value; `None` if there is none yet. For a look whether something is new.
    #[must_use]
    pub fn newest(&self) -> Option<Stamp> {
        let k = self.ring.head().wrapping_sub(1);
        self.ring.is_complete(k).then_some(Stamp(k))
    }

    /// The newest value, to be read in place; what is read counts only after [`View::finish`].
    ///
    /// # Errors
    /// [`ReadError`]
    pub fn view(&self) -> Result<View<'a>, ReadError> {
        let head = self.ring.head();
        let k = head.wrapping_sub(1);
        if self.ring.is_complete(k) {
            Ok(View { ring: self.ring, k })
        } else if head == 0 {
            Err(ReadError::Empty)
        } else {
            Err(ReadError::Overrun)
        }
    }

    /// Reads the newest value in place by `f`. Its result is returned only if what it saw was one whole
    /// value; `f` may run up to four times and, in a run that does not count, see parts of different
    /// values. Bounded.
    ///
    /// # Errors
    /// [`ReadError`]
    pub fn read<T>(&self, mut f: impl FnMut(WordsRef<'a>) -> T) -> Result<(Stamp, T), ReadError> {
        for _ in 0..ATTEMPTS {
            match self.view() {
                Ok(view) => {
                    let value = f(view.words());
                    if let Ok(stamp) = view.finish() {
                        return Ok((stamp, value));
                    }
                }
                Err(ReadError::Empty) => return Err(ReadError::Empty),
                Err(ReadError::Overrun) => {}
            }
        }
        Err(ReadError::Overrun)
    }

    /// Copies the newest value, as many words as both have, if there is one and it was read whole.
    /// On `None` the content of `into` is void.
    pub fn read_into(&self, into: &mut [u32]) -> Option<Stamp> {
        self.read(|words| words.copy_to(into))
            .ok()
            .map(|(stamp, _)| stamp)
    }
}

/// A value that is being read in place.
#[derive(Debug)]
#[must_use = "what was read counts only after `finish`"]
pub struct View<'a> {
    ring: Ring<'a>,
    k: u32,
}

impl<'a> View<'a> {
    /// The words; parts of a newer value may appear in them until [`View::finish`] has said no.
    #[must_use]
    pub fn words(&self) -> WordsRef<'a> {
        WordsRef::new(self.ring.payload(self.k))
    }

    /// Whether everything that was read through this view belonged to one value.
    ///
    /// # Errors
    /// [`ReadError::Overrun`] if the writer overtook: forget what was read.
    pub fn finish(self) -> Result<Stamp, ReadError> {
        if self.ring.is_intact(self.k) {
            Ok(Stamp(self.k))
        } else {
            Err(ReadError::Overrun)
        }
    }
}
