//! Random interleavings: either end is killed or frozen at any access, or words are overwritten.

use super::*;
use crate::fault::{freeze_at, kill_at, zeroed};
use std::cell::{Cell, RefCell};
use std::rc::Rc;
use std::vec::Vec;

/// A small pseudo-random generator that returns the same numbers in every run.
struct Random(Cell<u64>);

impl Random {
    fn new(seed: u64) -> Self {
        Self(Cell::new(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1))
    }

    /// Returns a number from 0 to `limit` - 1.
    fn below(&self, limit: u32) -> u32 {
        let mut x = self.0.get();
        x ^= x << 13;
        x ^= x >> 7;
        x ^= x << 17;
        self.0.set(x);
        (x >> 20) as u32 % limit
    }

    /// Returns the access at which to kill or freeze. Many operations end before that access.
    fn access(&self) -> usize {
        self.below(14) as usize
    }
}

/// The time at which an end acts.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Time {
    /// In its own turn.
    Own,
    /// While the other end is frozen or dead.
    Others,
}

/// Returns a value whose words show whether it is torn.
const fn whole(first: u32) -> [u32; 2] {
    [first, !first]
}

/// A queue with both ends, and the values that it must deliver. Numbers are relative to `base`.
struct Play {
    words: &'static [AtomicU32],
    shape: Shape,
    base: u32,
    /// `None` during an operation of the producer.
    producer: Cell<Option<Producer<'static, [u32; 2]>>>,
    /// `None` during an operation of the consumer.
    consumer: Cell<Option<Consumer<'static, [u32; 2]>>>,
    /// The first word of each value that was sent or is being sent.
    values: RefCell<Vec<u32>>,
    /// The number of the next value to receive.
    next: Cell<u32>,
    /// Number of values that were received at least once.
    received: Cell<u32>,
    /// Number of values that a successor received again.
    repeated: Cell<u32>,
    killed: Cell<u32>,
    last_first: Cell<u32>,
    random: Random,
}

impl Play {
    /// Returns an empty queue that has already delivered `base` values, wrapping.
    fn new(slots: usize, base: u32, seed: u64) -> Rc<Self> {
        let shape = Shape::new(slots, 2);
        let words = zeroed(words(shape));
        words[RELEASED_AT].store(base, Ordering::Relaxed);
        if base != 0 {
            let queue = Queue::<0>::attach(words, shape).unwrap();
            for k in (1..=slots as u32).map(|back| base.wrapping_sub(back)) {
                queue.stamp(k).store(complete(k), Ordering::Relaxed);
            }
        }
        Rc::new(Self {
            words,
            shape,
            base,
            producer: Cell::new(Some(Producer::attach(words, shape).unwrap())),
            consumer: Cell::new(Some(Consumer::attach(words, shape).unwrap())),
            values: RefCell::default(),
            next: Cell::default(),
            received: Cell::default(),
            repeated: Cell::default(),
            killed: Cell::default(),
            last_first: Cell::default(),
            random: Random::new(seed),
        })
    }

    const fn number(&self, k: u32) -> u32 {
        k.wrapping_sub(self.base)
    }

    /// Returns the action to run during a freeze: it calls `act` fewer than `limit` times.
    fn others(self: &Rc<Self>, limit: u32, act: fn(&Rc<Self>, Time)) -> impl FnOnce() + 'static {
        let play = Rc::clone(self);
        move || (0..play.random.below(limit)).for_each(|_| act(&play, Time::Others))
    }

    /// The producer sends, drops a loan, or is killed or frozen while it sends.
    fn produce(self: &Rc<Self>, time: Time) {
        let Some(mut producer) = self.producer.take() else {
            return;
        };
        let number = self.number(producer.sent());
        let first = self.last_first.get() + 1;
        self.last_first.set(first);
        self.values.borrow_mut().push(first);
        let value = whole(first);
        let at = self.random.access();
        let end = match self.random.below(10) {
            0 | 1 => {
                let end = kill_at(at, || producer.send(&value)).map(|sent| sent.is_ok());
                producer = self.next_producer(time);
                end
            }
            2..=5 if time == Time::Own => {
                let meanwhile = self.others(12, Self::consume);
                let (sent, _) = freeze_at(at, meanwhile, || producer.send(&value));
                Some(sent.is_ok())
            }
            6 => {
                if let Ok(mut loan) = producer.loan() {
                    loan.words().set(0, 7);
                }
                Some(false)
            }
            _ => Some(producer.send(&value).is_ok()),
        };
        let sent = self.number(producer.sent());
        let in_doubt = end.is_none() && sent == number + 1;
        let expected = number + u32::from(end == Some(true) || in_doubt);
        assert_eq!(sent, expected, "values sent, {end:?}");
        assert!(
            self.received.get() <= sent,
            "a value was received and never sent"
        );
        self.values.borrow_mut().truncate(sent as usize);
        self.killed
            .update(|killed| killed + u32::from(end.is_none()));
        self.producer.set(Some(producer));
    }

    /// Attaches the successor of a killed producer. It may be frozen while it attaches.
    fn next_producer(self: &Rc<Self>, time: Time) -> Producer<'static, [u32; 2]> {
        let attach = || Producer::attach(self.words, self.shape).unwrap();
        if time == Time::Others {
            return attach();
        }
        self.others(4, Self::consume)();
        let at = self.random.below(20) as usize;
        freeze_at(at, self.others(7, Self::consume), attach).0
    }

    /// The consumer receives, reads without release, or is killed or frozen while it receives.
    fn consume(self: &Rc<Self>, time: Time) {
        let Some(mut consumer) = self.consumer.take() else {
            return;
        };
        let at = self.random.access();
        match self.random.below(10) {
            0 | 1 => {
                let end = kill_at(at, || consumer.receive().unwrap());
                self.check(end.flatten());
                self.killed
                    .update(|killed| killed + u32::from(end.is_none()));
                consumer = self.next_consumer(time);
            }
            2..=5 if time == Time::Own => {
                let meanwhile = self.others(12, Self::produce);
                let (value, _) = freeze_at(at, meanwhile, || consumer.receive().unwrap());
                self.check(value);
            }
            6 => drop(consumer.item()),
            _ => self.check(consumer.receive().unwrap()),
        }
        let next = self.number(consumer.head);
        assert_eq!(next, self.next.get(), "the consumer leaves out no value");
        self.consumer.set(Some(consumer));
    }

    /// Attaches the successor of a killed consumer, which resumes after the last value that was
    /// published as released.
    fn next_consumer(self: &Rc<Self>, time: Time) -> Consumer<'static, [u32; 2]> {
        if time == Time::Own {
            self.others(4, Self::produce)();
        }
        let consumer = Consumer::attach(self.words, self.shape).unwrap();
        let at_most = if self.shape.slots() < 64 { 0 } else { 7 };
        let back = self.next.get().wrapping_sub(self.number(consumer.head));
        assert!(back <= at_most, "goes back by {}", back.cast_signed());
        self.next.update(|next| next - back);
        self.repeated.update(|repeated| repeated + back);
        consumer
    }

    /// Checks that a received value is the next one, and whole.
    fn check(&self, value: Option<[u32; 2]>) {
        let Some(value) = value else {
            return;
        };
        let next = self.next.get();
        let first = self.values.borrow().get(next as usize).copied();
        assert_eq!(Some(value), first.map(whole), "value number {next}");
        self.next.set(next + 1);
        self.received.set(self.received.get().max(next + 1));
    }

    /// Receives the rest, and checks that all sent values were received and every slot is free.
    fn finish(&self) {
        let mut consumer = self.consumer.take().unwrap();
        let mut producer = self.producer.take().unwrap();
        while let Some(value) = consumer.receive().unwrap() {
            self.check(Some(value));
        }
        assert_eq!(self.next.get() as usize, self.values.borrow().len());
        for k in 0..self.shape.slots() as u32 {
            producer.send(&whole(k)).unwrap();
        }
        assert_eq!(producer.send(&whole(0)), Err(Full));
    }
}

/// Either end is killed or frozen at any access while the other end continues, even if the numbers
/// wrap around. Every sent value is received whole and in order. Only values that a killed consumer
/// had not published as released are received again.
#[test]
#[cfg_attr(miri, ignore = "one thread, no unsafe code: Miri would only take long")]
fn values_come_in_order_whatever_end_is_killed_or_frozen() {
    const SEEDS: u64 = 12;
    const TURNS: u32 = 1500;
    let (mut received, mut repeated, mut killed) = (0, 0, 0);
    for seed in 1..=SEEDS {
        for slots in [2, 4, 8, 64, 128] {
            for base in [0, u32::MAX - 40, u32::MAX - 1, (1 << 31) - 20] {
                let play = Play::new(slots, base, seed);
                let mut producer_turns = 0;
                for turn in 0..TURNS {
                    if turn % 50 == 0 {
                        producer_turns = play.random.below(11);
                    }
                    if play.random.below(10) < producer_turns {
                        play.produce(Time::Own);
                    } else {
                        play.consume(Time::Own);
                    }
                }
                play.finish();
                received += play.received.get();
                repeated += play.repeated.get();
                killed += play.killed.get();
            }
        }
    }
    assert!(received > 0 && repeated > 0 && killed > 0);
}

/// Receives at most `most` values.
fn receive(consumer: &mut Consumer<'_, u32>, most: u32) -> Vec<u32> {
    let next = |_| consumer.receive().unwrap();
    (0..most).map_while(next).collect()
}

/// Overwrites a word of a queue of `n` slots of one word. Often writes an index or a stamp that
/// differs from `tail` by up to 3 `n`, or by 2^31 more.
fn scribble(words: &[AtomicU32], n: u32, tail: u32, random: &Random) {
    let near = tail.wrapping_add(random.below(6 * n)).wrapping_sub(3 * n);
    let scribble = match random.below(4) {
        0 => near,
        1 => complete(near),
        2 => complete(near.wrapping_add(1 << 31)),
        _ => random.below(u32::MAX),
    };
    let at = match random.below(3) {
        0 => RELEASED_AT,
        _ => SLOTS_AT + random.below(2 * n) as usize,
    };
    words[at].store(scribble, Ordering::Relaxed);
}

/// Up to six words are overwritten with garbage, and either end may attach again. The consumer
/// never gets more values at once than there are slots. In the end the queue accepts one value for
/// each slot and delivers them in order.
#[test]
#[cfg_attr(miri, ignore = "one thread, no unsafe code: Miri would only take long")]
fn random_scribbles_heal() {
    const ROUNDS: u32 = 500;
    let random = Random::new(1);
    for round in 0..ROUNDS {
        let n = [2, 4, 64][random.below(3) as usize];
        let shape = Shape::new(n as usize, 1);
        let words = zeroed(words(shape));
        let mut producer = Producer::<_, 0>::attach(words, shape).unwrap();
        let mut consumer = Consumer::attach(words, shape).unwrap();
        for k in 0..random.below(3 * n) {
            let _ = producer.send(&[k]);
            if random.below(2) == 0 {
                receive(&mut consumer, 1);
            }
        }
        for _ in 0..=random.below(6) {
            scribble(words, n, producer.sent(), &random);
        }
        if random.below(2) == 0 {
            producer = Producer::attach(words, shape).unwrap();
        }
        if random.below(2) == 0 {
            consumer = Consumer::attach(words, shape).unwrap();
        }
        // The producer sends each time or every third time; the consumer takes all values or one.
        let (every, most) = [(1, n + 1), (3, n + 1), (1, 1)][random.below(3) as usize];
        for k in 0..8 * LOOKS_PER_DOUBT * n {
            if k % every == 0 {
                let _ = producer.send(&[k]);
            }
            let came = receive(&mut consumer, most).len();
            assert!(came <= n as usize, "round {round}: {came} values");
        }
        receive(&mut consumer, n + 1);
        let sent: Vec<_> = (0..=n)
            .take_while(|k| producer.send(&[*k]).is_ok())
            .collect();
        let expected: Vec<_> = (0..n).collect();
        assert_eq!(sent, expected, "round {round}");
        assert_eq!(receive(&mut consumer, n + 1), expected, "round {round}");
    }
}
