//! loom models of the sync mailbox: no signal and no wake-up is lost.
#![cfg(loom)]
#![allow(clippy::unwrap_used, reason = "test code")]

mod common;

use common::{model, zeroed};
use loom::sync::{Arc, Notify};
use loom::thread;
use tandem_shm::mailbox::{Receiver, Ring, Sender, TaskId, WORDS};
use tandem_shm::sync::Ordering;

/// T-SYNC-3: a receiver that goes to sleep is rung for each signal that it has not seen. A lost
/// wake-up is a deadlock of the model. The payload that was written before the signal is visible.
#[test]
fn no_wake_up_is_lost() {
    model(3, || {
        let words = zeroed(WORDS + 1);
        let doorbell = Arc::new(Notify::new());
        let sending = {
            let (words, doorbell) = (words.clone(), doorbell.clone());
            thread::spawn(move || {
                let sender = Sender::attach(&words).unwrap();
                for payload in 1..=2 {
                    words[WORDS].store(payload, Ordering::Relaxed);
                    if sender.signal(TaskId::new(1).unwrap()) == Ring::Needed {
                        doorbell.notify();
                    }
                }
            })
        };
        let mut receiver = Receiver::attach(&words).unwrap();
        let mut handled = 0;
        loop {
            receiver.poll(|task, count| {
                assert_eq!(task.index(), 1);
                handled += count;
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

/// T-SYNC-3: signals of a task and of a handler of the sending core are all counted.
#[test]
fn two_contexts_of_one_sender_lose_no_signal() {
    model(2, || {
        let words = zeroed(WORDS);
        let senders: Vec<_> = (1..=2)
            .map(|other| {
                let words = words.clone();
                thread::spawn(move || {
                    let sender = Sender::attach(&words).unwrap();
                    let _ = sender.signal(TaskId::new(3).unwrap());
                    let _ = sender.signal(TaskId::new(other).unwrap());
                })
            })
            .collect();
        let mut receiver = Receiver::attach(&words).unwrap();
        let mut handled = receiver.poll(|_, _| ());
        // A successor handles the rest.
        let mut receiver = Receiver::attach(&words).unwrap();
        handled += receiver.poll(|_, _| ());
        for sender in senders {
            sender.join().unwrap();
        }
        handled += receiver.poll(|_, _| ());
        assert_eq!(handled, 4);
    });
}
