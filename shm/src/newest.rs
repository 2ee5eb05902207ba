//! The newest-value channel: one writer, any number of readers that read in place, no torn values.
//!
//! The channel is a ring of stamped slots (stamps as in [`broadcast`](crate::broadcast)). The
//! writer fills the slot after the newest one and then publishes it. It never waits, and its cost
//! does not depend on readers; readers write nothing, so a dead reader affects no core. A reader
//! reads the newest slot in place and then checks that it was not overwritten during the read: with
//! n slots, only the n-th newer value overwrites it. If the writer dies while it fills a slot, the
//! newest value does not change; its successor continues with the next number.

use core::marker::PhantomData;

use crate::payload::{Corrupt, Payload, WordsRef, load};
use crate::ring::{CLAIM_AT, Ring};
pub use crate::ring::{Loan, Stamp, Writer};
use crate::shape::{FitError, Shape, whole_lines};
use crate::sync::AtomicU32;

/// Number of attempts of [`Reader::read`] if the writer overtakes it each time.
const ATTEMPTS: u32 = 4;

/// Returns the number of words of a channel of this shape. A small channel, for example 4 slots of
/// 2 words, is one cache line; otherwise each slot has its own lines. Use 4 slots if in doubt.
#[inline]
#[must_use]
pub const fn words(shape: Shape) -> usize {
    Ring::words(shape, stride(shape))
}

const fn stride(shape: Shape) -> usize {
    let slot = 1 + shape.slot_words();
    if shape.slots() * slot < CLAIM_AT {
        slot
    } else {
        whole_lines(slot)
    }
}

/// Why there was no value to read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ReadError {
    /// No value was published. (Also returned, once in 2^32 values, while the number of values is
    /// 0 again and the last value is overwritten.)
    Empty,
    /// The writer overtook the reader at every attempt, or the channel's words hold garbage:
    /// discard everything that was read. The next read may succeed.
    Overrun,
    /// The words are not a value of the payload's type.
    Corrupt,
}

impl core::fmt::Display for ReadError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Empty => "no value was published",
            Self::Overrun => "the writer overtook the reader at every attempt",
            Self::Corrupt => "the words are not a value of this type",
        })
    }
}

impl core::error::Error for ReadError {}

impl From<Corrupt> for ReadError {
    fn from(_: Corrupt) -> Self {
        Self::Corrupt
    }
}

pub(crate) fn ring<const SLOTS: usize>(
    words: &[AtomicU32],
    shape: Shape,
) -> Result<Ring<'_, SLOTS>, FitError> {
    Ring::attach(words, shape, stride(shape))
}

/// A reading end. Any number may exist, on any core, at no cost to the writer. `SLOTS` is that of
/// its [`Newest`](crate::region::Newest), and 0 for an end of [`bare`](crate::bare).
#[derive(Debug)]
pub struct Reader<'a, T = (), const SLOTS: usize = 4> {
    ring: Ring<'a, SLOTS>,
    fetched: Option<Stamp>,
    payload: PhantomData<fn() -> T>,
}

impl<'a, T, const SLOTS: usize> Reader<'a, T, SLOTS> {
    pub(crate) const fn attach(ring: Ring<'a, SLOTS>) -> Self {
        Self {
            ring,
            fetched: None,
            payload: PhantomData,
        }
    }

    /// Returns the stamp of the newest value, or `None` if there is none yet. The stamp changes
    /// with each new value.
    #[inline]
    #[must_use]
    pub fn newest(&self) -> Option<Stamp> {
        let k = self.ring.head().wrapping_sub(1);
        self.ring.is_complete(k).then_some(Stamp(k))
    }

    /// Loads the channel's line into the cache. Call it before each poll of the mailbox through
    /// which the writer's core signals: both lines then move at the same time, not one after the
    /// other. It changes no result. Never blocks.
    #[inline]
    pub fn prefetch(&self) {
        self.ring.prefetch();
    }

    /// Returns the newest value, to be read in place. [`View::finish`] checks the read.
    ///
    /// # Errors
    /// [`ReadError`]
    #[inline]
    pub fn view(&self) -> Result<View<'a>, ReadError> {
        let head = self.ring.head();
        let k = head.wrapping_sub(1);
        if self.ring.is_complete(k) {
            Ok(View {
                ring: self.ring.any(),
                k,
            })
        } else if head == 0 {
            Err(ReadError::Empty)
        } else {
            Err(ReadError::Overrun)
        }
    }

    /// Calls `f` with the words of the newest value, and returns its result only if all words
    /// belonged to one value. `f` runs up to four times; in a discarded run it may see parts of
    /// different values. Bounded.
    ///
    /// # Errors
    /// [`ReadError`]
    pub fn read_by<R>(
        &self,
        mut f: impl FnMut(WordsRef<'a>) -> R,
    ) -> Result<(Stamp, R), ReadError> {
        self.attempt(ATTEMPTS, self.ring.slot_words(), |words| {
            f(WordsRef::new(words))
        })
    }

    fn attempt<R>(
        &self,
        attempts: u32,
        count: usize,
        mut f: impl FnMut(&'a [AtomicU32]) -> R,
    ) -> Result<(Stamp, R), ReadError> {
        for _ in 0..attempts {
            let head = self.ring.head_of(count);
            let k = head.wrapping_sub(1);
            match self.ring.read(k, count, &mut f) {
                Some(value) => return Ok((Stamp(k), value)),
                None if head == 0 => return Err(ReadError::Empty),
                None => {}
            }
        }
        Err(ReadError::Overrun)
    }
}

impl<T: Payload, const SLOTS: usize> Reader<'_, T, SLOTS> {
    #[inline]
    fn load(&self) -> Result<(Stamp, Result<T, Corrupt>), ReadError> {
        if !Ring::<SLOTS>::is_short(T::WORDS) {
            return self.attempt(ATTEMPTS, T::WORDS, load);
        }
        // A value in registers: only the first attempt is inlined.
        let ring = self.ring;
        let head = ring.head_of(T::WORDS);
        let k = head.wrapping_sub(1);
        match ring.read(k, T::WORDS, load) {
            Some(value) => Ok((Stamp(k), value)),
            None if head == 0 => Err(ReadError::Empty),
            None => Self { ring, ..*self }.load_again(),
        }
    }

    #[cold]
    #[inline(never)]
    fn load_again(self) -> Result<(Stamp, Result<T, Corrupt>), ReadError> {
        self.attempt(ATTEMPTS - 1, T::WORDS, load)
    }

    /// Reads the newest value, even if it was read before. Never blocks.
    ///
    /// # Errors
    /// [`ReadError`]
    #[inline]
    pub fn read(&self) -> Result<(Stamp, T), ReadError> {
        let (stamp, value) = self.load()?;
        Ok((stamp, value?))
    }

    /// Reads the newest value; `None` if it was fetched before or there is none. Never blocks.
    ///
    /// # Errors
    /// [`Corrupt`] if the words are not a value of the type.
    #[inline]
    pub fn fetch(&mut self) -> Result<Option<T>, Corrupt> {
        if self.newest() == self.fetched {
            return Ok(None);
        }
        match self.load() {
            Ok((stamp, value)) => {
                self.fetched = Some(stamp);
                value.map(Some)
            }
            Err(_) => Ok(None),
        }
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
    /// Returns the words. If they have parts of a newer value, [`View::finish`] returns an error.
    #[inline]
    #[must_use]
    pub fn words(&self) -> WordsRef<'a> {
        WordsRef::new(self.ring.payload(self.k))
    }

    /// Returns the stamp if everything that was read through this view belonged to one value.
    ///
    /// # Errors
    /// [`ReadError::Overrun`] if the writer has overwritten it: discard everything that was read.
    #[inline]
    pub fn finish(self) -> Result<Stamp, ReadError> {
        if self.ring.is_intact(self.k) {
            Ok(Stamp(self.k))
        } else {
            Err(ReadError::Overrun)
        }
    }
}

#[cfg(not(loom))]
#[cfg(test)]
mod tests {
    use super::*;
    use crate::LINE_WORDS;
    use crate::fault::{freeze_at, kill_at, zeroed};
    use crate::sync::Ordering;

    const SHAPE: Shape = Shape::new(4, 3);

    type Value = [u32; 3];

    fn attach_writer(words: &'static [AtomicU32]) -> Writer<'static, Value> {
        Writer::attach(ring(words, SHAPE).unwrap())
    }

    fn channel() -> (
        &'static [AtomicU32],
        Writer<'static, Value>,
        Reader<'static, Value>,
    ) {
        let words = zeroed(words(SHAPE));
        let reader = Reader::attach(ring(words, SHAPE).unwrap());
        (words, attach_writer(words), reader)
    }

    fn read(reader: &Reader<'_, Value>) -> Option<(u32, Value)> {
        reader.read().ok().map(|(stamp, value)| (stamp.0, value))
    }

    #[test]
    fn readers_get_the_newest_value() {
        let (words, mut writer, reader) = channel();
        for (head, error) in [(7, ReadError::Overrun), (0, ReadError::Empty)] {
            words[0].store(head, Ordering::Relaxed);
            assert_eq!(reader.view().unwrap_err(), error);
            assert_eq!(reader.read(), Err(error));
            assert_eq!(reader.newest(), None);
        }
        for k in 0..20 {
            assert_eq!(writer.publish(&[k, k, 0]), Stamp(k));
            assert_eq!(read(&reader), Some((k, [k, k, 0])));
        }
        let mut loan = writer.loan();
        loan.words().set(2, 99);
        let stamp = words[LINE_WORDS].load(Ordering::Relaxed);
        assert_eq!(stamp, 20 << 1, "value 20 is being written");
        assert_eq!(
            read(&reader),
            Some((19, [19, 19, 0])),
            "a loan shows nothing"
        );
        loan.publish();
        assert_eq!(read(&reader).unwrap().1[2], 99);
        assert_eq!(reader.newest().unwrap().since(Stamp(17)), 3);
    }

    /// A small channel is one cache line; a larger one has one line for the head and separate lines
    /// for each slot.
    #[test]
    fn small_values_share_the_line_of_the_head() {
        assert_eq!(words(Shape::new(4, 2)), 4 * 3 + 1);
        assert_eq!(words(Shape::new(4, 3)), 5 * LINE_WORDS);
        assert_eq!(words(Shape::new(2, 16)), 5 * LINE_WORDS);
        let words = zeroed(LINE_WORDS);
        let shape = Shape::new(4, 2);
        let mut writer = Writer::attach(ring(words, shape).unwrap());
        let reader = Reader::<_, 4>::attach(ring(words, shape).unwrap());
        for k in 0..9 {
            writer.publish(&[k, !k]);
            assert_eq!(reader.read(), Ok((Stamp(k), [k, !k])));
        }
    }

    #[test]
    fn numbers_wrap_around() {
        let (words, _, reader) = channel();
        words[0].store(u32::MAX - 1, Ordering::Relaxed);
        let mut writer = attach_writer(words);
        for k in 0..4u32 {
            let number = k.wrapping_sub(2);
            assert_eq!(writer.publish(&[k; 3]), Stamp(number));
            assert_eq!(read(&reader), Some((number, [k; 3])));
            assert_eq!(Stamp(number).since(Stamp(u32::MAX - 1)), k);
        }
    }

    /// The value that overwrites a viewed slot has another stamp, even in the smallest channel.
    #[test]
    fn the_next_value_in_its_slot_makes_a_view_void() {
        let shape = Shape::new(2, 1);
        let words = zeroed(LINE_WORDS);
        let mut writer = Writer::<'_, [u32; 1]>::attach(ring(words, shape).unwrap());
        let reader = Reader::<'_, [u32; 1], 2>::attach(ring(words, shape).unwrap());
        writer.publish(&[0]);
        for k in 1..9 {
            let view = reader.view().unwrap();
            writer.publish(&[k]);
            writer.publish(&[k]);
            assert_eq!(view.finish(), Err(ReadError::Overrun), "value {k}");
        }
    }

    /// The writer never waits for a view; a view of an overwritten value returns an error.
    #[test]
    fn a_view_that_was_overtaken_is_void() {
        let (_, mut writer, reader) = channel();
        writer.publish(&[1; 3]);
        let view = reader.view().unwrap();
        for k in 2..5 {
            writer.publish(&[k; 3]);
        }
        assert_eq!(view.words().get(0), 1, "three newer values leave it alone");
        let again = reader.view().unwrap();
        for k in 5..9 {
            writer.publish(&[k; 3]);
        }
        assert_eq!(view.finish(), Err(ReadError::Overrun));
        assert_eq!(again.finish(), Err(ReadError::Overrun));
    }

    /// A reader that is frozen at any step, while the writer overwrites all slots, returns one
    /// whole value.
    #[test]
    fn a_reader_frozen_at_every_step_returns_no_torn_value() {
        for at in 0.. {
            let (words, mut writer, reader) = channel();
            writer.publish(&[1; 3]);
            let lap = move || {
                let mut writer = attach_writer(words);
                for k in 2..8 {
                    writer.publish(&[k; 3]);
                }
            };
            let (value, hit) = freeze_at(at, lap, || read(&reader));
            let (_, value) = value.unwrap();
            assert!(
                value == [1; 3] || value == [7; 3],
                "frozen at {at}: {value:?}"
            );
            if !hit {
                break;
            }
        }
    }

    /// A writer killed at any step leaves the old or the new value, and its successor continues.
    #[test]
    fn a_writer_killed_at_every_step_leaves_a_whole_value_and_a_working_channel() {
        for at in 0.. {
            let (words, mut writer, reader) = channel();
            for k in 0..6 {
                writer.publish(&[k; 3]);
            }
            let done = kill_at(at, || writer.publish(&[6; 3])).is_some();
            let (number, value) = read(&reader).unwrap();
            assert!(number == 5 || number == 6);
            assert_eq!(value, [number; 3]);
            let mut successor = attach_writer(words);
            let before = reader.newest().unwrap();
            let stamp = successor.publish(&[77; 3]);
            assert_eq!(
                stamp.since(before),
                1,
                "killed at {at}: no number is given twice"
            );
            assert_eq!(read(&reader), Some((stamp.0, [77; 3])));
            if done {
                break;
            }
        }
    }

    #[test]
    fn scribbled_words_are_void_and_heal() {
        let (words, mut writer, reader) = channel();
        writer.publish(&[1; 3]);
        for scribble in [0, 1, 12345, u32::MAX] {
            words
                .iter()
                .for_each(|word| word.store(scribble, Ordering::Relaxed));
            let _ = read(&reader);
            let stamp = writer.publish(&[2; 3]);
            assert_eq!(read(&reader), Some((stamp.0, [2; 3])));
        }
    }
}
