//! FreeRTOS on the host: our port, compared with its own POSIX port and with the bare kernel of the
//! operating system.
//!
//! Each batch is a separate process on the near CPU. All have the same scheduling class: SCHED_FIFO
//! where that is permitted. The peer is a C program (`peers/freertos_posix`), built from the same
//! kernel sources, that mirrors the functions here.

use crate::clock;
use crate::harness::{Batch, BatchPlan};
use crate::shared::SharedPage;
use crate::worker::{BatchPart, ask_for_fifo, perform};
use rustix::fs::{MemfdFlags, memfd_create};
use std::fs::File;
use std::io::{self, Read, Seek, Write};
use std::os::fd::AsRawFd;
use std::os::unix::process::CommandExt;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use tandem_rtos::{Kernel, Priority, TaskContext, TaskOptions, TickSource, Ticks, host};

/// The peer, built by the build script.
const POSIX_PORT: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/freertos-posix"));
/// Nanoseconds of a tick.
const TICK_NS: u64 = 1_000_000;

/// Samples of the tasks of a process: their count, then the samples.
#[derive(Clone, Copy)]
struct Samples(&'static [AtomicU32]);

impl Samples {
    /// Records a sample. Returns whether all samples are taken.
    fn take(self, sample: u32) -> bool {
        let count = 1 + self.0[0].load(Relaxed);
        if let Some(place) = self.0.get(count as usize) {
            place.store(sample, Relaxed);
        }
        self.0[0].store(count, Relaxed);
        count as usize + 1 >= self.0.len()
    }
}

/// Time stamp of the start of the timed operation.
static STAMP: AtomicU32 = AtomicU32::new(0);

/// Runs `body` in a separate process and returns the samples that it leaves.
fn in_process(
    plan: &BatchPlan,
    in_ps: fn(u32) -> u64,
    body: impl FnOnce(Samples) -> io::Result<()>,
) -> io::Result<Batch> {
    let shared = SharedPage::with_case_words(1 + plan.warm_up + plan.rounds)?;
    let part = BatchPart::on(plan.cpus[0], |role| {
        ask_for_fifo();
        body(Samples(role.shared.case()))
    });
    perform(&shared, vec![part])?;
    let samples = shared.case()[1 + plan.warm_up..].iter();
    Ok(batch(samples.map(|sample| sample.load(Relaxed)), in_ps))
}

fn batch(samples: impl Iterator<Item = u32>, in_ps: fn(u32) -> u64) -> Batch {
    Batch {
        samples_ps: samples.map(in_ps).collect(),
        ..Batch::default()
    }
}

fn of_ns(ns: u32) -> u64 {
    u64::from(ns) * 1000
}

/// Runs the peer's program, which measures
/// - `tick`: how late a task wakes, relative to one period after its last wake-up. The POSIX port
///   counts time by sleeping, so its ticks drift and have no absolute time;
/// - `switch`: from one task to another by a yield;
/// - `interrupt`: from the interrupt of the tick to the task that it wakes.
pub(crate) fn posix_port(plan: &BatchPlan, what: &str) -> io::Result<Batch> {
    let in_ps = if what == "tick" { of_ns } else { clock::to_ps };
    let memory = || memfd_create("freertos-posix", MemfdFlags::CLOEXEC).map(File::from);
    let (mut program, mut output) = (memory()?, memory()?);
    program.write_all(POSIX_PORT)?;
    let rounds = (plan.warm_up + plan.rounds).to_string();
    let part = BatchPart::on(plan.cpus[0], |_| {
        ask_for_fifo();
        let mut command = Command::new(format!("/proc/self/fd/{}", program.as_raw_fd()));
        command.args([what, &rounds]).stdin(Stdio::null());
        Err(command.stdout(output.try_clone()?).exec())
    });
    perform(&SharedPage::new()?, vec![part])?;
    let mut bytes = vec![];
    output.rewind()?;
    output.read_to_end(&mut bytes)?;
    let samples = bytes.as_chunks().0.get(plan.warm_up..);
    let samples = samples.filter(|samples| !samples.is_empty());
    let samples = samples.ok_or_else(|| io::Error::other("the POSIX port measured nothing"))?;
    let in_ticks = |sample: &[u8; 8]| u64::from_le_bytes(*sample) as u32;
    Ok(batch(samples.iter().map(in_ticks), in_ps))
}

/// Measures how late a bare `clock_nanosleep` to each absolute millisecond returns.
pub(crate) fn tick_floor(plan: &BatchPlan) -> io::Result<Batch> {
    in_process(plan, of_ns, |samples| {
        let mut due = clock::monotonic_ns();
        loop {
            due += TICK_NS;
            clock::sleep_until(due);
            if samples.take((clock::monotonic_ns() - due) as u32) {
                return Ok(());
            }
        }
    })
}

/// Runs a kernel with these tasks, all of the same priority, until one stops it.
fn kernel<F: Fn(&TaskContext) + Send + 'static>(
    bodies: impl IntoIterator<Item = F>,
) -> io::Result<()> {
    let kernel = Kernel::take().map_err(io::Error::other)?;
    for body in bodies {
        let options = TaskOptions::new("measured", Priority::new(2));
        kernel.spawn(&options, body).map_err(io::Error::other)?;
    }
    kernel.start(TickSource::Wall).map_err(io::Error::other)
}

/// Runs a task that delays until each tick and records the result of `sample`.
fn each_tick(samples: Samples, sample: fn(Ticks) -> u32) -> io::Result<()> {
    kernel([move |ctx: &TaskContext| {
        let mut wake = ctx.now();
        loop {
            ctx.delay_until(&mut wake, Ticks(1));
            if samples.take(sample(wake)) {
                ctx.stop();
            }
        }
    }])
}

/// Measures how late a task of our port wakes when it delays until each tick's absolute time.
pub(crate) fn tick(plan: &BatchPlan) -> io::Result<Batch> {
    let late = |wake: Ticks| (host::elapsed_ns() - u64::from(wake.0) * TICK_NS) as u32;
    in_process(plan, of_ns, |samples| each_tick(samples, late))
}

/// Measures from the tick's interrupt, which interrupts the idle task, to the task that it wakes.
pub(crate) fn switch_from_interrupt(plan: &BatchPlan) -> io::Result<Batch> {
    in_process(plan, clock::to_ps, |samples| {
        host::observe_ticks(Some(|_| STAMP.store(clock::ticks(), Relaxed)));
        each_tick(samples, |_| {
            clock::ticks().wrapping_sub(STAMP.load(Relaxed))
        })
    })
}

/// Measures from the call of a yield in one task to its return in the other.
pub(crate) fn switch(plan: &BatchPlan) -> io::Result<Batch> {
    in_process(plan, clock::to_ps, |samples| {
        let yielder = move |ctx: &TaskContext| {
            loop {
                let began = STAMP.load(Relaxed);
                let took = clock::ticks().wrapping_sub(began);
                if began != 0 && samples.take(took) {
                    ctx.stop();
                }
                STAMP.store(clock::ticks(), Relaxed);
                ctx.yield_now();
            }
        };
        kernel([yielder, yielder])
    })
}
