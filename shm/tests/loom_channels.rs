//! loom models of the channels (newest value, broadcast, FIFO) and of `Map::format`.
#![cfg(loom)]
#![allow(clippy::unwrap_used, reason = "test code")]

mod common;

use common::{model, zeroed};
use loom::cell::UnsafeCell;
use loom::sync::Arc;
use loom::thread;
use tandem_shm::bare;
use tandem_shm::broadcast::{self, Lost, Stamp};
use tandem_shm::mailbox::{self, TaskId};
use tandem_shm::map::{Layout, Map, MapError};
use tandem_shm::newest::{self, ReadError};
use tandem_shm::region::{Region, Words};
use tandem_shm::sync::{Ordering, spin};
use tandem_shm::{LINE_WORDS, Shape, fifo};

const SHAPE: Shape = Shape::new(2, 2);
type Value = [u32; 2];

/// The reader gets whole values, never an older one after a newer one, while the writer overwrites
/// all slots and a successor replaces it in the middle of a value.
#[test]
fn newest_is_never_torn_and_never_goes_back() {
    model(4, || {
        let words = zeroed(newest::words(SHAPE));
        let writer = {
            let words = words.clone();
            thread::spawn(move || {
                let mut writer = bare::newest_writer(&words, SHAPE).unwrap();
                writer.publish(&[1, 1]);
                writer.publish(&[2, 2]);
                writer.loan().words().set(0, 99);
                let mut successor = bare::newest_writer(&words, SHAPE).unwrap();
                successor.publish(&[3, 3]);
            })
        };
        let reader = bare::newest_reader::<Value>(&words, SHAPE).unwrap();
        let mut last = 0;
        for _ in 0..2 {
            match reader.read() {
                Ok((stamp, [a, b])) => {
                    assert_eq!((a, b), (stamp.0 + 1, stamp.0 + 1));
                    assert!(a >= last);
                    last = a;
                }
                Err(ReadError::Empty) => assert_eq!(last, 0),
                Err(ReadError::Overrun) => {}
                Err(ReadError::Corrupt) => panic!("every word is a value"),
            }
        }
        writer.join().unwrap();
        assert_eq!(reader.read().unwrap().1, [3, 3]);
    });
}

/// A core that prefetches the channel's line before it polls the mailbox may have loaded an older
/// head. After a signal it still reads the signalled value.
#[test]
fn a_value_is_there_with_its_signal_whatever_was_prefetched() {
    model(3, || {
        let (words, signals) = (zeroed(newest::words(SHAPE)), zeroed(mailbox::WORDS));
        let sending = {
            let (words, signals) = (words.clone(), signals.clone());
            thread::spawn(move || {
                let mut writer = bare::newest_writer(&words, SHAPE).unwrap();
                writer.publish(&[7, 7]);
                let mut sender = bare::mailbox_sender(&signals).unwrap();
                let _ = sender.signal(TaskId::FIRST);
            })
        };
        let reader = bare::newest_reader::<Value>(&words, SHAPE).unwrap();
        let mut receiver = bare::mailbox_receiver(&signals).unwrap();
        for _ in 0..2 {
            reader.prefetch();
            receiver.poll(|_| assert_eq!(reader.read().unwrap().1, [7, 7]));
        }
        sending.join().unwrap();
    });
}

/// Every value is received whole and in order, or counted as lost.
#[test]
fn broadcast_values_are_received_or_counted() {
    model(4, || {
        let words = zeroed(broadcast::words(SHAPE));
        let mut receiver = bare::broadcast_receiver(&words, SHAPE).unwrap();
        let sender = {
            let words = words.clone();
            thread::spawn(move || {
                let mut sender = bare::broadcast_writer(&words, SHAPE).unwrap();
                for k in 0..3 {
                    sender.publish(&[k, k]);
                }
            })
        };
        let mut next = 0;
        let mut look = |receiver: &mut broadcast::Receiver<'_, Value>| {
            match receiver.receive() {
                Ok(None) => return false,
                Ok(Some((stamp, value))) => {
                    assert_eq!((stamp.0, value), (next, [next; 2]));
                    next += 1;
                }
                Err(Lost { count }) => next += count,
            }
            true
        };
        for _ in 0..2 {
            look(&mut receiver);
        }
        sender.join().unwrap();
        while look(&mut receiver) {}
        assert_eq!(next, 3);
    });
}

/// Two receivers: each gets every value whole and in order, or counts it as lost.
#[test]
fn two_receivers_of_a_broadcast_do_not_disturb_each_other() {
    model(2, || {
        let words = zeroed(broadcast::words(SHAPE));
        let receive =
            |receiver: &mut broadcast::Receiver<'_, Value>, next: &mut Option<u32>| match receiver
                .receive()
            {
                Ok(None) => {}
                Ok(Some((Stamp(number), value))) => {
                    assert_eq!(value, [number; 2]);
                    assert_eq!(number, next.unwrap_or(number));
                    *next = Some(number + 1);
                }
                Err(Lost { count }) => *next = next.map(|next| next + count),
            };
        let sender = {
            let words = words.clone();
            thread::spawn(move || {
                let mut sender = bare::broadcast_writer(&words, SHAPE).unwrap();
                for k in 0..3 {
                    sender.publish(&[k, k]);
                }
            })
        };
        let other = {
            let words = words.clone();
            thread::spawn(move || {
                let mut receiver = bare::broadcast_receiver(&words, SHAPE)
                    .unwrap()
                    .from_oldest();
                let mut next = None;
                for _ in 0..2 {
                    receive(&mut receiver, &mut next);
                }
            })
        };
        let mut receiver = bare::broadcast_receiver(&words, SHAPE).unwrap();
        let mut next = None;
        for _ in 0..2 {
            receive(&mut receiver, &mut next);
        }
        sender.join().unwrap();
        other.join().unwrap();
        for _ in 0..4 {
            receive(&mut receiver, &mut next);
        }
        assert!(matches!(next, None | Some(3)), "{next:?}");
    });
}

/// Waits for the next value of a queue.
fn next(consumer: &mut fifo::Consumer<'_, Value>) -> Value {
    loop {
        match consumer.receive().unwrap() {
            Some(value) => return value,
            None => spin(1),
        }
    }
}

/// Every value is received once, whole and in order.
#[test]
fn fifo_values_arrive_in_order() {
    model(4, || {
        let words = zeroed(fifo::words(SHAPE));
        let producer = {
            let words = words.clone();
            thread::spawn(move || {
                let mut producer = bare::fifo_producer::<Value>(&words, SHAPE).unwrap();
                for k in 1..=3 {
                    while producer.send(&[k, k]).is_err() {
                        spin(1);
                    }
                }
            })
        };
        let mut consumer = bare::fifo_consumer::<Value>(&words, SHAPE).unwrap();
        for k in 1..=3 {
            assert_eq!(next(&mut consumer), [k; 2]);
        }
        producer.join().unwrap();
        assert_eq!(consumer.receive(), Ok(None));
    });
}

/// The producer refills no slot before the consumer has read it. In loom a load never sees a later
/// store, so a cell that both ends access represents the words of each slot.
#[test]
fn fifo_slots_are_refilled_after_they_were_read() {
    model(3, || {
        let words = zeroed(fifo::words(SHAPE));
        let slots = Arc::new([UnsafeCell::new(()), UnsafeCell::new(())]);
        let producer = {
            let (words, slots) = (words.clone(), slots.clone());
            thread::spawn(move || {
                let mut producer = bare::fifo_producer::<Value>(&words, SHAPE).unwrap();
                for k in 0..4 {
                    if k == 3 {
                        // A successor may refill the slots that its predecessor could refill.
                        producer = bare::fifo_producer::<Value>(&words, SHAPE).unwrap();
                    }
                    let loan = loop {
                        match producer.loan() {
                            Ok(loan) => break loan,
                            Err(fifo::Full) => spin(1),
                        }
                    };
                    slots[k % 2].with_mut(|_| ());
                    loan.send();
                }
            })
        };
        let mut consumer = bare::fifo_consumer::<Value>(&words, SHAPE).unwrap();
        for k in 0..4 {
            let item = loop {
                match consumer.item() {
                    Some(item) => break item,
                    None => spin(1),
                }
            };
            slots[k % 2].with(|_| ());
            item.release();
        }
        producer.join().unwrap();
    });
}

/// The producer restores an overwritten stamp: a core that sees the restored stamp sees the words.
#[test]
fn fifo_values_behind_a_restored_stamp_are_whole() {
    const STAMP_AT: usize = fifo::words(SHAPE) - 6;
    model(3, || {
        let words = zeroed(fifo::words(SHAPE));
        let producer = {
            let words = words.clone();
            thread::spawn(move || {
                let mut producer = bare::fifo_producer::<Value>(&words, SHAPE).unwrap();
                for k in 1..=2 {
                    producer.send(&[k, k]).unwrap();
                }
                words[STAMP_AT].store(0, Ordering::Relaxed);
                let _ = producer.loan();
            })
        };
        let mut consumer = bare::fifo_consumer::<Value>(&words, SHAPE).unwrap();
        let mut last = 0;
        for _ in 0..2 {
            if let Some(value) = consumer.receive().unwrap() {
                assert!(value[0] > last && value[0] == value[1], "{value:?}");
                last = value[0];
            }
        }
        producer.join().unwrap();
        // Either the stamp of a released value was restored, or the value was received.
        while let Some(value) = consumer.receive().unwrap() {
            last = value[0];
        }
        assert_eq!(last, 2);
    });
}

/// The successor of a consumer continues after the last value that was released.
#[test]
fn fifo_survives_a_new_consumer() {
    model(4, || {
        let words = zeroed(fifo::words(SHAPE));
        let producer = {
            let words = words.clone();
            thread::spawn(move || {
                let mut producer = bare::fifo_producer::<Value>(&words, SHAPE).unwrap();
                for k in 1..=2 {
                    producer.send(&[k, k]).unwrap();
                }
            })
        };
        let mut next = 1;
        for _ in 0..3 {
            let mut consumer = bare::fifo_consumer::<Value>(&words, SHAPE).unwrap();
            if let Some(value) = consumer.receive().unwrap() {
                assert_eq!(value, [next; 2]);
                next += 1;
            }
        }
        producer.join().unwrap();
    });
}

/// If the producer is replaced after each value, its successor continues after the sent values. A
/// slot that was only lent sends no value.
#[test]
fn fifo_survives_new_producers() {
    model(3, || {
        let words = zeroed(fifo::words(SHAPE));
        let producers = {
            let words = words.clone();
            thread::spawn(move || {
                for k in 0..3 {
                    let mut producer = bare::fifo_producer::<Value>(&words, SHAPE).unwrap();
                    assert_eq!(producer.sent(), k);
                    while producer.send(&[k, k]).is_err() {
                        spin(1);
                    }
                    if let Ok(mut loan) = producer.loan() {
                        loan.words().set(0, 99);
                    }
                }
            })
        };
        let mut consumer = bare::fifo_consumer::<Value>(&words, SHAPE).unwrap();
        for k in 0..3 {
            assert_eq!(next(&mut consumer), [k, k]);
        }
        producers.join().unwrap();
        assert_eq!(consumer.receive(), Ok(None));
    });
}

/// A core that attaches sees a fully formatted LMU and no earlier content.
#[test]
fn map_is_seen_whole_or_not_at_all() {
    const ALONE: Region<Words<1>> = Region::first("alone");
    const LAYOUT: Layout = ALONE.end();
    model(4, || {
        let words = zeroed(LAYOUT.total_words());
        words[LAYOUT.total_words() - LINE_WORDS].store(7, Ordering::Relaxed);
        let boot = {
            let words = words.clone();
            thread::spawn(move || {
                Map::format(&words, LAYOUT).unwrap();
            })
        };
        match Map::attach(&words, LAYOUT) {
            Ok(map) => assert_eq!(ALONE.attach(&map).unwrap()[0].load(Ordering::Relaxed), 0),
            Err(error) => assert_eq!(error, MapError::NotReady),
        }
        boot.join().unwrap();
    });
}
