//! Ways in which tasks could harm each other and their process: a shared allocator or output, stack
//! overflow, panics. A test that ends its process runs in a child. T-RTOS-1
#![allow(clippy::expect_used, clippy::print_stdout, reason = "a test may")]

#[path = "fixture/setup.rs"]
mod setup;

use setup::{Fill as _, Ringer};
use std::alloc::{GlobalAlloc, Layout, System};
use std::hint::black_box;
use std::os::unix::process::ExitStatusExt;
use std::panic::{catch_unwind, resume_unwind};
use std::process::{Command, Output, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};
use tandem_rtos::host::{TaskAllocator, deferred, raise};
use tandem_rtos::{
    Interrupt, InterruptContext, Kernel, Mutex, Queue, TaskContext, TickSource, Ticks,
};

/// An allocator that detects two tasks of one thread in it at the same time.
struct Witness {
    busy: AtomicBool,
    overlaps: AtomicU32,
}

impl Witness {
    const fn new() -> Self {
        Self {
            busy: AtomicBool::new(false),
            overlaps: AtomicU32::new(0),
        }
    }

    fn within<R>(&self, body: impl FnOnce() -> R) -> R {
        // Ignores calls of other threads.
        if !WATCHED.get() {
            return body();
        }
        if self.busy.swap(true, Ordering::Relaxed) {
            self.overlaps.fetch_add(1, Ordering::Relaxed);
        }
        // This takes long enough for a tick to interrupt it after some calls.
        for _ in 0..200 {
            black_box(());
        }
        let result = body();
        self.busy.store(false, Ordering::Relaxed);
        result
    }
}

// SAFETY: all calls are passed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Witness {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller's promise.
        self.within(|| unsafe { System.alloc(layout) })
    }

    unsafe fn dealloc(&self, place: *mut u8, layout: Layout) {
        // SAFETY: the caller's promise.
        self.within(|| unsafe { System.dealloc(place, layout) });
    }
}

std::thread_local! {
    static WATCHED: std::cell::Cell<bool> = const { std::cell::Cell::new(false) };
}

#[global_allocator]
static ALLOCATOR: TaskAllocator<Witness> = TaskAllocator::new(Witness::new());
/// The same allocator without the guard.
static UNGUARDED: Witness = Witness::new();

/// A test runs itself again as a child with this variable set to its name.
const CHILD: &str = "TANDEM_RTOS_CHILD";

fn is_child(of: &str) -> bool {
    std::env::var(CHILD).is_ok_and(|name| name == of)
}

/// Runs a test of this file as a child, which is killed after 60 s.
fn child(test: &str, kind: &str) -> Output {
    let mut command = Command::new(std::env::current_exe().expect("this program"));
    command.args(["--exact", test, "--nocapture", "--test-threads=1"]);
    command.env(CHILD, kind).stdin(Stdio::null());
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let child = command.spawn().expect("it starts");
    let id = child.id();
    let (ended, watch) = std::sync::mpsc::channel::<()>();
    let watchdog = std::thread::spawn(move || {
        let over = Err(std::sync::mpsc::RecvTimeoutError::Timeout);
        if watch.recv_timeout(Duration::from_secs(60)) == over {
            // SAFETY: a child that was not waited for keeps its process number.
            unsafe { libc::kill(id as i32, libc::SIGKILL) };
        }
    });
    let output = child.wait_with_output().expect("it ends");
    drop(ended);
    watchdog.join().expect("it ends");
    output
}

fn run(clock: TickSource, fill: impl FnOnce(&Kernel)) {
    let kernel = Kernel::take().expect("a child has one kernel");
    fill(&kernel);
    kernel.start(clock).expect("it starts");
}

/// Asserts that the child printed `says` and aborted.
fn assert_aborted(output: &Output, says: &str) {
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(text.contains(says), "{text}");
    assert_eq!(output.status.signal(), Some(libc::SIGABRT), "{text}");
}

/// Runs tasks that allocate through `allocator` while another thread interrupts them.
fn torture(allocator: &'static (impl GlobalAlloc + Sync)) {
    let _ringer = Ringer::every(Duration::from_micros(50));
    run(TickSource::Wall, |kernel| {
        let allocates = move || {
            let layout = Layout::from_size_align(64, 8).expect("valid");
            // SAFETY: allocated with this layout and freed with it.
            unsafe {
                let place = allocator.alloc(layout);
                place.write_bytes(0xAB, 64);
                allocator.dealloc(place, layout);
            }
        };
        for name in ["a", "b"] {
            let body = move |_: &TaskContext| loop {
                allocates();
            };
            kernel.task(name, 1, body);
        }
        let urgent = kernel.task("urgent", 2, move |ctx| {
            WATCHED.set(true);
            let until = Instant::now() + Duration::from_millis(1500);
            while Instant::now() < until {
                ctx.take_notification(Ticks(5));
                allocates();
            }
            WATCHED.set(false);
            ctx.stop();
        });
        let handler = move |ctx: &_| urgent.notify(ctx).expect("it lives");
        kernel.on(Interrupt::DOORBELL, handler);
    });
}

/// No task enters the allocator while another task is in it. The control: without the guard, the
/// same allocator has overlaps.
#[test]
fn tasks_share_the_allocator() {
    const NAME: &str = "tasks_share_the_allocator";
    if is_child("guarded") {
        torture(&ALLOCATOR);
        println!(
            "overlaps: {}",
            ALLOCATOR.inner().overlaps.load(Ordering::Relaxed)
        );
    } else if is_child("unguarded") {
        torture(&UNGUARDED);
        println!("overlaps: {}", UNGUARDED.overlaps.load(Ordering::Relaxed));
    } else {
        let guarded = child(NAME, "guarded");
        let text = String::from_utf8_lossy(&guarded.stdout);
        assert!(
            guarded.status.success() && text.contains("overlaps: 0\n"),
            "{guarded:?}"
        );
        // The child prints the overlaps, unless the system's allocator ends the process first.
        let went_well = || {
            let unguarded = child(NAME, "unguarded");
            let text = String::from_utf8_lossy(&unguarded.stdout);
            unguarded.status.success() && text.contains("overlaps: 0\n")
        };
        assert!((0..5).any(|_| !went_well()), "the control saw no overlap");
    }
}

/// Runs two tasks that print lines while a third one interrupts them.
fn print_from_tasks(print: fn(&str)) {
    // The test harness's output has no line end yet.
    println!();
    run(TickSource::Wall, |kernel| {
        for (name, priority, count) in [("a", 1, 3000), ("b", 1, 3000), ("c", 2, 400)] {
            let done: &'static AtomicU32 = &DONE;
            let body = move |ctx: &TaskContext| {
                for number in 0..count {
                    print(&format!("line {name} {number:06} {}", name.repeat(40)));
                    if priority == 2 {
                        ctx.delay(Ticks(1));
                    }
                }
                if done.fetch_add(1, Ordering::Relaxed) == 2 {
                    ctx.stop();
                }
            };
            kernel.task(name, priority, body);
        }
    });
}

static DONE: AtomicU32 = AtomicU32::new(0);

/// Lines that tasks print with pre-emption deferred are whole, in order, and complete. Without
/// deferring, the same tasks collide at the lock of the output and the process ends.
#[test]
fn tasks_share_the_output() {
    const NAME: &str = "tasks_share_the_output";
    if is_child("ours") {
        print_from_tasks(|line| deferred(|| println!("{line}")));
    } else if is_child("standard") {
        print_from_tasks(|line| println!("{line}"));
    } else {
        let output = child(NAME, "ours");
        let text = String::from_utf8_lossy(&output.stdout);
        let error = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{error}");
        for (name, count) in [("a", 3000), ("b", 3000), ("c", 400)] {
            let end = name.repeat(40);
            let lines = text
                .lines()
                .filter(|line| line.starts_with(&format!("line {name}")));
            let lines: Vec<&str> = lines.collect();
            assert_eq!(lines.len(), count, "{name}");
            for (number, line) in lines.iter().enumerate() {
                assert_eq!(*line, format!("line {name} {number:06} {end}"));
            }
        }
        // The control: a task is pre-empted while it holds the lock. Usually the first attempt
        // shows it.
        let collides = || !child(NAME, "standard").status.success();
        assert!(
            (0..20).any(|_| collides()),
            "the control never met in the lock"
        );
    }
}

#[allow(unconditional_recursion, reason = "that is what is tested")]
fn recurse(depth: u64) -> u64 {
    let frame = black_box([depth; 64]);
    recurse(depth + 1) + frame[depth as usize % 64]
}

/// T-RTOS-1: a stack that grows into its guard ends the process with the task's name.
#[test]
fn an_overflowed_stack_is_named() {
    const NAME: &str = "an_overflowed_stack_is_named";
    if is_child("deep") {
        run(TickSource::Wall, |kernel| {
            let deep = |_: &TaskContext| assert!(black_box(recurse(0)) > 0);
            kernel.task("deep", 2, deep);
        });
    } else {
        assert_aborted(&child(NAME, "deep"), "task 'deep' has overflowed its stack");
    }
}

/// A task lends a thread-local to another thread, and a second task stops the scheduler. The first
/// task never returns from the lending call, so the loan never ends: the kernel's thread must not
/// end, and the thread-local must stay.
#[test]
fn what_an_abandoned_task_has_lent_stays() {
    const NAME: &str = "what_an_abandoned_task_has_lent_stays";
    struct Lent(AtomicU32);
    impl Drop for Lent {
        fn drop(&mut self) {
            DROPPED.store(true, Ordering::Relaxed);
        }
    }
    std::thread_local! {
        static LENT: Lent = const { Lent(AtomicU32::new(7)) };
    }
    static DROPPED: AtomicBool = AtomicBool::new(false);
    static READS: AtomicU32 = AtomicU32::new(0);
    if !is_child("lends") {
        let output = child(NAME, "lends");
        return assert!(output.status.success(), "{output:?}");
    }
    let life = || {
        run(TickSource::Wall, |kernel| {
            let lends = |_: &TaskContext| {
                LENT.with(|lent| {
                    std::thread::scope(|scope| {
                        scope.spawn(|| {
                            while !DROPPED.load(Ordering::Relaxed) {
                                READS.fetch_add(lent.0.load(Ordering::Relaxed), Ordering::Relaxed);
                            }
                        });
                    });
                });
            };
            kernel.task("lends", 1, lends);
            let stops = |ctx: &TaskContext| {
                while READS.load(Ordering::Relaxed) == 0 {
                    ctx.delay(Ticks(1));
                }
                ctx.stop();
            };
            kernel.task("stops", 2, stops);
        });
    };
    // The thread-locals of this thread are dropped when it ends, before `join` returns.
    std::thread::spawn(life).join().expect("it stops");
    // A thread that ends late would drop them during this time.
    std::thread::sleep(Duration::from_millis(200));
    assert!(!DROPPED.load(Ordering::Relaxed), "a lent value was dropped");
    let before = READS.load(Ordering::Relaxed);
    while READS.load(Ordering::Relaxed) == before {
        std::thread::yield_now();
    }
}

/// Returns the lowest address of the stack of the running task: its mapping begins above the guard.
fn own_stack() -> usize {
    let local = 0u8;
    let here = (&raw const local).addr();
    let maps = deferred(|| std::fs::read_to_string("/proc/self/maps")).expect("Linux has it");
    let ranges = maps
        .lines()
        .filter_map(|line| line.split(' ').next()?.split_once('-'));
    let bounds = ranges.filter_map(|(low, high)| {
        let hex = |text| usize::from_str_radix(text, 16).ok();
        Some(hex(low)?..hex(high)?)
    });
    let mut own = bounds.filter(|range| range.contains(&here));
    own.next().expect("it is mapped").start
}

/// T-RTOS-1: at the next switch the kernel detects that the end of a stack was overwritten, by an
/// access beyond the guard or by a stray pointer.
#[test]
fn an_overwritten_stack_end_is_named() {
    const NAME: &str = "an_overwritten_stack_end_is_named";
    if is_child("full") {
        run(TickSource::Virtual, |kernel| {
            let full = |ctx: &TaskContext| {
                // SAFETY: within this task's stack, far below the part that it uses.
                unsafe { (own_stack() as *mut [usize; 2]).write_volatile([0; 2]) };
                ctx.delay(Ticks(1));
                ctx.stop();
            };
            kernel.task("full", 2, full);
        });
    } else {
        assert_aborted(&child(NAME, "full"), "task 'full' has overflowed its stack");
    }
}

/// A fault that is not an overflow ends the process as it does without this crate.
#[test]
fn another_fault_is_what_it_was() {
    const NAME: &str = "another_fault_is_what_it_was";
    if is_child("wild") {
        run(TickSource::Wall, |kernel| {
            // SAFETY: none: the test needs the fault.
            let wild = |_: &TaskContext| unsafe { black_box(64 as *mut u8).write_volatile(1) };
            kernel.task("wild", 2, wild);
        });
    } else {
        let output = child(NAME, "wild");
        let text = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.signal(), Some(libc::SIGSEGV), "{text}");
        assert!(!text.contains("overflowed"), "{text}");
    }
}

/// A panic ends the process with the task's name.
#[test]
fn a_panic_is_named() {
    const NAME: &str = "a_panic_is_named";
    if is_child("panics") {
        run(TickSource::Wall, |kernel| {
            let panics = |_: &TaskContext| panic!("out of cheese");
            kernel.task("fondue", 2, panics);
        });
    } else {
        let output = child(NAME, "panics");
        assert_aborted(&output, "task 'fondue' panicked");
        assert_aborted(&output, "out of cheese");
    }
}

/// A call that would hang or corrupt the kernel is refused with a message.
#[test]
fn misuse_is_refused() {
    const NAME: &str = "misuse_is_refused";
    type Misuse = fn(&TaskContext);
    let misuses: [(&str, &str, Misuse); 6] = [
        ("critical", "a call that may block", |ctx| {
            ctx.critical(|| ctx.delay(Ticks(1)));
        }),
        ("deferred", "a call that may block", |ctx| {
            deferred(|| ctx.delay(Ticks(1)));
        }),
        ("twice", "a task locks what it holds", |ctx| {
            let mutex = Mutex::new(ctx, ());
            let _first = mutex.lock(ctx, Ticks::NONE);
            let _second = mutex.lock(ctx, Ticks::FOREVER);
        }),
        ("leaves", "has ended with a locked mutex", |ctx| {
            let mutex = Mutex::new(ctx, ());
            std::mem::forget(mutex.lock(ctx, Ticks::NONE));
        }),
        ("unwinds", "a handler has unwound", |_| {
            let _ = catch_unwind(|| raise(Interrupt::DOORBELL));
        }),
        ("stale", "an earlier life of the kernel", |ctx| ctx.stop()),
    ];
    for (kind, says, misuse) in misuses {
        if is_child(kind) {
            let mut old = None;
            run(TickSource::Wall, |kernel| {
                old = Some(Queue::<u32>::new(kernel, 1));
                kernel.task("misuses", 2, misuse);
                let unwind = |_: &InterruptContext| resume_unwind(Box::new(()));
                kernel.on(Interrupt::DOORBELL, unwind);
            });
            // Only the last of the tasks stops the scheduler.
            run(TickSource::Wall, |kernel| {
                let sends = move |ctx: &TaskContext| {
                    let _ = old.take().map(|queue| queue.try_send(ctx, 1));
                };
                kernel.task("late", 2, sends);
            });
        } else if std::env::var(CHILD).is_err() {
            assert_aborted(&child(NAME, kind), says);
        }
    }
}

/// There is one kernel. It can be taken again after its scheduler has stopped.
#[test]
fn the_kernel_is_taken_once_and_comes_back() {
    const NAME: &str = "the_kernel_is_taken_once_and_comes_back";
    if !is_child("lives") {
        let output = child(NAME, "lives");
        return assert!(output.status.success(), "{output:?}");
    }
    let first = Kernel::take().expect("it is free");
    assert!(Kernel::take().is_err());
    first.task("never", 1, |_| ());
    drop(first);
    for _ in 0..3 {
        // Uses another thread each time, because each life of the kernel belongs to one thread.
        let life = std::thread::spawn(|| {
            run(TickSource::Wall, |kernel| {
                kernel.task("stops", 1, |ctx| ctx.stop());
            });
        });
        life.join().expect("it stops");
    }
}
