//! Tests of the queue in one thread, with a producer and a consumer that stop at any step.

mod interleavings;

use super::*;
use crate::fault::{freeze_at, kill_at, zeroed};
use std::vec::Vec;

/// As in a region: the compiler knows the number of slots. They are in one line.
const SLOTS: usize = 4;
const SHAPE: Shape = Shape::new(SLOTS, 2);

type Value = [u32; 2];

fn queue() -> (
    &'static [AtomicU32],
    Producer<'static, Value, SLOTS>,
    Consumer<'static, Value, SLOTS>,
) {
    let words = zeroed(words(SHAPE));
    (
        words,
        Producer::<_, SLOTS>::attach(words, SHAPE).unwrap(),
        Consumer::<_, SLOTS>::attach(words, SHAPE).unwrap(),
    )
}

fn drain(consumer: &mut Consumer<'_, Value, SLOTS>) -> Vec<Value> {
    core::iter::from_fn(|| consumer.receive().unwrap()).collect()
}

#[test]
fn values_arrive_in_order_and_a_full_queue_refuses_more() {
    let (_, mut producer, mut consumer) = queue();
    assert!(consumer.item().is_none());
    for round in 0..5 {
        for k in 0..4 {
            producer.send(&[round, k]).unwrap();
        }
        assert_eq!(producer.send(&[9, 9]), Err(Full));
        let expected: Vec<_> = (0..4).map(|k| [round, k]).collect();
        assert_eq!(drain(&mut consumer), expected);
    }
}

#[test]
fn a_slot_is_lent_until_it_is_sent_and_received_until_it_is_released() {
    let (_, mut producer, mut consumer) = queue();
    let mut loan = producer.loan().unwrap();
    loan.words().set(0, 1);
    drop(loan);
    assert!(consumer.item().is_none());
    assert_eq!(producer.sent(), 0);
    let mut loan = producer.loan().unwrap();
    loan.words().set(0, 3);
    loan.send();
    assert_eq!(producer.sent(), 1);
    assert_eq!(consumer.item().unwrap().words().get(0), 3);
    let item = consumer.item().unwrap();
    assert_eq!(item.words().iter().collect::<Vec<_>>(), [3, 0]);
    item.release();
    assert!(consumer.item().is_none());
}

#[test]
fn numbers_wrap_around() {
    let (words, ..) = queue();
    words[RELEASED_AT].store(u32::MAX - 1, Ordering::Relaxed);
    let mut producer = Producer::<_, SLOTS>::attach(words, SHAPE).unwrap();
    let mut consumer = Consumer::<_, SLOTS>::attach(words, SHAPE).unwrap();
    (0..4).for_each(|k| producer.send(&[k, k]).unwrap());
    assert_eq!(producer.send(&[4, 4]), Err(Full));
    assert_eq!(drain(&mut consumer), [[0, 0], [1, 1], [2, 2], [3, 3]]);
}

#[test]
fn a_producer_killed_at_every_step_has_sent_whole_values_or_nothing() {
    for at in 0.. {
        let (words, mut producer, mut consumer) = queue();
        producer.send(&[0, 0]).unwrap();
        let done = kill_at(at, || producer.send(&[1, 1])).is_some();
        Producer::<_, SLOTS>::attach(words, SHAPE)
            .unwrap()
            .send(&[2, 2])
            .unwrap();
        let seen = drain(&mut consumer);
        assert!(
            seen == [[0, 0], [2, 2]] && !done || seen == [[0, 0], [1, 1], [2, 2]],
            "killed at {at}: {seen:?}"
        );
        if done {
            break;
        }
    }
}

#[test]
fn a_consumer_killed_at_every_step_leaves_the_values_that_it_has_not_released() {
    for at in 0.. {
        let (words, mut producer, mut consumer) = queue();
        (0..3).for_each(|k| producer.send(&[k, k]).unwrap());
        let mut seen = Vec::new();
        let done = kill_at(at, || {
            while let Some(item) = consumer.item() {
                seen.push(item.words().get(0));
                item.release();
            }
        });
        let rest = drain(&mut Consumer::<_, SLOTS>::attach(words, SHAPE).unwrap());
        seen.extend(rest.iter().map(|value| value[0]));
        seen.dedup();
        assert_eq!(seen, [0, 1, 2], "killed at {at}");
        if done.is_some() {
            break;
        }
    }
}

/// All slots are used: after each release the producer can send one more value.
#[test]
fn a_full_queue_takes_a_value_for_each_that_is_released() {
    let (_, mut producer, mut consumer) = queue();
    (0..4).for_each(|k| producer.send(&[k, k]).unwrap());
    for k in 4..20 {
        assert_eq!(producer.send(&[k, k]), Err(Full));
        assert_eq!(consumer.receive(), Ok(Some([k - 4, k - 4])));
        assert_eq!(producer.send(&[k, k]), Ok(()));
    }
}

/// Each value is received at least once, even if releases are published in groups.
#[test]
fn a_large_queue_publishes_releases_in_groups() {
    let shape = Shape::new(64, 1);
    let words = zeroed(words(shape));
    let mut producer = Producer::<_, 64>::attach(words, shape).unwrap();
    let mut consumer = Consumer::<_, 64>::attach(words, shape).unwrap();
    (0..64).for_each(|k| producer.send(&[k]).unwrap());
    for k in 0..7 {
        assert_eq!(consumer.item().unwrap().words().get(0), k);
        consumer.item().unwrap().release();
        assert_eq!(producer.send(&[64]), Err(Full));
    }
    let mut successor = Consumer::<'_, [u32; 1], 64>::attach(words, shape).unwrap();
    assert_eq!(successor.item().unwrap().words().get(0), 0, "again");
    consumer.item().unwrap().release();
    (64..72).for_each(|k| producer.send(&[k]).unwrap());
    assert_eq!(producer.send(&[72]), Err(Full));
    for k in 8..72 {
        assert_eq!(consumer.receive(), Ok(Some([k])));
    }
    for k in 72..75 {
        producer.send(&[k]).unwrap();
        assert!(matches!(consumer.receive(), Ok(Some(_))));
    }
    assert!(consumer.item().is_none(), "and publishes that all are free");
    (0..64).for_each(|k| producer.send(&[k]).unwrap());
}

/// After garbage in one word, in all words, or in all slots, the consumer gets at most five values
/// at once, and later values arrive in order again.
#[cfg_attr(miri, ignore = "too long; one thread, no unsafe code")]
#[test]
fn scribbled_words_are_repaired() {
    let all = words(SHAPE);
    for scribble in [0, 1, 4, 5, 7, 12345, u32::MAX - 2, u32::MAX, 1 << 31] {
        for at in (0..all).map(|at| at..at + 1).chain([0..all, 16..all]) {
            for successor in [false, true] {
                let (words, mut producer, mut consumer) = queue();
                (0..3).for_each(|k| producer.send(&[k, k]).unwrap());
                drain(&mut consumer);
                producer.send(&[1, 1]).unwrap();
                for word in &words[at.clone()] {
                    word.store(scribble, Ordering::Relaxed);
                }
                if successor {
                    producer = Producer::<_, SLOTS>::attach(words, SHAPE).unwrap();
                }
                for k in 0..64 * LOOKS_PER_DOUBT {
                    let _ = producer.send(&[k, k]);
                    assert!(drain(&mut consumer).len() <= 5);
                }
                (7..9).for_each(|k| producer.send(&[k, k]).unwrap());
                let values = drain(&mut consumer);
                assert_eq!(values, [[7, 7], [8, 8]], "{scribble} at {at:?} {successor}");
            }
        }
    }
}

/// If a missing stamp is restored before the consumer's search for the next value ends, the
/// consumer receives that value and does not skip it.
#[test]
fn a_value_that_is_restored_during_the_search_is_not_skipped() {
    for at in 0.. {
        let (words, mut producer, mut consumer) = queue();
        (0..4).for_each(|k| producer.send(&[k, k]).unwrap());
        words[SLOTS_AT + 2].store(0, Ordering::Relaxed);
        let restore = move || assert_eq!(producer.send(&[4, 4]), Err(Full));
        let (_, hit) = freeze_at(at, restore, || {
            (0..LOOKS_PER_DOUBT).find(|_| consumer.item().is_some())
        });
        let first = drain(&mut consumer)[0];
        if !hit {
            assert_eq!(first, [1, 1], "the search was over");
            break;
        }
        assert_eq!(first, [0, 0], "restored before access {at}");
    }
}

#[cfg_attr(miri, ignore = "too long; one thread, no unsafe code")]
#[test]
fn successors_that_attach_to_scribbled_words_make_the_queue_whole() {
    for (released, stamp) in [(77, 7777), (7777, 77), (u32::MAX, 3)] {
        let (words, ..) = queue();
        words[RELEASED_AT].store(released, Ordering::Relaxed);
        words[SLOTS_AT + 2].store(stamp, Ordering::Relaxed);
        let mut producer = Producer::<_, SLOTS>::attach(words, SHAPE).unwrap();
        words[RELEASED_AT].store(5, Ordering::Relaxed);
        let mut consumer = Consumer::<_, SLOTS>::attach(words, SHAPE).unwrap();
        for _ in 0..64 * LOOKS_PER_DOUBT {
            let _ = producer.send(&[1, 1]);
            drain(&mut consumer);
        }
        producer.send(&[2, 2]).unwrap();
        assert_eq!(drain(&mut consumer), [[2, 2]]);
    }
}
