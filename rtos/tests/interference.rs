//! A switch or an interrupt at any moment must not disturb the creation of tasks, `errno`, or the C
//! library's own allocations. T-RTOS-1
#![allow(clippy::expect_used, reason = "a test may")]

mod fixture;

use fixture::setup::{Fill as _, Ringer, options};
use fixture::{run, run_for};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};
use tandem_rtos::host::{deferred, raise};
use tandem_rtos::{Interrupt, InterruptContext, TaskContext, TaskError, TickSource, Ticks};

/// T-RTOS-1: a list of all tasks never shows an incomplete task. The stack of a new task is filled,
/// which takes long enough for several ticks.
#[test]
fn a_task_is_seen_when_it_is_made() {
    let nameless = Arc::new(AtomicU32::new(0));
    let seen = Arc::new(AtomicU32::new(0));
    let (ours, noted) = (nameless.clone(), seen.clone());
    run(TickSource::Wall, |kernel| {
        let look = move |ctx: &TaskContext| {
            loop {
                ctx.each_task(|it| match it.name {
                    "new" => _ = noted.fetch_add(1, Ordering::Relaxed),
                    "" => _ = ours.fetch_add(1, Ordering::Relaxed),
                    _ => {}
                });
                ctx.delay(Ticks(1));
            }
        };
        kernel.task("look", 5, look);
        let make = |ctx: &TaskContext| {
            for _ in 0..5 {
                let options = options("new", 3).stack_bytes(16 << 20);
                let new = ctx.spawn(&options, |ctx| ctx.delay(Ticks(2)));
                let new = new.expect("there is memory");
                while new.is_alive() {
                    ctx.delay(Ticks(1));
                }
                assert_eq!(new.notify(ctx), Err(TaskError::Ended));
            }
            ctx.stop();
        };
        kernel.task("make", 2, make);
    });
    assert!(seen.load(Ordering::Relaxed) > 0, "no list was made in time");
    assert_eq!(nameless.load(Ordering::Relaxed), 0, "a half-made task");
}

/// The tasks run with the real-time priority of the thread that starts the kernel, even if new
/// threads do not inherit it (SCHED_RESET_ON_FORK). Needs permission for real-time scheduling.
#[test]
fn tasks_have_the_priority_of_the_starting_thread() {
    static FOUND: AtomicU32 = AtomicU32::new(0);
    let policy = libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK;
    // Uses a separate thread, so that the changed priority ends with that thread.
    let starts = std::thread::spawn(move || {
        let param = libc::sched_param { sched_priority: 3 };
        // SAFETY: 0 is the calling thread; the variable is read during the call.
        if unsafe { libc::sched_setscheduler(0, policy, &raw const param) } != 0 {
            let refused = std::io::Error::last_os_error();
            return eprintln!("not tested without the permission for real time: {refused}");
        }
        run(TickSource::Wall, |kernel| {
            let look = |_: &TaskContext| {
                let mut param = libc::sched_param { sched_priority: 0 };
                // SAFETY: 0 is the calling thread; the variable is written during the call.
                let policy = unsafe {
                    libc::sched_getparam(0, &raw mut param);
                    libc::sched_getscheduler(0)
                };
                let found = policy as u32 | (param.sched_priority as u32) << 16;
                FOUND.store(found, Ordering::Relaxed);
            };
            kernel.task("look", 2, look);
        });
        assert_eq!(FOUND.load(Ordering::Relaxed), policy as u32 | 3 << 16);
    });
    starts.join().expect("it is so");
}

/// T-RTOS-1: a switch at the end of a critical section (an allocation is one) does not change
/// `errno`.
#[test]
fn a_task_keeps_its_errno() {
    static WRONG: AtomicU32 = AtomicU32::new(0);
    let errno = || std::io::Error::last_os_error().raw_os_error();
    run(TickSource::Virtual, |kernel| {
        let spoil = |ctx: &TaskContext| {
            for _ in 0..2 {
                ctx.take_notifications(Ticks::FOREVER);
                // SAFETY: there is no such descriptor.
                unsafe { libc::close(-1) };
            }
        };
        let spoiler = kernel.task("spoil", 3, spoil);
        let other = spoiler.clone();
        let wake = move |ctx: &InterruptContext| spoiler.notify(ctx).expect("it lives");
        kernel.on(Interrupt::DOORBELL, wake);
        let check = move |ctx: &TaskContext| {
            // SAFETY: the path ends with a zero; no such file exists.
            unsafe { libc::open(c"/nonexistent/x".as_ptr(), 0) };
            ctx.critical(|| raise(Interrupt::DOORBELL));
            let at_unmask = errno() != Some(libc::ENOENT);
            // SAFETY: as above.
            unsafe { libc::open(c"/nonexistent/x".as_ptr(), 0) };
            deferred(|| other.notify(ctx).expect("it lives"));
            let at_yield = errno() != Some(libc::ENOENT);
            WRONG.store(
                u32::from(at_unmask) + u32::from(at_yield),
                Ordering::Relaxed,
            );
        };
        kernel.task("check", 2, check);
    });
    assert_eq!(WRONG.load(Ordering::Relaxed), 0);
}

/// T-RTOS-1: the C library allocates without Rust's allocator (here in `opendir`), under a lock. If
/// a task is pre-empted there, another task can still allocate.
#[test]
#[cfg(target_env = "gnu")]
fn tasks_share_the_c_librarys_allocator() {
    let _ringer = Ringer::every(Duration::from_micros(5));
    run_for(Duration::from_secs(30), TickSource::Wall, |kernel| {
        let read = |_: &TaskContext| {
            loop {
                std::hint::black_box(std::fs::read_dir("/proc/self/task").is_ok());
            }
        };
        kernel.task("read", 2, read);
        let allocate = |ctx: &TaskContext| {
            let begin = Instant::now();
            let mut kept = Vec::new();
            let mut bytes = 24;
            while begin.elapsed() < Duration::from_secs(2) {
                ctx.take_notifications(Ticks(5));
                bytes = (bytes + 7919) % 33_000;
                kept.push(vec![1u8; bytes]);
                if kept.len() > 20 {
                    kept.swap_remove(bytes % 20);
                }
            }
            ctx.stop();
        };
        let allocator = kernel.task("allocate", 3, allocate);
        let wake = move |ctx: &InterruptContext| allocator.notify(ctx).expect("it lives");
        kernel.on(Interrupt::DOORBELL, wake);
    });
}

/// T-RTOS-1: an unwinding panic ends a critical section.
#[test]
fn an_unwound_critical_section_has_ended() {
    static CAUGHT: AtomicBool = AtomicBool::new(false);
    run(TickSource::Virtual, |kernel| {
        let unwind = |ctx: &TaskContext| {
            let within = AssertUnwindSafe(|| ctx.critical(|| resume_unwind(Box::new(()))));
            let caught = catch_unwind(within).is_err();
            ctx.delay(Ticks(1));
            CAUGHT.store(caught, Ordering::Relaxed);
        };
        kernel.task("unwind", 2, unwind);
    });
    assert!(CAUGHT.load(Ordering::Relaxed));
}
