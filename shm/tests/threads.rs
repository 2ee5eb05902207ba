//! Tests of the primitives between threads, without a model: under Miri or at full speed.
#![cfg(not(loom))]
#![allow(clippy::unwrap_used, reason = "test code")]

use std::thread;

use tandem_shm::bare;
use tandem_shm::broadcast::{self, Lost};
use tandem_shm::incarnation::{Incarnation, Incarnations};
use tandem_shm::lock;
use tandem_shm::mailbox::{self, Ring, TaskId};
use tandem_shm::map::Map;
use tandem_shm::newest::{self, ReadError};
use tandem_shm::plain::PlainMap;
use tandem_shm::pool::{self, Handle};
use tandem_shm::region::{EndError, Plain, Region};
use tandem_shm::sync::{AtomicU32, Ordering, spin};
use tandem_shm::{LINE_WORDS, Shape, fifo};

/// Number of times that a thread repeats its work.
const TIMES: u32 = if cfg!(miri) { 60 } else { 20_000 };

const SHAPE: Shape = Shape::new(4, 3);

/// Calls `f` with zeroed words from a line boundary on.
fn with_words(words: usize, f: impl FnOnce(&[AtomicU32])) {
    let memory: Vec<AtomicU32> = (0..words + LINE_WORDS).map(|_| AtomicU32::new(0)).collect();
    let skip = memory.as_ptr().align_offset(64);
    f(&memory[skip..skip + words]);
}

#[test]
fn newest_values_are_whole_and_never_older() {
    with_words(newest::words(SHAPE), |words| {
        thread::scope(|scope| {
            scope.spawn(|| {
                let mut writer = bare::newest_writer(words, SHAPE).unwrap();
                for k in 1..=TIMES {
                    writer.publish(&[k; 3]);
                    if k.is_multiple_of(16) {
                        thread::yield_now();
                    }
                }
            });
            for _ in 0..2 {
                scope.spawn(|| {
                    let reader = bare::newest_reader(words, SHAPE).unwrap();
                    let mut last = 0;
                    while last < TIMES {
                        match reader.read() {
                            Ok((stamp, value)) => {
                                let value: [u32; 3] = value;
                                assert_eq!(value, [stamp.0 + 1; 3]);
                                assert!(value[0] >= last);
                                last = value[0];
                            }
                            Err(ReadError::Corrupt) => panic!("every word is a value"),
                            Err(ReadError::Empty | ReadError::Overrun) => thread::yield_now(),
                        }
                    }
                });
            }
        });
    });
}

#[test]
fn broadcast_values_are_received_or_counted() {
    with_words(broadcast::words(SHAPE), |words| {
        let receivers = [(); 2].map(|()| bare::broadcast_receiver(words, SHAPE).unwrap());
        thread::scope(|scope| {
            scope.spawn(|| {
                let mut sender = bare::broadcast_writer(words, SHAPE).unwrap();
                for k in 0..TIMES {
                    sender.publish(&[k; 3]);
                    if k.is_multiple_of(3) {
                        thread::yield_now();
                    }
                }
            });
            for mut receiver in receivers {
                scope.spawn(move || {
                    let mut next = 0;
                    while next < TIMES {
                        match receiver.receive() {
                            Ok(None) => thread::yield_now(),
                            Ok(Some((stamp, value))) => {
                                assert_eq!((stamp.0, value), (next, [next; 3]));
                                next += 1;
                            }
                            Err(Lost { count }) => next += count,
                        }
                    }
                    assert_eq!(next, TIMES);
                });
            }
        });
    });
}

/// Waits for the next value of a queue.
fn next<const N: usize>(consumer: &mut fifo::Consumer<'_, [u32; N]>) -> [u32; N] {
    loop {
        match consumer.receive().unwrap() {
            Some(value) => return value,
            None => thread::yield_now(),
        }
    }
}

#[test]
fn fifo_values_arrive_once_and_in_order() {
    with_words(fifo::words(SHAPE), |words| {
        thread::scope(|scope| {
            scope.spawn(|| {
                let mut producer = bare::fifo_producer(words, SHAPE).unwrap();
                for k in 0..TIMES {
                    while producer.send(&[k; 3]).is_err() {
                        thread::yield_now();
                    }
                }
            });
            let mut consumer = bare::fifo_consumer(words, SHAPE).unwrap();
            for k in 0..TIMES {
                assert_eq!(next(&mut consumer), [k; 3]);
            }
        });
    });
}

const BLOCKS: Region<Plain<23, 2>> = Region::first("blocks");

/// Each block is written and read as a plain slice, at the same address: nothing is copied. Under
/// Miri an access that is not ordered after those of the other thread ends the test.
#[test]
fn blocks_change_hands_in_place() {
    with_words(BLOCKS.end().total_words(), |words| {
        let map = Map::format(words, BLOCKS.end()).unwrap();
        // SAFETY: only the two ends below access the region, and no end has a successor.
        let map = unsafe { PlainMap::new(map) };
        let [to, from] = [0, 1].map(|core| Incarnation::new(core, 1).unwrap());
        let early = BLOCKS.producer(&map, to).map(drop);
        assert_eq!(
            early,
            Err(EndError::NotAlive(to)),
            "another core could take its end"
        );
        for incarnation in [to, from] {
            map.incarnations().announce(incarnation).unwrap();
        }
        let mut producer = BLOCKS.producer(&map, to).unwrap();
        assert!(BLOCKS.producer(&map, to).is_err(), "there is one producer");
        let mut consumer = BLOCKS.consumer(&map, from).unwrap();
        let loan = producer.loan().unwrap();
        let shown = format!("{map:?} {loan:?} {consumer:?}");
        assert_eq!(shown, "PlainMap { .. } Loan { .. } Consumer { .. }");
        assert!(
            BLOCKS.consumer(&map, from).is_err(),
            "there is one consumer"
        );
        thread::scope(|scope| {
            let written = scope.spawn(move || {
                let mut written = Vec::new();
                for k in 0..TIMES {
                    let mut loan = loop {
                        match producer.loan() {
                            Ok(loan) => break loan,
                            Err(fifo::Full) => thread::yield_now(),
                        }
                    };
                    loan.bytes_mut().fill(k as u8);
                    written.push(loan.bytes_mut().as_ptr().addr());
                    loan.send();
                }
                written
            });
            let mut read = Vec::new();
            while read.len() < TIMES as usize {
                let Some(item) = consumer.item() else {
                    thread::yield_now();
                    continue;
                };
                assert_eq!(item.bytes(), &[read.len() as u8; 23]);
                assert_eq!(item.bytes(), &[read.len() as u8; 23], "it does not change");
                read.push(item.bytes().as_ptr().addr());
                item.release();
            }
            assert_eq!(written.join().unwrap(), read);
            let lmu = words.as_ptr_range();
            let inside = |addr| (lmu.start.addr()..lmu.end.addr()).contains(&addr);
            assert!(read.into_iter().all(inside));
        });
    });
}

/// T-SYNC-3: a receiver that sleeps as often as it can handles every signal.
#[test]
fn signals_wake_a_sleeping_receiver() {
    with_words(mailbox::WORDS, |words| {
        thread::scope(|scope| {
            let receiving = scope.spawn(|| {
                let mut receiver = bare::mailbox_receiver(words).unwrap();
                let mut handled = 0;
                while handled < TIMES {
                    handled += receiver.poll(|open| assert_eq!(open.task.index(), 7));
                    if handled < TIMES && receiver.prepare_sleep() {
                        thread::park();
                        receiver.awake();
                    }
                }
            });
            let mut sender = bare::mailbox_sender(words).unwrap();
            for _ in 0..TIMES {
                if sender.signal(TaskId::new(7).unwrap()) == Ring::Needed {
                    receiving.thread().unpark();
                }
            }
        });
    });
}

/// T-LOCK-1, T-SHM-3: two cores hand words of the pool to each other, and increment a counter under
/// the lock.
#[test]
fn words_go_round_and_the_lock_guards_a_counter() {
    const BLOCKS: usize = 3;
    const POOL_AT: usize = Incarnations::WORDS + lock::WORDS;
    const QUEUES_AT: usize = POOL_AT + pool::words(BLOCKS);
    const HANDLES: Shape = Shape::new(8, 2);
    const QUEUE_WORDS: usize = fifo::words(HANDLES);
    const WORDS: usize = QUEUES_AT + 2 * QUEUE_WORDS + LINE_WORDS;
    with_words(WORDS, |words| {
        let incarnations = Incarnations::attach(words).unwrap();
        let identities = [0, 1].map(|core| Incarnation::new(core, 1).unwrap());
        for incarnation in identities {
            incarnations.announce(incarnation).unwrap();
        }
        let queue = |from: usize| &words[QUEUES_AT + from * QUEUE_WORDS..];
        let counter = &words[WORDS - 1];
        let core = |incarnation: Incarnation| {
            let other = 1 - incarnation.core();
            let mut lock =
                bare::lock(&words[Incarnations::WORDS..], incarnation, incarnations).unwrap();
            let pool = bare::pool(&words[POOL_AT..], BLOCKS, incarnation, incarnations).unwrap();
            let mut to = bare::fifo_producer(queue(incarnation.core()), HANDLES).unwrap();
            let mut from = bare::fifo_consumer(queue(other), HANDLES).unwrap();
            let handle = pool.get(2).unwrap();
            pool.hand_over(handle, other).unwrap();
            to.send(&handle.to_words()).unwrap();
            for k in 0..TIMES {
                let sent = next(&mut from);
                let handle = Handle::from_words(sent);
                let words = pool.open(handle).unwrap();
                let seen = [0, 1].map(|i| words[i].load(Ordering::Relaxed));
                assert_eq!(seen, [k; 2], "what the other core wrote");
                words
                    .iter()
                    .for_each(|word| word.store(k + 1, Ordering::Relaxed));
                pool.hand_over(handle, other).unwrap();
                to.send(&sent).unwrap();
                let guard = lock.lock(u32::MAX, |pause| {
                    spin(pause);
                    thread::yield_now();
                });
                assert!(!guard.as_ref().unwrap().is_recovered());
                counter.store(counter.load(Ordering::Relaxed) + 1, Ordering::Relaxed);
            }
        };
        thread::scope(|scope| {
            for incarnation in identities {
                scope.spawn(move || core(incarnation));
            }
        });
        assert_eq!(counter.load(Ordering::Relaxed), 2 * TIMES);
    });
}
