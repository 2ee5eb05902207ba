//! Who runs when: priorities, time slices, yields, the tick. T-RTOS-1, T-RTOS-2
mod common;

use common::{Log, run, task};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::channel;
use std::time::Duration;
use tandem_rtos::{Clock, Interrupt, InterruptPriority, Ticks};

/// T-RTOS-2: a yield in a task is an immediate switch; equals take turns.
#[test]
fn equals_that_yield_take_turns() {
    let log = Log::new();
    run(Clock::Wall, |kernel| {
        for name in ["a", "b"] {
            let log = log.clone();
            kernel
                .spawn(&task(name, 2), move |ctx| {
                    for _ in 0..3 {
                        log.note(name);
                        ctx.yield_now();
                    }
                })
                .expect("it fits");
        }
        kernel
            .spawn(&task("last", 1), |ctx| ctx.stop())
            .expect("it fits");
    });
    assert_eq!(log.take().concat(), "ababab");
}

/// T-RTOS-1, T-RTOS-4: a task that never yields is pre-empted by a more urgent one when its time
/// comes.
#[test]
fn a_task_that_never_yields_is_pre_empted() {
    let log = Log::new();
    let wakes = log.clone();
    run(Clock::Wall, |kernel| {
        kernel
            .spawn(&task("greedy", 1), |_| {
                let mut sum = 0.5f64;
                loop {
                    sum = std::hint::black_box(sum * 1.000_001 + 1.0);
                }
            })
            .expect("it fits");
        kernel
            .spawn(&task("urgent", 2), move |ctx| {
                let mut wake = ctx.now();
                for _ in 0..20 {
                    ctx.delay_until(&mut wake, Duration::from_millis(2));
                    wakes.note(wake);
                }
                ctx.stop();
            })
            .expect("it fits");
    });
    let wakes = log.take();
    assert_eq!(wakes.len(), 20);
    assert!(
        wakes
            .windows(2)
            .all(|pair| pair[1].since(pair[0]) == Ticks(2))
    );
}

/// T-RTOS-1: tasks of the same priority that never yield share the processor tick by tick.
#[test]
fn equals_that_never_yield_share_time() {
    let counts: &'static [AtomicU32; 2] = Box::leak(Box::default());
    run(Clock::Wall, |kernel| {
        for (name, count) in ["a", "b"].into_iter().zip(counts) {
            kernel
                .spawn(&task(name, 1), move |ctx| {
                    let mut last = ctx.now();
                    loop {
                        let now = ctx.now();
                        if now != last {
                            count.fetch_add(1, Ordering::Relaxed);
                            last = now;
                        }
                    }
                })
                .expect("it fits");
        }
        kernel
            .spawn(&task("end", 2), |ctx| {
                ctx.delay(Duration::from_millis(100));
                ctx.stop();
            })
            .expect("it fits");
    });
    let slices = counts.each_ref().map(|count| count.load(Ordering::Relaxed));
    assert!(slices.iter().all(|slices| *slices >= 10), "{slices:?}");
}

/// An interrupt of another thread wakes a task.
#[test]
fn an_interrupt_from_another_thread_wakes_a_task() {
    let log = Log::new();
    let (tell, told) = channel::<()>();
    let ringer = std::thread::spawn(move || {
        while told.recv().is_ok() {
            tandem_rtos::host::raise(Interrupt::DOORBELL);
        }
    });
    let counts = log.clone();
    run(Clock::Wall, |kernel| {
        let sleeper = kernel
            .spawn(&task("sleeper", 3), move |ctx| {
                for _ in 0..1000 {
                    tell.send(()).expect("the ringer listens");
                    counts.note(ctx.take_notifications(Ticks::FOREVER));
                }
                drop(tell);
                ctx.stop();
            })
            .expect("it fits");
        kernel
            .attach(Interrupt::DOORBELL, InterruptPriority::LOWEST, move |ctx| {
                sleeper.notify(ctx).expect("it lives");
            })
            .expect("it is free");
    });
    ringer.join().expect("it ended");
    assert_eq!(log.take(), vec![1; 1000]);
}
