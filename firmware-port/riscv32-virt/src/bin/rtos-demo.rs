//! Tasks of FreeRTOS that change digital outputs, which the thesis shows on an oscilloscope.
//! T-RTOS-3, T-RTOS-4
//!
//! Hart 0 runs the kernel. The program records each change of an output with the time of the CLINT,
//! in ticks of 100 ns, and prints all changes after both tests.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::sync::atomic::{AtomicU32, Ordering};
use tandem_board_riscv32_virt::{clint, entry, exit, hart, log, must};
use tandem_rtos::demo::{COMPLETE, OutputEdge, SPAN_MS, TESTS, toggle};
use tandem_rtos::{Kernel, Priority, TaskContext, TaskOptions, TickSource, Ticks};

entry!(main);

/// Room for the changes of one output: one every 10 ms in 360 ms, plus a reserve.
const ROOM: usize = 64;

/// The changes of one output. One task writes; another reads after the first has ended.
struct Probe {
    count: AtomicU32,
    /// Times of the changes, in ticks of the CLINT since the start of the test.
    at: [AtomicU32; ROOM],
}

impl Probe {
    const fn new() -> Self {
        Self {
            count: AtomicU32::new(0),
            at: [const { AtomicU32::new(0) }; ROOM],
        }
    }

    fn change(&self) {
        let at = now().wrapping_sub(BEGIN.load(Ordering::Relaxed));
        let count = self.count.load(Ordering::Relaxed);
        self.at[count as usize].store(at, Ordering::Relaxed);
        self.count.store(count + 1, Ordering::Relaxed);
    }
}

/// Start time of the current test. Relaxed accesses: the test and its tasks run on one hart.
static BEGIN: AtomicU32 = AtomicU32::new(0);
static PROBES: [[Probe; 3]; 2] = [const { [const { Probe::new() }; 3] }; 2];

/// Returns the time in ticks of the CLINT. Its upper half is always zero in this program.
fn now() -> u32 {
    hart::time() as u32
}

fn main(hart: usize) -> ! {
    if hart == 0 {
        control()
    }
    hart::park()
}

fn control() -> ! {
    tandem_rtos::riscv32::on_fatal(|message| panic!("{message}"));
    let kernel = must(Kernel::take());
    let options = TaskOptions::new("tests", Priority::HIGHEST);
    must(kernel.spawn(&options, run));
    must(kernel.start(TickSource::Wall));
    panic!("the kernel has stopped")
}

/// Runs in a task: starts both tests, and sleeps while they run.
fn run(ctx: &TaskContext) {
    let mut wake = ctx.now();
    // Sleep until a tick, so that the work between two sleeps starts at a tick.
    ctx.delay_until(&mut wake, Ticks(1));
    for test in 0..TESTS.len() {
        // The tasks are created before the tick at which they all start.
        let before = wake;
        for (output, probe) in TESTS[test].outputs.iter().zip(&PROBES[test]) {
            let options = TaskOptions::new(output.name, Priority::new(output.priority));
            must(ctx.spawn(&options, move |ctx| {
                let mut wake = before;
                ctx.delay_until(&mut wake, Ticks(1));
                toggle(ctx, output, wake, || probe.change());
            }));
        }
        ctx.delay_until(&mut wake, Ticks(1));
        BEGIN.store(now(), Ordering::Relaxed);
        ctx.delay_until(&mut wake, Ticks(SPAN_MS));
    }
    for (test, probes) in PROBES.iter().enumerate() {
        for (output, probe) in probes.iter().enumerate() {
            for at in &probe.at[..probe.count.load(Ordering::Relaxed) as usize] {
                let at_ns = u64::from(at.load(Ordering::Relaxed)) * clint::TICK_NS;
                log!(
                    "{}",
                    OutputEdge {
                        test,
                        output,
                        at_ns
                    }
                );
            }
        }
    }
    log!("{COMPLETE}");
    exit::exit(0)
}
