//! loom models in which a core dies at each access to shared memory while other threads run.
#![cfg(loom)]
#![allow(clippy::unwrap_used, reason = "test code")]

mod common;

use common::{model, zeroed};
use loom::cell::UnsafeCell;
use loom::sync::Arc;
use loom::thread;
use tandem_shm::bare;
use tandem_shm::fault::kill_at;
use tandem_shm::incarnation::{Incarnation, Incarnations};
use tandem_shm::lock::{self, Lock};
use tandem_shm::mailbox::{self, Receiver, TaskId};
use tandem_shm::pool::{self, BLOCK_WORDS, Pool};
use tandem_shm::sync::{AtomicU32, Ordering, spin};

const OBJECT_AT: usize = Incarnations::WORDS;

fn incarnations(words: &[AtomicU32]) -> Incarnations<'_> {
    Incarnations::attach(words).unwrap()
}

fn announce(words: &[AtomicU32], core: usize, generation: u32) -> Incarnation {
    let incarnation = Incarnation::new(core, generation).unwrap();
    incarnations(words).announce(incarnation).unwrap();
    incarnation
}

fn lock(words: &[AtomicU32], incarnation: Incarnation) -> Lock<'_> {
    bare::lock(&words[OBJECT_AT..], incarnation, incarnations(words)).unwrap()
}

const BLOCKS: usize = 3;

fn pool(words: &[AtomicU32], incarnation: Incarnation) -> Pool<'_> {
    bare::pool(
        &words[OBJECT_AT..],
        BLOCKS,
        incarnation,
        incarnations(words),
    )
    .unwrap()
}

/// T-LOCK-3: the owner dies at any access while it takes and releases the lock, and another core
/// polls the lock. At most one core is inside; the waiter gets `Recovered` if and only if the owner
/// died inside.
#[test]
fn a_lock_survives_its_owner_at_every_access() {
    for at in 0..7 {
        model(2, move || {
            let words = zeroed(OBJECT_AT + lock::WORDS);
            let guarded = Arc::new(UnsafeCell::new(()));
            let dying = {
                let (words, guarded) = (words.clone(), guarded.clone());
                thread::spawn(move || {
                    let incarnation = announce(&words, 0, 1);
                    let mut lock = lock(&words, incarnation);
                    let mut inside = false;
                    let end = kill_at(at, || {
                        if let Some(guard) = lock.try_lock() {
                            assert!(!guard.is_recovered());
                            inside = true;
                            guarded.with_mut(|_| ());
                            drop(guard);
                        }
                    });
                    incarnations(&words).mark_dead(incarnation);
                    inside && end.is_none()
                })
            };
            let incarnation = announce(&words, 1, 1);
            let mut lock = lock(&words, incarnation);
            let mut recovered = 0;
            let mut take = |polls| {
                if let Ok(acquired) = lock.lock(polls, spin) {
                    recovered += u32::from(acquired.is_recovered());
                    guarded.with_mut(|_| ());
                }
            };
            take(2);
            let died_inside = dying.join().unwrap();
            take(1);
            // If it was killed before its compare-and-swap succeeded, it was never inside.
            assert_eq!(recovered, u32::from(died_inside));
        });
    }
}

/// T-SHM-2: a core dies at any access while it borrows two blocks and gives them back, and another
/// core borrows. No block is lent twice, and all blocks become free again.
#[test]
fn a_pool_survives_a_borrower_at_every_access() {
    for at in 0..14 {
        model(2, move || {
            let words = zeroed(OBJECT_AT + pool::words(BLOCKS));
            let dying = {
                let words = words.clone();
                thread::spawn(move || {
                    let incarnation = announce(&words, 0, 1);
                    let pool = pool(&words, incarnation);
                    kill_at(at, || {
                        if let Ok(handle) = pool.get(2 * BLOCK_WORDS) {
                            let own = pool.open(handle).unwrap();
                            own[0].store(1, Ordering::Relaxed);
                            own[BLOCK_WORDS].store(1, Ordering::Relaxed);
                            assert_eq!(own[BLOCK_WORDS].load(Ordering::Relaxed), 1);
                            pool.give_back(handle).unwrap();
                        }
                    });
                    incarnations(&words).mark_dead(incarnation);
                })
            };
            let incarnation = announce(&words, 1, 1);
            let pool = pool(&words, incarnation);
            let got = pool.get(1);
            if let Ok(handle) = got {
                let own = pool.open(handle).unwrap();
                own[0].store(2, Ordering::Relaxed);
                assert_eq!(own[0].load(Ordering::Relaxed), 2);
            }
            dying.join().unwrap();
            if let Ok(handle) = got {
                pool.give_back(handle).unwrap();
            }
            let all = pool.get(BLOCKS * BLOCK_WORDS);
            assert!(all.is_ok(), "killed at {at}: {all:?}");
        });
    }
}

/// T-SYNC-3: a sender dies at any access of a signal and is replaced while the receiver polls. Each
/// signal that it had counted is handled exactly once.
#[test]
fn a_mailbox_survives_its_sender_at_every_access() {
    let task = TaskId::new(1).unwrap();
    for at in 0..6 {
        model(2, move || {
            let words = zeroed(mailbox::WORDS);
            let sending = {
                let words = words.clone();
                thread::spawn(move || {
                    let mut sender = bare::mailbox_sender(&words).unwrap();
                    let sent = kill_at(at, || sender.signal_with(task, 7)).is_some();
                    let mut successor = bare::mailbox_sender(&words).unwrap();
                    let _ = successor.signal_with(task, 8);
                    sent
                })
            };
            let mut receiver = bare::mailbox_receiver(&words).unwrap();
            let mut handled = 0;
            let mut poll = |receiver: &mut Receiver<'_>| {
                receiver.poll(|open| {
                    handled += open.count;
                    assert!(
                        matches!(open.value, 7 | 8),
                        "a value comes before its count"
                    );
                });
            };
            poll(&mut receiver);
            let sent = sending.join().unwrap();
            poll(&mut receiver);
            assert!(handled == 2 || handled == 1 && !sent, "{handled}, {sent}");
        });
    }
}

/// T-SYNC-3: a receiver dies at any access of a poll and is replaced while the sender sends. Each
/// signal is handled at least once.
#[test]
fn a_mailbox_survives_its_receiver_at_every_access() {
    let task = TaskId::new(1).unwrap();
    for at in 0..8 {
        model(2, move || {
            let words = zeroed(mailbox::WORDS);
            let sending = {
                let words = words.clone();
                thread::spawn(move || {
                    let mut sender = bare::mailbox_sender(&words).unwrap();
                    let _ = sender.signal(task);
                    let _ = sender.signal(task);
                })
            };
            let mut handled = 0;
            let mut receiver = bare::mailbox_receiver(&words).unwrap();
            kill_at(at, || {
                receiver.poll(|open| handled += open.count);
            });
            let mut successor = bare::mailbox_receiver(&words).unwrap();
            successor.poll(|open| handled += open.count);
            sending.join().unwrap();
            successor.poll(|open| handled += open.count);
            assert!((2..=4).contains(&handled), "{handled}");
        });
    }
}
