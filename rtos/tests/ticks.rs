//! When ticks are due, and how a task moves them. T-RTOS-1, S-5
#![allow(clippy::expect_used, reason = "a test may")]

mod fixture;

use chacha20::ChaCha8Rng;
use fixture::setup::{Fill as _, Ringer};
use fixture::{Log, run};
use rand::{RngExt, SeedableRng};
use std::time::Duration;
use tandem_rtos::host::{elapsed_ns, now_ns};
use tandem_rtos::{Interrupt, LONGEST_SHIFT_NS, TaskContext, TickSource, TickTime, Ticks};

const TICK_NS: i64 = 1_000_000;

/// Returns how much later `to` was due than a tick that follows `from` without a move, ns.
fn moved_ns(from: TickTime, to: TickTime) -> i64 {
    to.due_ns as i64 - from.due_ns as i64 - i64::from(to.count.since(from.count).0) * TICK_NS
}

/// Count and time of a tick belong together. If an interrupt could come between the two, a task
/// that waits on absolute time would keep an error of a tick.
#[test]
fn a_tick_has_the_same_time_in_every_task() {
    let log = Log::new();
    let ours = log.clone();
    run(TickSource::Wall, |kernel| {
        for name in ["a", "b"] {
            let log = ours.clone();
            let body = move |ctx: &TaskContext| {
                let first = ctx.last_tick();
                let mut last = first;
                while last.count < Ticks(100) {
                    last = ctx.last_tick();
                    assert_eq!(moved_ns(first, last), 0, "{first:?} {last:?}");
                }
                assert!(now_ns() >= last.due_ns, "{last:?} was before its time");
                log.note(last.due_ns - u64::from(last.count.0) * TICK_NS as u64);
            };
            kernel.task(name, 1, body);
        }
    });
    let origins = log.take();
    assert_eq!(origins[0], origins[1]);
}

/// Moves ticks at random for `rounds` ticks and checks the time of each. `now_ns` reads the clock
/// that drives the ticks. Returns how many moves were made and how many were refused.
fn move_at_random(ctx: &TaskContext, rounds: u32, now_ns: fn() -> u64) -> [u32; 2] {
    let mut random = ChaCha8Rng::seed_from_u64(28);
    let mut moves = [0; 2];
    let (mut before, mut moved_by) = (ctx.last_tick(), 0);
    for _ in 0..rounds {
        ctx.delay(Ticks(1));
        let (woken, at_ns) = (ctx.last_tick(), now_ns());
        assert!(woken.count > before.count, "{before:?} {woken:?}");
        assert_eq!(
            moved_ns(before, woken),
            i64::from(moved_by),
            "{before:?} {woken:?}"
        );
        assert!(at_ns >= woken.due_ns, "{woken:?} was before its time");
        // Every fourth move is near the next tick, or after it.
        let work_us = random.random_range(0..1_100) * u64::from(random.random_ratio(1, 4));
        ctx.burn(Duration::from_micros(work_us));
        let by_ns = random.random_range(-2 * LONGEST_SHIFT_NS..2 * LONGEST_SHIFT_NS);
        let (last, is_moved, again) = ctx.critical(|| {
            let last = ctx.last_tick();
            (last, ctx.shift_ticks(by_ns), ctx.shift_ticks(by_ns))
        });
        assert_eq!(moved_ns(woken, last), 0, "{woken:?} {last:?}");
        assert!(!again || by_ns == 0, "a tick was moved twice");
        before = last;
        moved_by = if is_moved {
            by_ns.clamp(-LONGEST_SHIFT_NS, LONGEST_SHIFT_NS)
        } else {
            0
        };
        moves[usize::from(!is_moved)] += 1;
    }
    moves
}

fn moves_on(clock: TickSource, rounds: u32, now_ns: fn() -> u64) -> [u32; 2] {
    let log = Log::new();
    let noted = log.clone();
    run(clock, |kernel| {
        kernel.task("moves ticks", 3, move |ctx| {
            noted.note(move_at_random(ctx, rounds, now_ns));
            ctx.stop();
        });
        // A tick interrupts this task, and the doorbell's handler both.
        kernel.task("works", 1, |ctx| {
            loop {
                ctx.burn(Duration::from_micros(100));
            }
        });
        kernel.on(Interrupt::DOORBELL, |_| ());
    });
    log.take().concat().try_into().expect("it has ended once")
}

/// S-5: ticks follow the moves to the nanosecond: none is lost, doubled or out of order, and no
/// error adds up over 5,000 of them.
#[test]
fn moved_ticks_are_exact_in_virtual_time() {
    let [made, refused] = moves_on(TickSource::Virtual, 5_000, elapsed_ns);
    assert!(made > 4_000 && refused > 100, "{made} {refused}");
}

/// S-5: the same on the machine's clock, while another thread interrupts. A tick may be late there.
#[test]
fn moved_ticks_are_exact_on_the_clock() {
    let ringer = Ringer::every(Duration::from_micros(37));
    let [made, refused] = moves_on(TickSource::Wall, 1_000, now_ns);
    drop(ringer);
    assert!(made > 0 && refused > 0, "{made} {refused}");
}

/// S-5: both timers expire when the moved ticks are due. The ticks move 500 µs later and then 500
/// µs earlier than at the start, by 100 µs at every third tick. If a timer kept its time, its ticks
/// would be late by at least 100 µs, but for those after a stall of the machine. One of ten must be
/// less late, of the first, the second and the third ticks after a move. Most are late by a tenth
/// of that, on a busy machine fewer.
#[test]
fn the_timers_follow_moved_ticks() {
    const STEP: i32 = LONGEST_SHIFT_NS;
    let log = Log::new();
    let noted = log.clone();
    run(TickSource::Wall, |kernel| {
        kernel.task("moves ticks", 3, move |ctx| {
            let (first, mut step) = (ctx.last_tick(), STEP);
            for _ in 0..600 {
                ctx.delay(Ticks(1));
                let (last, at_ns) = (ctx.last_tick(), now_ns());
                let moved = moved_ns(first, last);
                if moved != 0 {
                    let late_ns = at_ns.saturating_sub(last.due_ns);
                    noted.note((last.count.0 % 3, late_ns < STEP as u64));
                }
                if last.count.0 % 3 != 0 {
                    continue;
                }
                if moved.abs() >= i64::from(5 * STEP) {
                    step = if moved > 0 { -STEP } else { STEP };
                }
                // Refused if the machine was late.
                let _is_moved = ctx.shift_ticks(step);
            }
            ctx.stop();
        });
    });
    let ticks = log.take();
    for after in 0..3 {
        let own = ticks.iter().filter(|(it, _)| *it == after);
        let (all, in_time) = own.fold((0, 0), |sum, it| (sum.0 + 1, sum.1 + u32::from(it.1)));
        assert!(in_time * 10 > all, "{in_time} of {all} in time, {after}");
    }
}

/// A tick that is due, or nearly, is not moved; nor is one moved twice, or by more than the limit.
#[test]
fn a_near_tick_is_not_moved() {
    run(TickSource::Virtual, |kernel| {
        kernel.task("moves ticks", 1, |ctx| {
            ctx.delay(Ticks(3));
            let until = |us| {
                ctx.burn(Duration::from_micros(us) - Duration::from_nanos(elapsed_ns()));
            };
            until(3_851);
            assert!(!ctx.shift_ticks(-100_000));
            assert!(ctx.shift_ticks(-99_000), "the tick is then 50 µs away");
            assert!(!ctx.shift_ticks(1));
            ctx.delay(Ticks(1));
            assert_eq!(ctx.last_tick(), tick(4, 3_901));
            assert!(ctx.shift_ticks(i32::MAX));
            ctx.delay(Ticks(1));
            assert_eq!(ctx.last_tick(), tick(5, 5_001));
            until(5_952);
            assert!(!ctx.shift_ticks(0), "the tick is less than 50 µs away");
            ctx.critical(|| {
                until(8_500);
                assert_eq!(ctx.last_tick(), tick(5, 5_001), "not served yet");
                assert!(!ctx.shift_ticks(100_000));
            });
            assert_eq!((ctx.last_tick(), elapsed_ns()), (tick(8, 8_001), 8_500_000));
            assert!(ctx.shift_ticks(i32::MIN));
            ctx.delay(Ticks(2));
            assert_eq!(
                (ctx.last_tick(), elapsed_ns()),
                (tick(10, 9_901), 9_901_000)
            );
            ctx.stop();
        });
    });
}

fn tick(count: u32, due_us: u64) -> TickTime {
    let (count, due_ns) = (Ticks(count), due_us * 1_000);
    TickTime { count, due_ns }
}
