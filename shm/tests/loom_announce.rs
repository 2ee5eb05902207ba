//! loom models of incarnations that start while others run: no core takes a lock or words from a
//! living incarnation.
#![cfg(loom)]
#![allow(clippy::unwrap_used, reason = "test code")]

mod common;

use common::{model, zeroed};
use loom::cell::UnsafeCell;
use loom::sync::Arc;
use loom::thread;
use tandem_shm::bare;
use tandem_shm::incarnation::{Incarnation, Incarnations};
use tandem_shm::lock::{self, Lock};
use tandem_shm::pool::{self, Pool};
use tandem_shm::sync::{AtomicU32, spin};

const LIVES_AT: usize = 0;
const OBJECT_AT: usize = Incarnations::WORDS;
const LOCK_WORDS: usize = OBJECT_AT + lock::WORDS;

fn incarnations(words: &[AtomicU32]) -> Incarnations<'_> {
    Incarnations::attach(&words[LIVES_AT..]).unwrap()
}

/// Announces a new incarnation of this core and attaches it to the lock.
fn start_lock(words: &[AtomicU32], core: usize, generation: u32) -> Lock<'_> {
    let incarnation = Incarnation::new(core, generation).unwrap();
    incarnations(words).announce(incarnation).unwrap();
    bare::lock(&words[OBJECT_AT..], incarnation, incarnations(words)).unwrap()
}

/// T-LOCK-1: a core announces itself and takes the lock for the first time while another core polls
/// it. No core reports a death, and at most one core is inside.
#[test]
fn a_new_incarnation_that_holds_the_lock_is_seen_alive() {
    model(3, || {
        let words = zeroed(LOCK_WORDS);
        let guarded = Arc::new(UnsafeCell::new(()));
        let other = {
            let (words, guarded) = (words.clone(), guarded.clone());
            thread::spawn(move || {
                let mut lock = start_lock(&words, 1, 1);
                if let Ok(acquired) = lock.lock(2, spin) {
                    assert!(!acquired.is_recovered(), "no core died");
                    guarded.with_mut(|_| ());
                }
            })
        };
        let mut lock = start_lock(&words, 0, 1);
        if let Ok(acquired) = lock.lock(2, spin) {
            assert!(!acquired.is_recovered(), "no core died");
            guarded.with_mut(|_| ());
        }
        other.join().unwrap();
    });
}

/// T-LOCK-1: as above, after another core had the lock: `look` takes it, not `retake`.
#[test]
fn a_new_incarnation_that_takes_the_lock_after_another_is_seen_alive() {
    model(3, || {
        let words = zeroed(LOCK_WORDS);
        let mut first = start_lock(&words, 0, 1);
        drop(first.try_lock());
        let guarded = Arc::new(UnsafeCell::new(()));
        let other = {
            let (words, guarded) = (words.clone(), guarded.clone());
            thread::spawn(move || {
                let mut lock = start_lock(&words, 1, 1);
                if let Ok(acquired) = lock.lock(2, spin) {
                    assert!(!acquired.is_recovered(), "no core died");
                    guarded.with_mut(|_| ());
                }
            })
        };
        if let Ok(acquired) = first.lock(2, spin) {
            assert!(!acquired.is_recovered(), "no core died");
            guarded.with_mut(|_| ());
        }
        other.join().unwrap();
    });
}

/// A core releases the lock, is reset, and announces its next incarnation while another core polls
/// the lock: that core reports no death.
#[test]
fn a_release_before_the_next_incarnation_is_no_recovery() {
    model(3, || {
        let words = zeroed(LOCK_WORDS);
        let other = {
            let words = words.clone();
            thread::spawn(move || {
                let mut lock = start_lock(&words, 1, 1);
                if let Ok(acquired) = lock.lock(2, spin) {
                    assert!(!acquired.is_recovered(), "no core died inside");
                }
            })
        };
        drop(start_lock(&words, 0, 1).try_lock());
        incarnations(&words)
            .announce(Incarnation::new(0, 2).unwrap())
            .unwrap();
        other.join().unwrap();
    });
}

const BLOCKS: usize = 2;
const POOL_WORDS: usize = OBJECT_AT + pool::words(BLOCKS);

fn start_pool(words: &[AtomicU32], core: usize, generation: u32) -> Pool<'_> {
    let incarnation = Incarnation::new(core, generation).unwrap();
    incarnations(words).announce(incarnation).unwrap();
    bare::pool(
        &words[OBJECT_AT..],
        BLOCKS,
        incarnation,
        incarnations(words),
    )
    .unwrap()
}

/// T-SHM-2: a core announces itself and borrows words while another core reclaims the words of dead
/// incarnations: no words of the living core are freed.
#[test]
fn the_words_of_a_new_incarnation_are_not_reclaimed() {
    model(3, || {
        let words = zeroed(POOL_WORDS);
        let other = {
            let words = words.clone();
            thread::spawn(move || {
                let pool = start_pool(&words, 1, 1);
                let handle = pool.get(1).unwrap();
                assert!(pool.open(handle).is_ok());
                handle
            })
        };
        let pool = start_pool(&words, 0, 1);
        assert_eq!(pool.reclaim_dead(), 0, "no core died");
        let handle = other.join().unwrap();
        let owner = Incarnation::new(1, 1).unwrap();
        let pool = bare::pool(&words[OBJECT_AT..], BLOCKS, owner, incarnations(&words)).unwrap();
        assert!(pool.open(handle).is_ok(), "its words were taken");
    });
}
