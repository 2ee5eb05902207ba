//! loom models of the lock and of the pool.
#![cfg(loom)]
#![allow(clippy::unwrap_used, reason = "test code")]

mod common;

use common::{model, zeroed};
use loom::cell::UnsafeCell;
use loom::sync::Arc;
use loom::thread;
use tandem_shm::bare;
use tandem_shm::incarnation::{Incarnation, Incarnations};
use tandem_shm::lock::{self, Acquired, MAX_WAITED_TURNS};
use tandem_shm::pool::{self, BLOCK_WORDS, Pool};
use tandem_shm::sync::{AtomicU32, Ordering, spin};

/// Number of polls before a core gives up: enough to wait for two turns.
const LOOKS: u32 = 8;

const LIVES_AT: usize = lock::WORDS;

fn incarnation(core: usize) -> Incarnation {
    Incarnation::new(core, 1).unwrap()
}

fn incarnations(words: &[AtomicU32]) -> Incarnations<'_> {
    Incarnations::attach(&words[LIVES_AT..]).unwrap()
}

/// Returns the words of a lock and its incarnation table, with the first `cores` cores alive.
fn lock_words(cores: usize) -> Arc<Vec<AtomicU32>> {
    let words = zeroed(LIVES_AT + Incarnations::WORDS);
    for core in 0..cores {
        incarnations(&words).announce(incarnation(core)).unwrap();
    }
    words
}

/// Core `n` takes the lock `times[n]` times, or gives up. loom checks that at most one core is
/// inside, and that it sees what the last owner did.
fn contend<const CORES: usize>(times: [u32; CORES], preemptions: usize) {
    model(preemptions, move || {
        let words = lock_words(CORES);
        let guarded = Arc::new(UnsafeCell::new(0u32));
        let run = move |words: Arc<Vec<AtomicU32>>, guarded: Arc<UnsafeCell<u32>>, core: usize| {
            let mut lock = bare::lock(&words, incarnation(core), incarnations(&words)).unwrap();
            // The bound holds only if cores poll in time, so the patience exceeds a model's polls.
            lock.set_patience(u32::MAX);
            for _ in 0..times[core] {
                if let Ok(acquired) = lock.lock(LOOKS, spin) {
                    let Acquired::Clean(guard) = acquired else {
                        panic!("no core died")
                    };
                    assert!(guard.waited_turns() <= MAX_WAITED_TURNS);
                    guarded.with_mut(|_| ());
                }
            }
        };
        let others: Vec<_> = (1..CORES)
            .map(|other| {
                let (words, guarded) = (words.clone(), guarded.clone());
                thread::spawn(move || run(words, guarded, other))
            })
            .collect();
        run(words, guarded, 0);
        for other in others {
            other.join().unwrap();
        }
    });
}

/// T-LOCK-1, T-LOCK-3: mutual exclusion, acquire and release.
#[test]
fn two_cores_exclude_each_other() {
    contend([2, 2], 5);
}

/// T-LOCK-1: as above, with detached guards.
#[test]
fn detached_guards_exclude_each_other() {
    model(3, || {
        let words = lock_words(2);
        let guarded = Arc::new(UnsafeCell::new(()));
        let run = |words: &[AtomicU32], guarded: &UnsafeCell<()>, core| {
            let mut lock = bare::lock(words, incarnation(core), incarnations(words)).unwrap();
            if let Ok(acquired) = lock.lock(2, spin) {
                let held = acquired.into_guard().detach();
                guarded.with_mut(|_| ());
                drop(held);
            }
        };
        let other = {
            let (words, guarded) = (words.clone(), guarded.clone());
            thread::spawn(move || run(&words, &guarded, 1))
        };
        run(&words, &guarded, 0);
        other.join().unwrap();
    });
}

/// T-LOCK-1, T-LOCK-3: three cores.
#[test]
fn three_cores_exclude_each_other() {
    contend([1, 1, 1], 3);
}

/// T-LOCK-3: others take the lock at most twice while a core waits, even if one of them takes it
/// again. The others take it four times in all, so the model could exceed this bound.
#[test]
fn three_cores_wait_two_turns_at_most() {
    contend([1, 1, 3], 2);
}

/// T-LOCK-3: as above, if both others take the lock again.
#[test]
#[ignore = "ten times as long: cargo xtask loom --long"]
fn three_cores_that_come_back_wait_two_turns_at_most() {
    contend([1, 2, 2], 2);
}

/// T-LOCK-3: the owner dies. Of the next two cores that take the lock, the first gets `Recovered`.
#[test]
fn one_waiter_learns_of_the_death() {
    model(3, || {
        let words = lock_words(3);
        core::mem::forget(
            bare::lock(&words, incarnation(0), incarnations(&words))
                .unwrap()
                .try_lock(),
        );
        let recovered = Arc::new(UnsafeCell::new(()));
        let waiters: Vec<_> = (1..3)
            .map(|core| {
                let (words, recovered) = (words.clone(), recovered.clone());
                thread::spawn(move || {
                    let mut lock =
                        bare::lock(&words, incarnation(core), incarnations(&words)).unwrap();
                    match lock.lock(6, spin) {
                        Ok(acquired) => {
                            recovered.with_mut(|_| ());
                            u32::from(acquired.is_recovered())
                        }
                        Err(_) => 0,
                    }
                })
            })
            .collect();
        incarnations(&words).mark_dead(incarnation(0));
        let recovered: u32 = waiters
            .into_iter()
            .map(|waiter| waiter.join().unwrap())
            .sum();
        let mut lock = bare::lock(&words, incarnation(1), incarnations(&words)).unwrap();
        let recovered = recovered + u32::from(lock.try_lock().unwrap().is_recovered());
        assert_eq!(recovered, 1);
    });
}

/// A core waits and stops polling. Two other cores run out of patience, or see it poll again: at
/// most one core is inside.
#[test]
fn a_core_that_loses_patience_excludes_the_others() {
    model(2, || {
        let words = lock_words(3);
        let guarded = Arc::new(UnsafeCell::new(()));
        let take = |words: &[AtomicU32], guarded: &UnsafeCell<()>, core, polls| {
            let mut lock = bare::lock(words, incarnation(core), incarnations(words)).unwrap();
            lock.set_patience(1);
            if let Ok(acquired) = lock.lock(polls, spin) {
                assert!(!acquired.is_recovered(), "no core died");
                guarded.with_mut(|_| ());
            }
        };
        // Core 1 waits: its bit is set. It polls again late.
        take(&words, &guarded, 0, 1);
        words[0].fetch_or(1 << 7, Ordering::Relaxed);
        let others: Vec<_> = [(1, 1), (2, 3)]
            .map(|(core, polls)| {
                let (words, guarded) = (words.clone(), guarded.clone());
                thread::spawn(move || take(&words, &guarded, core, polls))
            })
            .into();
        take(&words, &guarded, 0, 3);
        for other in others {
            other.join().unwrap();
        }
        // The bit of a core that no longer waits delays no other.
        take(&words, &guarded, 2, 3);
    });
}

const BLOCKS: usize = 2;

/// Returns the words of a pool and an incarnation table with cores 0 and 1 alive.
fn pool_words() -> Arc<Vec<AtomicU32>> {
    let words = zeroed(pool::words(BLOCKS) + Incarnations::WORDS);
    for core in 0..2 {
        pool_incarnations(&words)
            .announce(incarnation(core))
            .unwrap();
    }
    words
}

fn pool_incarnations(words: &[AtomicU32]) -> Incarnations<'_> {
    Incarnations::attach(&words[pool::words(BLOCKS)..]).unwrap()
}

fn attach(words: &[AtomicU32], core: usize) -> Pool<'_> {
    bare::pool(words, BLOCKS, incarnation(core), pool_incarnations(words)).unwrap()
}

/// T-SHM-1, T-SHM-2: two cores get and give back at the same time; no block is lent twice or lost.
#[test]
fn two_cores_get_different_blocks() {
    model(3, || {
        let words = pool_words();
        let other = {
            let words = words.clone();
            thread::spawn(move || {
                let pool = attach(&words, 1);
                let handle = pool.get(1).unwrap();
                pool.open(handle).unwrap()[0].store(1, Ordering::Relaxed);
                handle
            })
        };
        let pool = attach(&words, 0);
        let first = pool.get(1).unwrap();
        pool.give_back(first).unwrap();
        let handle = pool.get(BLOCK_WORDS).unwrap();
        pool.open(handle).unwrap()[0].store(2, Ordering::Relaxed);
        let theirs = other.join().unwrap();
        assert_eq!(pool.free_words(), 0);
        assert_ne!(handle.to_words()[0] & 0xFFFF, theirs.to_words()[0] & 0xFFFF);
        assert_eq!(pool.open(handle).unwrap()[0].load(Ordering::Relaxed), 2);
    });
}

/// T-SHM-1: three cores borrow from a pool of two blocks, and one of them borrows both. No block is
/// lent twice, and all blocks become free again.
#[test]
fn three_cores_borrow_without_overlap() {
    model(2, || {
        let words = pool_words();
        pool_incarnations(&words).announce(incarnation(2)).unwrap();
        let guarded = Arc::new([UnsafeCell::new(()), UnsafeCell::new(())]);
        let borrow = |words: &[AtomicU32], guarded: &[UnsafeCell<()>; 2], core, blocks| {
            let pool = attach(words, core);
            if let Ok(handle) = pool.get(blocks * BLOCK_WORDS) {
                let first = (handle.to_words()[0] & 0xFFFF) as usize;
                for block in first..first + blocks {
                    guarded[block].with_mut(|_| ());
                }
                pool.give_back(handle).unwrap();
            }
        };
        let others: Vec<_> = [(1, 2), (2, 1)]
            .map(|(core, blocks)| {
                let (words, guarded) = (words.clone(), guarded.clone());
                thread::spawn(move || borrow(&words, &guarded, core, blocks))
            })
            .into();
        borrow(&words, &guarded, 0, 1);
        for other in others {
            other.join().unwrap();
        }
        assert_eq!(attach(&words, 0).free_words(), BLOCKS * BLOCK_WORDS);
    });
}

/// T-SHM-2: two cores reclaim and borrow the words of a dead core, which are freed and lent once.
#[test]
fn the_words_of_the_dead_are_reclaimed_once() {
    model(3, || {
        let words = pool_words();
        let guarded = Arc::new(UnsafeCell::new(()));
        let lost = attach(&words, 0).get(BLOCKS * BLOCK_WORDS).unwrap();
        let reuse = |words: &[AtomicU32], guarded: &UnsafeCell<()>, core| {
            pool_incarnations(words)
                .announce(incarnation(core))
                .unwrap();
            let pool = attach(words, core);
            let reclaimed = pool.reclaim_dead();
            if let Ok(handle) = pool.get(BLOCKS * BLOCK_WORDS) {
                guarded.with_mut(|_| ());
                pool.give_back(handle).unwrap();
            }
            reclaimed
        };
        let other = {
            let (words, guarded) = (words.clone(), guarded.clone());
            thread::spawn(move || reuse(&words, &guarded, 1))
        };
        pool_incarnations(&words).mark_dead(incarnation(0));
        let reclaimed = reuse(&words, &guarded, 2) + other.join().unwrap();
        assert!(reclaimed <= BLOCKS * BLOCK_WORDS, "freed twice");
        let pool = attach(&words, 2);
        assert!(pool.open(lost).is_err());
        assert_eq!(pool.free_words(), BLOCKS * BLOCK_WORDS);
    });
}

/// T-SHM-3: a core that opens words that were handed over sees what the last owner wrote, also
/// after they were handed back.
#[test]
fn handing_over_carries_the_words() {
    model(3, || {
        let words = pool_words();
        let pool = attach(&words, 0);
        let handle = pool.get(1).unwrap();
        let other = {
            let words = words.clone();
            thread::spawn(move || {
                let pool = attach(&words, 1);
                if let Ok(mine) = pool.open(handle) {
                    assert_eq!(mine[0].load(Ordering::Relaxed), 7);
                    mine[0].store(8, Ordering::Relaxed);
                    pool.hand_over(handle, 0).unwrap();
                }
            })
        };
        pool.open(handle).unwrap()[0].store(7, Ordering::Relaxed);
        pool.hand_over(handle, 1).unwrap();
        if let Ok(mine) = pool.open(handle) {
            assert_eq!(mine[0].load(Ordering::Relaxed), 8);
        }
        other.join().unwrap();
    });
}
