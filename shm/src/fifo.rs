//! The FIFO channel: one producer, one consumer, every value in order, or full.
//!
//! L. Lamport's queue ("Specifying concurrent program modules", 1983) with free-running indices,
//! each written by one end only and standing on a cache line of its own. Each end keeps a copy of
//! the other's index and looks again only when that copy says full or empty, as in J. Giacomoni et
//! al., "FastForward for efficient pipeline parallelism" (PPoPP 2008), and the crate `rtrb`.
//!
//! Each end trusts only its private copy of its own index; the shared word is for the other end and
//! for the successor. The other's index is an allegation: a distance greater than the number of
//! slots is no state of this queue; the producer then says full and the consumer drops everything,
//! which makes the queue whole again.
//!
//! A producer that dies loses what it had not sent. A consumer that dies before [`Item::release`]
//! leaves the value to its successor: each value is received at least once.

use crate::region::{FitError, LINE_WORDS, Shape, fit};
use crate::sync::{AtomicU32, Ordering};
use crate::view::{WordsMut, WordsRef};

/// Line 0, written by the producer: how many values were sent.
const TAIL_AT: usize = 0;
/// Line 1, written by the consumer: how many values were released.
const HEAD_AT: usize = LINE_WORDS;
const SLOTS_AT: usize = 2 * LINE_WORDS;

/// Words of a queue of this shape.
#[inline]
#[must_use]
pub const fn words(shape: Shape) -> usize {
    SLOTS_AT + shape.slots() * shape.slot_words()
}

#[derive(Clone, Copy, Debug)]
struct Queue<'a> {
    tail: &'a AtomicU32,
    head: &'a AtomicU32,
    slots: &'a [AtomicU32],
    shape: Shape,
}

impl<'a> Queue<'a> {
    fn attach(words: &'a [AtomicU32], shape: Shape) -> Result<Self, FitError> {
        let words = fit(words, self::words(shape))?;
        let (tail, head) = (&words[TAIL_AT], &words[HEAD_AT]);
        Ok(Self {
            tail,
            head,
            slots: &words[SLOTS_AT..],
            shape,
        })
    }

    fn capacity(&self) -> u32 {
        self.shape.slots() as u32
    }

    #[inline]
    fn slot(&self, index: u32) -> &'a [AtomicU32] {
        let first = (index as usize & (self.shape.slots() - 1)) * self.shape.slot_words();
        &self.slots[first..first + self.shape.slot_words()]
    }
}

/// Every slot holds a value that is not yet released.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Full;

/// The sending end. There is one at a time.
#[derive(Debug)]
pub struct Producer<'a> {
    queue: Queue<'a>,
    tail: u32,
    /// The consumer's index when it was last looked at.
    head: u32,
}

impl<'a> Producer<'a> {
    /// Attaches to the queue, behind what earlier lives have sent.
    ///
    /// # Errors
    /// [`FitError`] if the words are too few or not at a line boundary.
    pub fn attach(words: &'a [AtomicU32], shape: Shape) -> Result<Self, FitError> {
        let queue = Queue::attach(words, shape)?;
        let tail = queue.tail.load(Ordering::Relaxed);
        // Acquire pairs with the Release in `release`.
        let head = queue.head.load(Ordering::Acquire);
        Ok(Self { queue, tail, head })
    }

    /// How many more values fit, at least. Looks at the consumer only if its last look says none.
    #[inline]
    pub fn free(&mut self) -> usize {
        if self.tail.wrapping_sub(self.head) >= self.queue.capacity() {
            // Acquire pairs with the Release in `release`: the consumer has done with the slot.
            self.head = self.queue.head.load(Ordering::Acquire);
        }
        self.queue
            .capacity()
            .saturating_sub(self.tail.wrapping_sub(self.head)) as usize
    }

    /// Lends the next slot, to be filled in place. Its words hold an old value. Without
    /// [`Loan::send`] nothing is sent. Never blocks.
    ///
    /// # Errors
    /// [`Full`]
    #[inline]
    pub fn loan(&mut self) -> Result<Loan<'_, 'a>, Full> {
        if self.free() == 0 {
            return Err(Full);
        }
        Ok(Loan {
            words: WordsMut::new(self.queue.slot(self.tail)),
            producer: self,
        })
    }

    /// Sends a copy of `value`; what it lacks of the slot is filled with zeros, what it has too
    /// much is cut off. Never blocks.
    ///
    /// # Errors
    /// [`Full`]; the value was not sent.
    #[inline]
    pub fn send(&mut self, value: &[u32]) -> Result<(), Full> {
        let mut loan = self.loan()?;
        let copied = loan.words.copy_from(value);
        loan.words.zero_from(copied);
        loan.send();
        Ok(())
    }
}

/// A slot that is lent to the producer.
#[derive(Debug)]
#[must_use = "only `send` sends what was filled in"]
pub struct Loan<'p, 'a> {
    words: WordsMut<'a>,
    producer: &'p mut Producer<'a>,
}

impl<'a> Loan<'_, 'a> {
    /// The words to fill.
    #[inline]
    pub const fn words(&mut self) -> &mut WordsMut<'a> {
        &mut self.words
    }

    /// Sends the value.
    #[inline]
    pub fn send(self) {
        let producer = self.producer;
        producer.tail = producer.tail.wrapping_add(1);
        // Release pairs with the Acquire in `available`: who sees the index sees the words.
        producer.queue.tail.store(producer.tail, Ordering::Release);
    }
}

/// The receiving end. There is one at a time.
#[derive(Debug)]
pub struct Consumer<'a> {
    queue: Queue<'a>,
    head: u32,
    /// The producer's index when it was last looked at.
    tail: u32,
}

impl<'a> Consumer<'a> {
    /// Attaches to the queue, at the oldest value that earlier lives have not released.
    ///
    /// # Errors
    /// [`FitError`] if the words are too few or not at a line boundary.
    pub fn attach(words: &'a [AtomicU32], shape: Shape) -> Result<Self, FitError> {
        let queue = Queue::attach(words, shape)?;
        let head = queue.head.load(Ordering::Relaxed);
        Ok(Self {
            queue,
            head,
            tail: head,
        })
    }

    /// How many values are there to receive, at least. Looks at the producer only if its last look
    /// says none.
    #[inline]
    pub fn available(&mut self) -> usize {
        if self.tail == self.head {
            // Acquire pairs with the Release in `Loan::send`.
            self.tail = self.queue.tail.load(Ordering::Acquire);
            if self.tail.wrapping_sub(self.head) > self.queue.capacity() {
                // No producer did this: drop everything, and the queue is in order again.
                self.head = self.tail;
                self.publish();
            }
        }
        self.tail.wrapping_sub(self.head) as usize
    }

    /// The next value, to be worked on in place; `None` if there is none. Never blocks. It stays
    /// the next one until [`Item::release`].
    #[inline]
    pub fn receive(&mut self) -> Option<Item<'_, 'a>> {
        if self.available() == 0 {
            return None;
        }
        Some(Item { consumer: self })
    }

    /// Copies the next value, as many words as both have, and releases it. Whether there was one.
    #[inline]
    pub fn receive_into(&mut self, into: &mut [u32]) -> bool {
        let Some(item) = self.receive() else {
            return false;
        };
        item.words().copy_to(into);
        item.release();
        true
    }

    #[inline]
    fn publish(&self) {
        // Release pairs with the Acquire in `Producer::free`: the slot is read before it is
        // refilled.
        self.queue.head.store(self.head, Ordering::Release);
    }
}

/// A value that was received and not yet released.
#[derive(Debug)]
#[must_use = "only `release` frees the slot"]
pub struct Item<'c, 'a> {
    consumer: &'c mut Consumer<'a>,
}

impl<'a> Item<'_, 'a> {
    /// The words; the producer does not touch them until the release.
    #[inline]
    #[must_use]
    pub fn words(&self) -> WordsRef<'a> {
        WordsRef::new(self.consumer.queue.slot(self.consumer.head))
    }

    /// Frees the slot for the producer.
    #[inline]
    pub fn release(self) {
        self.consumer.head = self.consumer.head.wrapping_add(1);
        self.consumer.publish();
    }
}

#[cfg(test)]
#[cfg(not(loom))]
mod tests {
    use super::*;
    use crate::step::{kill_at, zeroed};
    use std::vec::Vec;

    const SHAPE: Shape = Shape::new(4, 2);

    fn queue() -> (&'static [AtomicU32], Producer<'static>, Consumer<'static>) {
        let words = zeroed(words(SHAPE));
        (
            words,
            Producer::attach(words, SHAPE).unwrap(),
            Consumer::attach(words, SHAPE).unwrap(),
        )
    }

    fn drain(consumer: &mut Consumer<'_>) -> Vec<[u32; 2]> {
        let mut value = [0; 2];
        core::iter::from_fn(|| consumer.receive_into(&mut value).then_some(value)).collect()
    }

    #[test]
    fn values_come_in_order_and_a_full_queue_says_so() {
        let (_, mut producer, mut consumer) = queue();
        assert!(consumer.receive().is_none());
        for round in 0..5 {
            for k in 0..4 {
                producer.send(&[round, k]).unwrap();
            }
            assert_eq!(producer.send(&[9, 9]), Err(Full));
            assert_eq!(consumer.available(), 4);
            let expected: Vec<_> = (0..4).map(|k| [round, k]).collect();
            assert_eq!(drain(&mut consumer), expected);
        }
    }

    #[test]
    fn a_slot_is_lent_until_it_is_sent_and_received_until_it_is_released() {
        let (_, mut producer, mut consumer) = queue();
        let mut loan = producer.loan().unwrap();
        loan.words().copy_from(&[1, 2]);
        drop(loan);
        assert!(consumer.receive().is_none());
        producer.send(&[3]).unwrap();
        assert_eq!(consumer.receive().unwrap().words().get(0), 3);
        let item = consumer.receive().unwrap();
        assert_eq!(item.words().iter().collect::<Vec<_>>(), [3, 0]);
        item.release();
        assert!(consumer.receive().is_none());
    }

    #[test]
    fn indices_wrap_around() {
        let (words, ..) = queue();
        words[TAIL_AT].store(u32::MAX - 1, Ordering::Relaxed);
        words[HEAD_AT].store(u32::MAX - 1, Ordering::Relaxed);
        let mut producer = Producer::attach(words, SHAPE).unwrap();
        let mut consumer = Consumer::attach(words, SHAPE).unwrap();
        (0..4).for_each(|k| producer.send(&[k, k]).unwrap());
        assert_eq!(producer.send(&[4]), Err(Full));
        assert_eq!(drain(&mut consumer), [[0, 0], [1, 1], [2, 2], [3, 3]]);
    }

    #[test]
    fn a_producer_killed_at_every_step_has_sent_whole_values_or_nothing() {
        for at in 0.. {
            let (words, mut producer, mut consumer) = queue();
            producer.send(&[0, 0]).unwrap();
            let done = kill_at(at, || producer.send(&[1, 1])).is_some();
            Producer::attach(words, SHAPE)
                .unwrap()
                .send(&[2, 2])
                .unwrap();
            let seen = drain(&mut consumer);
            assert!(
                seen == [[0, 0], [2, 2]] && !done || seen == [[0, 0], [1, 1], [2, 2]],
                "killed at {at}: {seen:?}"
            );
            if done {
                break;
            }
        }
    }

    #[test]
    fn a_consumer_killed_at_every_step_leaves_the_values_that_it_has_not_released() {
        for at in 0.. {
            let (words, mut producer, mut consumer) = queue();
            (0..3).for_each(|k| producer.send(&[k, k]).unwrap());
            let mut seen = Vec::new();
            let done = kill_at(at, || {
                while let Some(item) = consumer.receive() {
                    seen.push(item.words().get(0));
                    item.release();
                }
            });
            let rest = drain(&mut Consumer::attach(words, SHAPE).unwrap());
            seen.extend(rest.iter().map(|value| value[0]));
            seen.dedup();
            assert_eq!(seen, [0, 1, 2], "killed at {at}");
            if done.is_some() {
                break;
            }
        }
    }

    #[test]
    fn scribbled_indices_are_no_values_and_the_queue_heals() {
        for scribble in [1, 4, 5, 12345, u32::MAX, 1 << 31] {
            for at in [TAIL_AT, HEAD_AT] {
                let (words, mut producer, mut consumer) = queue();
                producer.send(&[1, 1]).unwrap();
                words[at].store(scribble, Ordering::Relaxed);
                for k in 0..20 {
                    let _ = producer.send(&[k, k]);
                    assert!(
                        drain(&mut consumer).len() <= 4,
                        "never more than there are slots"
                    );
                }
                assert!(drain(&mut consumer).is_empty());
                producer.send(&[7, 7]).unwrap();
                assert_eq!(drain(&mut consumer), [[7, 7]], "{scribble} at {at}");
            }
        }
    }

    #[test]
    fn a_successor_that_attaches_to_scribbled_indices_makes_the_queue_whole() {
        let (words, ..) = queue();
        words[TAIL_AT].store(77, Ordering::Relaxed);
        words[HEAD_AT].store(7777, Ordering::Relaxed);
        let mut producer = Producer::attach(words, SHAPE).unwrap();
        assert_eq!(producer.send(&[1, 1]), Err(Full));
        let mut consumer = Consumer::attach(words, SHAPE).unwrap();
        assert!(drain(&mut consumer).is_empty());
        producer.send(&[2, 2]).unwrap();
        assert_eq!(drain(&mut consumer), [[2, 2]]);
    }
}
