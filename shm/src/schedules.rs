//! Unit tests only: three cores in random schedules, by shuttle, where loom's search is too large.
//!
//! shuttle switches between cores before each access to shared memory. Each access takes effect at
//! once (sequential consistency): loom checks the memory orderings.
#![allow(clippy::unwrap_used, reason = "test code")]

use crate::fault::{freeze_at, kill_at, switch_cores, zeroed};
use crate::incarnation::{Incarnation, Incarnations};
use crate::lock::{self, Lock};
use crate::mailbox::{self, Receiver, Sender, TaskId};
use crate::pool::{self, BLOCK_WORDS, Pool};
use crate::sync::{AtomicU32, Ordering};
use shuttle::rand::{Rng, thread_rng};
use shuttle::thread;
use std::vec::Vec;

/// Schedules of each model.
const SCHEDULES: usize = 3_000;
/// Incarnations of each core in one schedule.
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

/// T-LOCK-1, T-LOCK-3: cores die at any access and restart while others use the lock. One at a time
/// is inside, and a taker is told of a death exactly when a core died inside.
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

/// T-SHM-1, T-SHM-2: cores borrow runs of several blocks, die at any access or still run after they
/// were declared dead. No block is lent to two living owners, and everything comes back.
#[test]
fn the_pool_in_random_schedules_with_deaths_and_stragglers() {
    const BLOCKS: usize = 6;
    fn borrow(pool: &Pool<'static>, mark: u32) {
        let Ok(handle) = pool.get((1 + below(3) as usize) * BLOCK_WORDS) else {
            return;
        };
        // A straggler may be refused; an owner that is alive may not.
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
    /// As `borrow`, without writing: a straggler's writes would be its own fault.
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
