//! Queues, semaphores, mutexes, sets, timers: the checks of FreeRTOS's standard demos, in virtual
//! time. T-RTOS-1
#![allow(clippy::expect_used, reason = "a test may")]

mod fixture;

use fixture::setup::Fill as _;
use fixture::{Log, run};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;
use tandem_rtos::host::raise;
use tandem_rtos::{
    AddError, Interrupt, Mutex, Queue, QueueFull, QueueSet, Semaphore, SemaphoreFull, TickSource,
    Ticks, TimedOut, Timer,
};

/// T-RTOS-1: a queue keeps the order, blocks a sender while it is full and a receiver while it is
/// empty, and returns a value to its sender if there is no room in time.
#[test]
fn a_queue_passes_values_in_order_and_blocks() {
    let log = Log::new();
    run(TickSource::Virtual, |kernel| {
        let queue = Queue::new(kernel, 2);
        assert_eq!(queue.try_send(kernel, Box::new(0)), Ok(()));
        let (ours, noted) = (queue.clone(), log.clone());
        kernel.task("sender", 3, move |ctx| {
            ours.send(ctx, Box::new(1), Ticks::FOREVER)
                .expect("there is room");
            let refused = ours.send(ctx, Box::new(9), Ticks(5));
            noted.note((refused.map_err(|QueueFull(value)| *value), ctx.now().0));
            for value in 2..6 {
                ours.send(ctx, Box::new(value), Ticks::FOREVER)
                    .expect("waits");
            }
        });
        let noted = log.clone();
        kernel.task("receiver", 2, move |ctx| {
            ctx.delay(Ticks(10));
            for _ in 0..6 {
                let value = queue.receive(ctx, Ticks::FOREVER).expect("waits");
                noted.note((Ok(()), *value));
            }
            assert_eq!(queue.try_receive(ctx), None);
            let before = ctx.now();
            assert_eq!(queue.receive(ctx, Duration::from_millis(4)), None);
            noted.note((Ok(()), 100 + ctx.now().since(before).0));
            ctx.stop();
        });
    });
    let log = log.take();
    assert!(log.contains(&(Err(9), 5)), "{log:?}");
    let mut values: Vec<u32> = log
        .iter()
        .filter(|it| it.0.is_ok())
        .map(|it| it.1)
        .collect();
    assert_eq!(values.pop(), Some(104));
    assert_eq!(values, [0, 1, 2, 3, 4, 5]);
}

/// A value is dropped once, whether it was received, refused, or left in the queue.
#[test]
fn a_value_in_a_queue_has_one_owner() {
    let counted: Arc<()> = Arc::default();
    let ours = Arc::clone(&counted);
    run(TickSource::Virtual, |kernel| {
        kernel.task("owner", 2, move |ctx| {
            let queue = Queue::new(ctx, 3);
            for _ in 0..3 {
                queue
                    .try_send(ctx, Arc::clone(&ours))
                    .expect("there is room");
            }
            let Err(QueueFull(refused)) = queue.try_send(ctx, Arc::clone(&ours)) else {
                panic!("four values in three places");
            };
            assert_eq!(Arc::strong_count(&ours), 6);
            drop(refused);
            drop(queue.try_receive(ctx));
            assert_eq!(Arc::strong_count(&ours), 4);
            drop(queue);
            assert_eq!(Arc::strong_count(&ours), 2);
            drop(ours);
            ctx.stop();
        });
    });
    assert_eq!(Arc::strong_count(&counted), 1);
}

/// T-RTOS-1: a counting semaphore counts between its limits; a binary one is given by an interrupt.
#[test]
fn semaphores_count_and_wake() {
    let log = Log::new();
    run(TickSource::Virtual, |kernel| {
        let places = Semaphore::counting(kernel, 3, 2);
        let rung = Semaphore::binary(kernel);
        let (ours, noted) = (rung.clone(), log.clone());
        kernel.task("sleeper", 3, move |ctx| {
            ours.take(ctx, Ticks::FOREVER).expect("for ever");
            noted.note("woken");
        });
        let handler = move |ctx: &_| rung.give(ctx).expect("not given yet");
        kernel.on(Interrupt::DOORBELL, handler);
        let noted = log.clone();
        kernel.task("counter", 2, move |ctx| {
            assert!(places.try_take(ctx) && places.try_take(ctx) && !places.try_take(ctx));
            assert_eq!(places.take(ctx, Ticks(3)), Err(TimedOut));
            assert_eq!(ctx.now(), Ticks(3));
            for _ in 0..3 {
                assert_eq!(places.give(ctx), Ok(()));
            }
            assert_eq!(places.give(ctx), Err(SemaphoreFull));
            noted.note("rings");
            raise(Interrupt::DOORBELL);
            noted.note("continues");
            ctx.stop();
        });
    });
    assert_eq!(log.take(), ["rings", "woken", "continues"]);
}

/// T-RTOS-1: the holder of a mutex has the priority of its waiter, so that a task in between cannot
/// delay both.
#[test]
fn a_mutex_lends_the_priority_of_its_waiter() {
    let log = Log::new();
    run(TickSource::Virtual, |kernel| {
        let shared = Mutex::new(kernel, 0);
        let (ours, noted) = (shared.clone(), log.clone());
        kernel.task("low", 1, move |ctx| {
            let mut value = ours.lock(ctx, Ticks::FOREVER).expect("free");
            ctx.burn(Duration::from_millis(10));
            let mut inherited = 0;
            ctx.each_task(|task| {
                if task.name == "low" {
                    inherited = task.priority;
                }
            });
            noted.note(("low holds with priority", u32::from(inherited)));
            *value += 1;
            drop(value);
            noted.note(("low has given", ctx.now().0));
        });
        let noted = log.clone();
        kernel.task("middle", 2, move |ctx| {
            ctx.delay(Ticks(3));
            noted.note(("middle runs", ctx.now().0));
            ctx.burn(Duration::from_millis(50));
            noted.note(("middle ends", ctx.now().0));
        });
        let noted = log.clone();
        kernel.task("high", 3, move |ctx| {
            ctx.delay(Ticks(2));
            let held = shared.lock(ctx, Ticks(1)).map(|value| *value);
            assert_eq!(held, Err(TimedOut));
            let value = shared.lock(ctx, Ticks::FOREVER).expect("for ever");
            noted.note(("high has it", *value));
            drop(value);
            ctx.delay(Ticks(100));
            ctx.stop();
        });
    });
    let log = log.take();
    let place = |what| log.iter().position(|it| it.0 == what).expect("it happened");
    assert!(log.contains(&("low holds with priority", 3)), "{log:?}");
    assert!(log.contains(&("high has it", 1)), "{log:?}");
    assert!(place("high has it") < place("middle ends"), "{log:?}");
    assert!(place("high has it") < place("low has given"), "{log:?}");
}

/// T-RTOS-1: a task waits for several queues and semaphores at once.
#[test]
fn a_set_names_the_member_that_has_something() {
    let log = Log::new();
    run(TickSource::Virtual, |kernel| {
        let set = QueueSet::new(kernel, 4);
        let numbers = Queue::new(kernel, 2);
        let letters = Queue::new(kernel, 1);
        let signal = Semaphore::binary(kernel);
        let a = set.add_queue(kernel, &numbers).expect("fits");
        let b = set.add_queue(kernel, &letters).expect("fits");
        let c = set.add_semaphore(kernel, &signal).expect("fits");
        let too_much = Semaphore::binary(kernel);
        assert_eq!(set.add_semaphore(kernel, &too_much), Err(AddError::SetFull));
        let (to_numbers, to_letters, gives) = (numbers.clone(), letters.clone(), signal.clone());
        let noted = log.clone();
        kernel.task("waits", 3, move |ctx| {
            for _ in 0..4 {
                let member = set.select(ctx, Ticks::FOREVER).expect("for ever");
                if member == a {
                    noted.note(numbers.try_receive(ctx).map(|it: u32| it.to_string()));
                } else if member == b {
                    noted.note(letters.try_receive(ctx).map(|it: char| it.to_string()));
                } else if member == c && signal.try_take(ctx) {
                    noted.note(Some("signal".to_string()));
                }
            }
            assert_eq!(set.select(ctx, Ticks(2)), None);
            ctx.stop();
        });
        kernel.task("gives", 2, move |ctx| {
            to_letters.try_send(ctx, 'x').expect("room");
            to_numbers.try_send(ctx, 1).expect("room");
            gives.give(ctx).expect("free");
            to_numbers.try_send(ctx, 2).expect("room");
        });
    });
    let seen: Vec<String> = log.take().into_iter().flatten().collect();
    assert_eq!(seen, ["x", "1", "signal", "2"]);
}

/// T-RTOS-1: timers expire at their ticks, once or repeatedly, and can be stopped and changed.
#[test]
fn timers_expire_at_their_ticks() {
    let log = Log::new();
    run(TickSource::Virtual, |kernel| {
        let noted = log.clone();
        let once = Timer::new(kernel, Ticks(7), false, move |ctx| {
            noted.note(("once", ctx.now().0))
        });
        let noted = log.clone();
        let again = Timer::new(kernel, Duration::from_millis(5), true, move |ctx| {
            noted.note(("again", ctx.now().0));
        });
        once.start(kernel).expect("room");
        again.start(kernel).expect("room");
        kernel.task("changes", 2, move |ctx| {
            ctx.delay(Ticks(12));
            // After this restart the next expiry is one whole period from here.
            again.start(ctx).expect("room");
            ctx.delay(Ticks(11));
            again.stop(ctx).expect("room");
            ctx.delay(Ticks(20));
            ctx.stop();
        });
    });
    let expected = [
        ("again", 5),
        ("once", 7),
        ("again", 10),
        ("again", 17),
        ("again", 22),
    ];
    assert_eq!(log.take(), expected);
}

/// T-RTOS-1: values that interrupts of another thread put into a queue arrive whole and in order.
#[test]
fn an_interrupts_queue_loses_nothing() {
    const COUNT: u32 = 20_000;
    let sent: &'static AtomicU32 = Box::leak(Box::default());
    let taken: &'static AtomicU32 = Box::leak(Box::default());
    run(TickSource::Wall, |kernel| {
        let queue = Queue::new(kernel, 16);
        let ours = queue.clone();
        let mut next = 0;
        let handler = move |ctx: &_| {
            while next < sent.load(Ordering::Acquire) && ours.try_send(ctx, next).is_ok() {
                next += 1;
            }
        };
        kernel.on(Interrupt::DOORBELL, handler);
        kernel.task("receives", 2, move |ctx| {
            for expected in 0..COUNT {
                let value = loop {
                    // An interrupt that found no room in the queue is raised again.
                    match queue.receive(ctx, Ticks(1)) {
                        Some(value) => break value,
                        None => raise(Interrupt::DOORBELL),
                    }
                };
                assert_eq!(value, expected);
                taken.store(value + 1, Ordering::Relaxed);
            }
            ctx.stop();
        });
        kernel.task("computes", 1, |_| {
            loop {
                std::hint::black_box(std::hint::black_box(1.5f64) * 3.0);
            }
        });
        std::thread::spawn(|| {
            for count in 1..=COUNT {
                sent.store(count, Ordering::Release);
                raise(Interrupt::DOORBELL);
            }
        });
    });
    assert_eq!(taken.load(Ordering::Relaxed), COUNT);
}
