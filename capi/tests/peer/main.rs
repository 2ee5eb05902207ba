//! C and Rust use the same LMU: core 1 is a process in C, linked with the static library.
#![allow(clippy::unwrap_used)]

mod build;
mod lmu;
mod takeover;

use build::peer;
use lmu::{ANSWER_WORDS, Bench, NEWEST, ORDER_WORDS, Order, RING};
use std::process::Command;
use std::time::Duration;
use tandem_shm::incarnation::Incarnation;

/// The header compiles as C99 without a warning, and as C++; sizes and errors are as documented.
#[test]
fn the_header_says_what_the_library_does() {
    build::compiles_as_cpp();
    let status = Command::new(peer()).arg("check").status().unwrap();
    assert!(status.success(), "{status}");
}

#[test]
fn the_example_of_the_docs_hands_over_three_speeds() {
    let speeds = "core 1: 1 m/s, 1000 mm/s\ncore 1: 2 m/s, 2000 mm/s\ncore 1: 3 m/s, 3000 mm/s\n";
    assert_eq!(build::output_of_the_example(), speeds);
}

#[test]
fn orders_and_answers_go_through_mailbox_and_fifo() {
    let mut bench = Bench::new();
    let child = bench.start(1);
    for round in 0..200_u32 {
        let order: [u32; ORDER_WORDS] = core::array::from_fn(|at| match at {
            0 => Order::Echo as u32,
            _ => round.wrapping_mul(0x9E37_79B1) ^ at as u32,
        });
        let answer = bench.ask(&order);
        for at in 1..ORDER_WORDS {
            assert_eq!(answer[at], order[at].wrapping_mul(3).wrapping_add(1));
        }
        assert!(
            answer[ORDER_WORDS..ANSWER_WORDS]
                .iter()
                .all(|&word| word == 0)
        );
    }
    bench.stop(child);
}

/// T-LOCK-1 across the languages: under the lock, both guarded words are always equal.
#[test]
fn c_and_rust_exclude_each_other() {
    const ROUNDS: u32 = 2_000;
    let mut bench = Bench::new();
    let child = bench.start(1);
    bench.send(&[Order::Count as u32, ROUNDS]);
    let mut lock = bench.lock(0, 1);
    for _ in 0..ROUNDS {
        let guard = lock.lock(1_000_000, |_| std::thread::yield_now()).unwrap();
        assert!(!guard.is_recovered());
        let [one, two] = bench.guarded();
        assert_eq!(one, two, "seen in the middle of a change");
        bench.set_guarded([one + 1, two]);
        std::hint::spin_loop();
        bench.set_guarded([one + 1, two + 1]);
        drop(guard);
    }
    bench.answer();
    assert_eq!(bench.guarded(), [2 * ROUNDS; 2]);
    bench.stop(child);
}

#[test]
fn c_dies_with_the_lock_and_rust_is_told() {
    let mut bench = Bench::new();
    let mut child = bench.start(1);
    bench.send(&[Order::DieLocked as u32]);
    assert!(child.wait().success());
    let mut lock = bench.lock(0, 1);
    assert!(
        lock.lock(100, |_| ()).is_err(),
        "its incarnation was not marked dead yet"
    );
    assert!(
        bench
            .map()
            .incarnations()
            .mark_dead(Incarnation::new(1, 1).unwrap())
    );
    let acquired = lock.lock(100, |_| ()).unwrap();
    assert!(acquired.is_recovered());
    assert_eq!(bench.guarded(), [1, 0], "half-changed");
    bench.set_guarded([1, 1]);
    drop(acquired);

    // The order that killed core 1 is still the next one: remove it, so that the successor can run.
    bench.drop_order();
    let child = bench.start(2);
    let answer = bench.ask(&[Order::Echo as u32, 5]);
    assert_eq!(answer[1], 16);
    bench.stop(child);
}

/// C is killed at any time: if no recovery is reported, the next owner finds both words equal.
#[test]
fn c_is_killed_at_any_moment_and_the_lock_tells() {
    let mut bench = Bench::new();
    let mut lock = bench.lock(0, 1);
    for generation in 1..=15 {
        let mut child = bench.start(generation);
        let [before, _] = bench.guarded();
        bench.send(&[Order::Count as u32, 1 << 30]);
        while bench.guarded()[0] == before {
            bench.watch();
        }
        std::thread::sleep(Duration::from_micros(u64::from(generation) * 371 % 1000));
        child.kill();
        let incarnation = Incarnation::new(1, generation).unwrap();
        assert!(bench.map().incarnations().mark_dead(incarnation));
        let taken = lock.lock(1_000, |_| std::thread::yield_now()).unwrap();
        let [one, two] = bench.guarded();
        if taken.is_recovered() {
            assert!(
                one == two || one == two + 1,
                "more than one change: {one}, {two}"
            );
            bench.set_guarded([one, one]);
        } else {
            assert_eq!(one, two, "a lock that was given back guards what is whole");
        }
        drop(taken);
        bench.drop_order();
    }
}

#[test]
fn rust_dies_with_the_lock_and_c_is_told() {
    const RECOVERED: u32 = 1;
    let mut bench = Bench::new();
    let child = bench.start(1);
    assert_eq!(
        bench.ask(&[Order::Recover as u32])[1],
        0,
        "no owner died yet"
    );
    let mut lock = bench.lock(2, 1);
    core::mem::forget(lock.try_lock().unwrap());
    bench.set_guarded([7, 0]);
    assert!(
        bench
            .map()
            .incarnations()
            .mark_dead(Incarnation::new(2, 1).unwrap())
    );
    assert_eq!(bench.ask(&[Order::Recover as u32])[1], RECOVERED);
    assert_eq!(bench.guarded(), [7, 7], "repaired by C");
    bench.stop(child);
}

/// A value that C publishes is never read torn, even while it is being published.
#[test]
fn the_newest_value_of_c_is_whole() {
    const VALUES: u32 = 50_000;
    let mut bench = Bench::new();
    let child = bench.start(1);
    let reader = NEWEST.reader(&bench.map()).unwrap();
    bench.send(&[Order::Publish as u32, VALUES]);
    let (mut seen, mut last) = (0_u32, 0);
    while last < VALUES {
        if let Ok((_, value)) = reader.read() {
            assert!(
                value.iter().all(|&word| word == value[0]),
                "torn: {value:?}"
            );
            assert!(value[0] >= last, "back from {last} to {}", value[0]);
            last = value[0];
            seen += 1;
        }
        bench.watch();
    }
    bench.answer();
    assert!(seen > 0);
    bench.stop(child);
}

#[test]
fn every_broadcast_value_of_c_comes_or_is_counted_as_lost() {
    const VALUES: u32 = 5_000;
    let mut bench = Bench::new();
    let child = bench.start(1);
    let mut receiver = RING.receiver(&bench.map()).unwrap();
    bench.send(&[Order::Broadcast as u32, VALUES]);
    let mut next = 1;
    while next <= VALUES {
        match receiver.receive() {
            Ok(None) => bench.watch(),
            Ok(Some((_, value))) => {
                for (at, word) in value.iter().enumerate() {
                    assert_eq!(*word, next * 7 + at as u32);
                }
                next += 1;
            }
            Err(lost) => next += lost.count,
        }
    }
    assert_eq!(next, VALUES + 1);
    bench.answer();
    bench.stop(child);
}

#[test]
fn words_of_the_pool_are_handed_to_c_and_back() {
    let mut bench = Bench::new();
    let child = bench.start(1);
    // Core 1 must be announced before words can be handed over to it.
    bench.ask(&[Order::Echo as u32]);
    let pool = bench.pool(0, 1);
    let free = pool.free_words();
    for round in 1..=50_u32 {
        let count = (round as usize * 5) % 37 + 1;
        let ours = pool.get(count).unwrap();
        for (at, word) in pool.open(ours).unwrap().iter().enumerate() {
            word.store(
                round * 100 + at as u32,
                core::sync::atomic::Ordering::Relaxed,
            );
        }
        pool.hand_over(ours, 1).unwrap();
        let [first, second] = ours.to_words();
        let answer = bench.ask(&[Order::PoolSwap as u32, first, second]);
        let theirs = tandem_shm::pool::Handle::from_words([answer[1], answer[2]]);
        let words = pool.open(theirs).unwrap();
        assert_eq!(words.len(), count);
        for (at, word) in words.iter().rev().enumerate() {
            let word = word.load(core::sync::atomic::Ordering::Relaxed);
            assert_eq!(word, round * 100 + at as u32);
        }
        pool.give_back(theirs).unwrap();
        assert_eq!(pool.free_words(), free, "nothing leaks");
    }
    bench.stop(child);
}
