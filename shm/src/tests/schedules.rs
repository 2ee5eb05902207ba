//! Unit tests: shuttle runs three cores in random schedules, where loom's search is too large.
//!
//! shuttle switches between cores before each access to shared memory. Each access takes effect at
//! once (sequential consistency), so only loom checks the memory orderings.
#![allow(clippy::unwrap_used, reason = "test code")]

use crate::fault::{freeze_at, kill_at, switch_cores, zeroed};
use crate::incarnation::{Incarnation, Incarnations};
use crate::lock::{self, Lock};
use crate::mailbox::{self, Receiver, Sender, TaskId};
use crate::pool::{self, BLOCK_WORDS, Pool};
use crate::shape::{LINE_WORDS, Shape};
use crate::sync::{AtomicU32, Ordering};
use crate::{bare, broadcast, fifo, newest};
use shuttle::rand::{Rng, thread_rng};
use shuttle::thread;
use std::vec::Vec;

/// Number of schedules of each model.
const SCHEDULES: usize = 3_000;
/// Number of incarnations of each core in one schedule.
const INCARNATIONS: u32 = 4;

fn below(limit: u32) -> u32 {
    thread_rng().gen_range(0..limit)
}

/// Runs `core` in three threads, in random schedules.
fn in_random_schedules(words: usize, core: fn(&'static [AtomicU32], usize)) {
    let model = move || {
        let words = zeroed(words);
        let cores: Vec<_> = (0..3)
            .map(|number| thread::spawn(move || core(words, number)))
            .collect();
        for core in cores {
            core.join().unwrap();
        }
    };
    shuttle::check_random(move || switch_cores(model), SCHEDULES);
}

fn announce(
    words: &'static [AtomicU32],
    core: usize,
    generation: u32,
) -> (Incarnation, Incarnations<'static>) {
    let incarnation = Incarnation::new(core, generation).unwrap();
    let incarnations = Incarnations::attach(words).unwrap();
    incarnations.announce(incarnation).unwrap();
    (incarnation, incarnations)
}

const OBJECT_AT: usize = Incarnations::WORDS;

/// T-LOCK-1, T-LOCK-3: cores die at any access and restart while others use the lock. At most one
/// core is inside, and if a core died inside, the next owner gets `Recovered`.
#[test]
fn the_lock_in_random_schedules_with_deaths() {
    const INSIDE_AT: usize = OBJECT_AT + lock::WORDS;
    fn core(words: &'static [AtomicU32], core: usize) {
        let inside = &words[INSIDE_AT];
        for generation in 1..=INCARNATIONS {
            let (incarnation, incarnations) = announce(words, core, generation);
            let at = below(60) as usize;
            let end = kill_at(at, || {
                let mut lock =
                    Lock::attach(&words[OBJECT_AT..], incarnation, incarnations).unwrap();
                for _ in 0..3 {
                    let Ok(acquired) = lock.lock(40, |_| ()) else {
                        continue;
                    };
                    let found = inside.load(Ordering::Relaxed);
                    assert!(found == 0 || acquired.is_recovered(), "two inside");
                    inside.store(core as u32 + 1, Ordering::Relaxed);
                    assert_eq!(inside.load(Ordering::Relaxed), core as u32 + 1);
                    inside.store(0, Ordering::Relaxed);
                }
            });
            if end.is_none() {
                incarnations.mark_dead(incarnation);
            }
        }
    }
    in_random_schedules(INSIDE_AT + 1, core);
}

/// T-SHM-1, T-SHM-2: cores borrow runs of several blocks, and die at any access or still run after
/// they were declared dead. No two living owners get the same block, and all blocks become free.
#[test]
fn the_pool_in_random_schedules_with_deaths_and_stragglers() {
    const BLOCKS: usize = 6;
    fn borrow(pool: &Pool<'static>, mark: u32) {
        let Ok(handle) = pool.get((1 + below(3) as usize) * BLOCK_WORDS) else {
            return;
        };
        // The pool may refuse a core that runs after it was declared dead.
        let Ok(own) = pool.open(handle) else {
            return;
        };
        for block in own.chunks(BLOCK_WORDS) {
            block[0].store(mark, Ordering::Relaxed);
        }
        for block in own.chunks(BLOCK_WORDS) {
            let seen = block[0].load(Ordering::Relaxed);
            assert!(seen == mark || pool.open(handle).is_err(), "lent twice");
        }
        let _ = pool.give_back(handle);
    }
    /// Like `borrow`, but does not write: nothing protects the next owner from those writes.
    fn straggle(pool: &Pool<'static>) {
        if let Ok(handle) = pool.get((1 + below(3) as usize) * BLOCK_WORDS) {
            let _ = pool.give_back(handle);
        }
    }
    fn core(words: &'static [AtomicU32], core: usize) {
        for generation in 1..=INCARNATIONS {
            let (incarnation, incarnations) = announce(words, core, generation);
            let pool =
                Pool::attach(&words[OBJECT_AT..], BLOCKS, incarnation, incarnations).unwrap();
            let at = below(40) as usize;
            if below(2) == 0 {
                let mark = generation << 2 | core as u32;
                kill_at(at, || (0..2).for_each(|_| borrow(&pool, mark)));
                incarnations.mark_dead(incarnation);
            } else {
                let end = move || assert!(incarnations.mark_dead(incarnation));
                freeze_at(at, end, || (0..2).for_each(|_| straggle(&pool)));
                incarnations.mark_dead(incarnation);
            }
        }
        let (incarnation, incarnations) = announce(words, core, INCARNATIONS + 1);
        let pool = Pool::attach(&words[OBJECT_AT..], BLOCKS, incarnation, incarnations).unwrap();
        words[OBJECT_AT + pool::words(BLOCKS)].fetch_add(1, Ordering::Relaxed);
        while words[OBJECT_AT + pool::words(BLOCKS)].load(Ordering::Relaxed) < 3 {}
        pool.reclaim_dead();
        assert_eq!(pool.free_words(), BLOCKS * BLOCK_WORDS);
    }
    in_random_schedules(OBJECT_AT + pool::words(BLOCKS) + 1, core);
}

/// T-SYNC-3: sender and receiver die at any access and restart. Each sent signal is handled at
/// least once.
#[test]
fn the_mailbox_in_random_schedules_with_deaths() {
    const SENT_AT: usize = mailbox::WORDS;
    const HANDLED_AT: usize = SENT_AT + 1;
    const DONE_AT: usize = SENT_AT + 2;
    fn sender(words: &'static [AtomicU32]) {
        let task = TaskId::new(3).unwrap();
        for _ in 0..INCARNATIONS {
            kill_at(below(30) as usize, || {
                let mut sender = Sender::attach(words).unwrap();
                for _ in 0..3 {
                    let _ = sender.signal(task);
                    words[SENT_AT].fetch_add(1, Ordering::Relaxed);
                }
            });
        }
        drop(Sender::attach(words));
        words[DONE_AT].store(1, Ordering::Relaxed);
    }
    fn core(words: &'static [AtomicU32], core: usize) {
        match core {
            0 => sender(words),
            1 => {
                while words[DONE_AT].load(Ordering::Relaxed) == 0 {
                    kill_at(below(30) as usize, || {
                        let mut receiver = Receiver::attach(words).unwrap();
                        for _ in 0..3 {
                            receiver.poll(|open| {
                                words[HANDLED_AT].fetch_add(open.count, Ordering::Relaxed);
                            });
                        }
                    });
                }
                let mut last = Receiver::attach(words).unwrap();
                last.poll(|open| {
                    words[HANDLED_AT].fetch_add(open.count, Ordering::Relaxed);
                });
                let [sent, handled] = [SENT_AT, HANDLED_AT].map(|at| &words[at]);
                let sent = sent.load(Ordering::Relaxed);
                assert!(handled.load(Ordering::Relaxed) >= sent, "a signal was lost");
            }
            _ => {}
        }
    }
    in_random_schedules(DONE_AT + 1, core);
}

type Value = [u32; 2];

/// Runs the incarnations of a core. Each one except the last is killed at one of its first
/// `accesses` accesses. If `life` returns before that, no further incarnation follows.
fn lives(accesses: u32, mut life: impl FnMut()) {
    for left in (0..INCARNATIONS).rev() {
        let at = if left == 0 { u32::MAX } else { below(accesses) };
        if kill_at(at as usize, &mut life).is_some() {
            return;
        }
    }
}

/// One queue goes from core 0 to core 1, another from core 1 to core 2. Each core dies at any
/// access and restarts. Each value arrives whole, in order, at least once.
#[test]
fn the_queues_in_random_schedules_with_deaths() {
    const SHAPE: Shape = Shape::new(2, 2);
    const SECOND_AT: usize = fifo::words(SHAPE).next_multiple_of(LINE_WORDS);
    const DONE_AT: usize = 2 * SECOND_AT;
    const VALUES: u32 = 6;
    fn send(words: &'static [AtomicU32]) {
        let mut producer = bare::fifo_producer::<Value>(words, SHAPE).unwrap();
        while producer.sent() < VALUES {
            let _full = producer.send(&[producer.sent(); 2]);
        }
    }
    fn pass_on(from: &'static [AtomicU32], to: &'static [AtomicU32]) {
        let mut consumer = bare::fifo_consumer::<Value>(from, SHAPE).unwrap();
        let mut producer = bare::fifo_producer::<Value>(to, SHAPE).unwrap();
        loop {
            let Some(item) = consumer.item() else {
                continue;
            };
            let value: Value = [0, 1].map(|at| item.words().get(at));
            while producer.send(&value).is_err() {}
            item.release();
            if value[0] + 1 == VALUES {
                return;
            }
        }
    }
    fn receive(words: &'static [AtomicU32], done: &AtomicU32, next: &mut u32) {
        let mut consumer = bare::fifo_consumer::<Value>(words, SHAPE).unwrap();
        loop {
            let last = done.load(Ordering::Relaxed) == 1;
            match consumer.receive().unwrap() {
                Some([k, same]) => {
                    // A receiver that died before it released a value receives it again.
                    let in_order = *next == k || *next == k + 1;
                    assert!(k == same && in_order, "{k} {same}, not {next}");
                    *next = (*next).max(k + 1);
                }
                None if last => return,
                None => {}
            }
        }
    }
    fn core(words: &'static [AtomicU32], core: usize) {
        let (first, second) = (words, &words[SECOND_AT..]);
        match core {
            0 => lives(30, || send(first)),
            1 => {
                lives(60, || pass_on(first, second));
                words[DONE_AT].store(1, Ordering::Relaxed);
            }
            _ => {
                let mut next = 0;
                lives(30, || receive(second, &words[DONE_AT], &mut next));
                assert_eq!(next, VALUES, "a value was lost");
            }
        }
    }
    in_random_schedules(DONE_AT + 1, core);
}

/// Core 0 publishes, dies at any access and restarts; core 1 reads the newest value, core 2
/// receives all. Core 1 never reads a torn value, or an older one after a newer one. Core 2
/// receives each value in order, or counts it as lost.
#[test]
fn newest_and_broadcast_in_random_schedules_with_deaths() {
    const SHAPE: Shape = Shape::new(2, 2);
    const BROADCAST_AT: usize = newest::words(SHAPE).next_multiple_of(LINE_WORDS);
    // The word at this index holds the last value after it was published, and 0 before.
    const DONE_AT: usize = (BROADCAST_AT + broadcast::words(SHAPE)).next_multiple_of(LINE_WORDS);
    fn publish(newest: &'static [AtomicU32], broadcast: &'static [AtomicU32], k: &mut u32) {
        let mut newest = bare::newest_writer::<Value>(newest, SHAPE).unwrap();
        let mut broadcast = bare::broadcast_writer::<Value>(broadcast, SHAPE).unwrap();
        for _ in 0..4 {
            *k += 1;
            newest.publish(&[*k; 2]);
            broadcast.publish(&[*k; 2]);
        }
    }
    fn read(words: &'static [AtomicU32], done: &AtomicU32) {
        let reader = bare::newest_reader::<Value>(words, SHAPE).unwrap();
        let mut before = (0, 0);
        loop {
            let last = done.load(Ordering::Relaxed);
            if let Ok((stamp, [k, same])) = reader.read() {
                assert_eq!(k, same, "torn");
                let is_same = (stamp.0, k) == before;
                assert!(is_same || stamp.0 >= before.0 && k > before.1, "goes back");
                before = (stamp.0, k);
            }
            if last != 0 {
                assert_eq!(before.1, last, "the newest was not read");
                return;
            }
        }
    }
    fn receive(words: &'static [AtomicU32], done: &AtomicU32) {
        let mut receiver = bare::broadcast_receiver::<Value>(words, SHAPE).unwrap();
        let (mut number, mut newest) = (None, 0);
        loop {
            let last = done.load(Ordering::Relaxed);
            match receiver.receive() {
                Ok(Some((stamp, [k, same]))) => {
                    assert!(k == same && k > newest, "{k} {same} after {newest}");
                    assert_eq!(stamp.0, number.unwrap_or(stamp.0), "not counted");
                    (number, newest) = (Some(stamp.0 + 1), k);
                }
                Ok(None) if last != 0 => {
                    assert_eq!(newest, last, "the last one was not received");
                    return;
                }
                Ok(None) => {}
                Err(lost) => number = number.map(|number| number + lost.count),
            }
        }
    }
    fn core(words: &'static [AtomicU32], core: usize) {
        let (broadcast, done) = (&words[BROADCAST_AT..], &words[DONE_AT]);
        match core {
            0 => {
                let mut k = 0;
                lives(40, || publish(words, broadcast, &mut k));
                done.store(k, Ordering::Relaxed);
            }
            1 => read(words, done),
            _ => receive(broadcast, done),
        }
    }
    in_random_schedules(DONE_AT + 1, core);
}
