//! Runs one suite of FreeRTOS's standard demo tasks, which `suite.c` starts and checks.
//!
//! Linked by `main.rs` with a kernel that has what the demos need. Virtual time passes while all
//! tasks wait, as always. Here it also passes while a task computes: by one tick for each
//! [`CPU_PER_TICK`] of the kernel's thread. So a stall of the machine is no time.
#![allow(clippy::expect_used, reason = "all of it is a test")]

use std::alloc::System;
use std::mem::MaybeUninit;
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;
use std::time::Duration;
use tandem_rtos::host::{self, TaskAllocator, deferred, elapsed_ns};
use tandem_rtos::{Interrupt, InterruptPriority, Kernel, Priority, TaskOptions, TickSource, Ticks};

#[global_allocator]
static ALLOCATOR: TaskAllocator<System> = TaskAllocator::new(System);

/// CPU time of the kernel's thread that is one tick, if no task waits.
const CPU_PER_TICK: Duration = Duration::from_micros(250);
/// How often the suite is asked whether it works, and how many times. 20 s in all.
const CHECK_EVERY: Ticks = Ticks::from_millis(5_000);
const CHECKS: u32 = 4;
/// The watchdogs: CPU time without a tick, and the time of a program that sleeps for ever. A suite
/// takes seconds.
const LIMIT: Duration = Duration::from_secs(10);
const WALL_LIMIT: Duration = Duration::from_secs(600);
/// The check, and the task by which time passes, are above the tasks of the suite.
const ABOVE: Priority = Priority::HIGHEST;

static PASSED: AtomicU32 = AtomicU32::new(0);

unsafe extern "C" {
    safe fn suite_start();
    safe fn suite_is_running() -> isize;
    safe fn suite_first();
    safe fn suite_second();
}

/// Raises an interrupt of the core, for the suite's hook in the tick.
#[unsafe(no_mangle)]
extern "C" fn suite_raise(number: u8) {
    host::raise(Interrupt::new(number));
}

/// Returns the CPU time that this clock has measured.
fn cpu_time(clock: libc::clockid_t) -> Duration {
    let mut time = MaybeUninit::<libc::timespec>::uninit();
    // SAFETY: the clock is that of the kernel's thread, which never ends. The time is written to a
    // valid variable.
    let time = unsafe {
        assert_eq!(libc::clock_gettime(clock, time.as_mut_ptr()), 0);
        time.assume_init()
    };
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}

/// Lets time pass while the kernel's thread, which has this clock, computes: rings after
/// [`CPU_PER_TICK`] without a tick.
fn watch(kernel: libc::pthread_t, clock: libc::clockid_t) {
    let (mut ticked, mut rung, mut last) = (cpu_time(clock), cpu_time(clock), elapsed_ns());
    loop {
        thread::sleep(CPU_PER_TICK / 2);
        // At any instruction of a task, and of the other's handler.
        suite_raise(1);
        suite_raise(2);
        let (cpu, now) = (cpu_time(clock), elapsed_ns());
        if now != last {
            (ticked, rung, last) = (cpu, cpu, now);
        } else if cpu - rung >= CPU_PER_TICK {
            host::raise(Interrupt::DOORBELL);
            rung = cpu;
            // A known gap of the port: if a signal arrives together with a tick that switches, no
            // further one is sent until the next tick, which only this ring can bring.
            if cpu - ticked >= 2 * CPU_PER_TICK {
                // SAFETY: that thread never ends; the port has a handler of this signal, its
                // `raise_signal`.
                unsafe { libc::pthread_kill(kernel, libc::SIGRTMIN() + 2) };
            }
        }
        if cpu - ticked >= LIMIT {
            eprintln!("no tick after {now} ns");
            std::process::abort();
        }
    }
}

fn fill(kernel: &Kernel) {
    let clock = kernel.spawn(&TaskOptions::new("clock", ABOVE), |ctx| {
        loop {
            ctx.take_notifications(Ticks::FOREVER);
            ctx.burn(Duration::from_millis(1));
        }
    });
    let clock = clock.expect("there is memory");
    let ring = move |ctx: &_| clock.notify(ctx).expect("the clock never ends");
    let attached = kernel.attach(Interrupt::DOORBELL, InterruptPriority::HIGHEST, ring);
    attached.expect("it has no handler yet");
    let handlers: [(u8, extern "C" fn()); 2] = [(1, suite_first), (2, suite_second)];
    for (number, handler) in handlers {
        let priority = InterruptPriority::new(10 * number);
        let attached = kernel.attach(Interrupt::new(number), priority, move |_| handler());
        attached.expect("it has no handler yet");
    }
    let check = kernel.spawn(&TaskOptions::new("check", ABOVE), |ctx| {
        let mut own = 0;
        // SAFETY: all tasks run in this thread; its clock is written to a valid variable.
        let kernel = unsafe { libc::pthread_self() };
        // SAFETY: as above.
        assert_eq!(unsafe { libc::pthread_getcpuclockid(kernel, &mut own) }, 0);
        deferred(|| thread::spawn(move || watch(kernel, own)));
        let mut wake = ctx.now();
        while PASSED.load(Ordering::Relaxed) < CHECKS {
            ctx.delay_until(&mut wake, CHECK_EVERY);
            if suite_is_running() != 1 {
                break;
            }
            PASSED.fetch_add(1, Ordering::Relaxed);
        }
        ctx.stop();
    });
    check.expect("there is memory");
    suite_start();
}

/// Returns 0 if the suite passed each check, otherwise 1.
#[unsafe(no_mangle)]
extern "C" fn main() -> i32 {
    thread::spawn(|| {
        thread::sleep(WALL_LIMIT);
        eprintln!("no end after {WALL_LIMIT:?}");
        std::process::abort();
    });
    let kernel = Kernel::take().expect("nothing else runs here");
    fill(&kernel);
    kernel.start(TickSource::Virtual).expect("it starts");
    let passed = PASSED.load(Ordering::Relaxed);
    eprintln!(
        "{passed} of {CHECKS} checks passed, tick {}",
        elapsed_ns() / 1_000_000
    );
    i32::from(passed != CHECKS)
}
