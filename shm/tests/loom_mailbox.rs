//! loom models of the sync mailbox: no signal and no wake-up is lost.
#![cfg(loom)]
#![allow(clippy::unwrap_used, reason = "test code")]

mod common;

use common::{model, zeroed};
use loom::cell::UnsafeCell;
use loom::sync::{Arc, Notify};
use loom::thread;
use tandem_shm::bare;
use tandem_shm::mailbox::{Ring, TaskId, WORDS};
use tandem_shm::sync::Ordering;

/// T-SYNC-3: the doorbell wakes a sleeping receiver for each signal that it has not seen. A lost
/// wake-up is a deadlock of the model. The receiver sees the payload that was written before the
/// signal, and a value that is not older than the count.
#[test]
fn no_wake_up_is_lost() {
    model(3, || {
        let words = zeroed(WORDS + 1);
        let doorbell = Arc::new(Notify::new());
        let sending = {
            let (words, doorbell) = (words.clone(), doorbell.clone());
            thread::spawn(move || {
                let mut sender = bare::mailbox_sender(&words).unwrap();
                for payload in 1..=2 {
                    words[WORDS].store(payload, Ordering::Relaxed);
                    let task = TaskId::new(1).unwrap();
                    if sender.signal_with(task, payload) == Ring::Needed {
                        doorbell.notify();
                    }
                }
            })
        };
        let mut receiver = bare::mailbox_receiver(&words).unwrap();
        let mut handled = 0;
        loop {
            receiver.poll(|open| {
                assert_eq!(open.task.index(), 1);
                handled += open.count;
                assert!(open.value >= handled);
                assert!(words[WORDS].load(Ordering::Relaxed) >= handled);
            });
            if handled == 2 {
                break;
            }
            if receiver.prepare_sleep() {
                doorbell.wait();
                receiver.awake();
            }
        }
        sending.join().unwrap();
    });
}

/// T-SYNC-3: a receiver that polls the posted word misses no signal of several tasks, wherever its
/// polls fall between the sender's steps.
#[test]
fn no_task_is_missed() {
    model(3, || {
        let words = zeroed(WORDS);
        let sending = {
            let words = words.clone();
            thread::spawn(move || {
                let mut sender = bare::mailbox_sender(&words).unwrap();
                for number in [3, 1, 3] {
                    let _ = sender.signal(TaskId::new(number).unwrap());
                }
            })
        };
        let mut receiver = bare::mailbox_receiver(&words).unwrap();
        let mut handled = [0; 4];
        for _ in 0..2 {
            receiver.poll(|open| handled[open.task.index()] += open.count);
        }
        sending.join().unwrap();
        receiver.poll(|open| handled[open.task.index()] += open.count);
        assert_eq!(handled, [0, 1, 0, 2]);
    });
}

/// After `open` returns 0, the sender may reuse the payload that the handler has read.
#[test]
fn what_a_handler_has_read_may_be_reused() {
    model(3, || {
        let words = zeroed(WORDS);
        let payload = Arc::new(UnsafeCell::new(()));
        let task = TaskId::new(1).unwrap();
        let sending = {
            let (words, payload) = (words.clone(), payload.clone());
            thread::spawn(move || {
                let mut sender = bare::mailbox_sender(&words).unwrap();
                payload.with_mut(|_| ());
                let _ = sender.signal(task);
                for _ in 0..2 {
                    if sender.open(task) == 0 {
                        payload.with_mut(|_| ());
                    }
                }
            })
        };
        let mut receiver = bare::mailbox_receiver(&words).unwrap();
        for _ in 0..2 {
            receiver.poll(|_| payload.with(|_| ()));
        }
        sending.join().unwrap();
    });
}

/// T-SYNC-3: each end is replaced between operations while the other end runs: each signal is
/// handled once, and the doorbell wakes a sleeping successor.
#[test]
fn replaced_ends_lose_no_signal() {
    model(3, || {
        let words = zeroed(WORDS);
        let doorbell = Arc::new(Notify::new());
        let task = TaskId::new(1).unwrap();
        let sending = {
            let (words, doorbell) = (words.clone(), doorbell.clone());
            thread::spawn(move || {
                for _ in 0..2 {
                    let mut sender = bare::mailbox_sender(&words).unwrap();
                    if sender.signal(task) == Ring::Needed {
                        doorbell.notify();
                    }
                }
            })
        };
        let mut handled = 0;
        while handled < 2 {
            let mut receiver = bare::mailbox_receiver(&words).unwrap();
            receiver.poll(|open| handled += open.count);
            if handled < 2 && receiver.prepare_sleep() {
                doorbell.wait();
            }
        }
        sending.join().unwrap();
        assert_eq!(handled, 2);
    });
}
