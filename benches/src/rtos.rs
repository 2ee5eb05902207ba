//! FreeRTOS on the host: our port beside its own POSIX port and beside what the kernel of the
//! operating system alone can do.
//!
//! Each batch is a process of its own on the near CPU, in the same scheduling class for all:
//! SCHED_FIFO where that is permitted. The peer is a C program of the same kernel's sources
//! (`peers/freertos_posix`), which does what the functions here do.

use crate::clock;
use crate::harness::{Batch, Plan};
use crate::worker::fork;
use std::fs::File;
use std::io::{self, Read, Write};
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::os::unix::process::CommandExt;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};
use tandem_rtos::{Clock, Kernel, Priority, TaskContext, TaskOptions, Ticks, host};

/// The peer, built by the build script.
const POSIX_PORT: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/freertos-posix"));
/// Priority of the batches among the processes of SCHED_FIFO: above the kernel's own threads of 1.
const FIFO_PRIORITY: i32 = 10;
/// Nanoseconds of a tick.
const TICK_NS: u64 = 1_000_000;
/// Samples of a batch at most.
const CAPACITY: usize = 1 << 16;

/// Samples of the tasks of a process.
struct Samples {
    places: [AtomicU64; CAPACITY],
    count: AtomicU32,
}

static SAMPLES: Samples = Samples {
    places: [const { AtomicU64::new(0) }; CAPACITY],
    count: AtomicU32::new(0),
};
/// When what is timed began.
static STAMP: AtomicU32 = AtomicU32::new(0);

impl Samples {
    /// Notes a sample; whether these were enough.
    fn take(&self, sample: u64, wanted: usize) -> bool {
        let count = self.count.load(Relaxed);
        if let Some(place) = self.places.get(count as usize) {
            place.store(sample, Relaxed);
        }
        self.count.store(count + 1, Relaxed);
        count as usize + 1 >= wanted.min(CAPACITY)
    }

    fn write(&self, mut to: impl Write) -> io::Result<()> {
        let taken = &self.places[..(self.count.load(Relaxed) as usize).min(CAPACITY)];
        let bytes: Vec<u8> = taken
            .iter()
            .flat_map(|it| it.load(Relaxed).to_le_bytes())
            .collect();
        to.write_all(&bytes)
    }
}

/// Makes this process one of the measured: on one CPU, and before all ordinary ones if permitted.
fn prepare(cpu: usize) {
    core_affinity::set_for_current(core_affinity::CoreId { id: cpu });
    let priority = libc::sched_param {
        sched_priority: FIFO_PRIORITY,
    };
    // SAFETY: this process, and a valid parameter. If it is refused, all batches run without.
    unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &priority) };
}

/// Runs `body` in a process of its own and returns the samples that it leaves.
fn in_process(plan: &Plan, body: impl FnOnce(usize) -> io::Result<()>) -> io::Result<Vec<u64>> {
    let (mut from_child, to_parent) = io::pipe()?;
    let wanted = plan.warm_up + plan.rounds;
    let child = fork()?;
    if child == 0 {
        // SAFETY: only sets this process's own death signal: it dies with its parent.
        unsafe { libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL) };
        drop(from_child);
        prepare(plan.cpus[0]);
        let ended = body(wanted).and_then(|()| SAMPLES.write(to_parent));
        // SAFETY: ends the child without running the parent's exit handlers.
        unsafe { libc::_exit(i32::from(ended.is_err())) };
    }
    drop(to_parent);
    let mut bytes = vec![];
    let read = from_child.read_to_end(&mut bytes);
    let mut status = 0;
    // SAFETY: waits for the child above; `status` is a valid place.
    unsafe { libc::waitpid(child, &mut status, 0) };
    read?;
    samples(&bytes, plan, status == 0)
}

/// The samples after the warm-up.
fn samples(bytes: &[u8], plan: &Plan, ended_well: bool) -> io::Result<Vec<u64>> {
    let (words, _) = bytes.as_chunks::<8>();
    if !ended_well || words.len() <= plan.warm_up {
        return Err(io::Error::other("the measured process failed"));
    }
    Ok(words[plan.warm_up..]
        .iter()
        .map(|word| u64::from_le_bytes(*word))
        .collect())
}

/// What the peer's program measures, and the unit of its samples.
pub type OfPosixPort = (&'static str, fn(Vec<u64>) -> Batch);
/// How late a task wakes, from one period after it last did: this port counts time by sleeping, so
/// that its ticks drift and have no absolute time.
pub const TICK: OfPosixPort = ("tick", of_ns);
/// From one task to another by a yield.
pub const SWITCH: OfPosixPort = ("switch", of_ticks);
/// From the interrupt of the tick to the task that it wakes.
pub const INTERRUPT: OfPosixPort = ("interrupt", of_ticks);

/// Runs the peer's program.
///
/// # Errors
/// If it cannot be started.
pub fn posix_port(plan: &Plan, (what, of): OfPosixPort) -> io::Result<Batch> {
    // SAFETY: a name closed with a zero; the descriptor is ours.
    let program = unsafe {
        let descriptor = libc::memfd_create(c"freertos-posix".as_ptr(), libc::MFD_CLOEXEC);
        if descriptor < 0 {
            return Err(io::Error::last_os_error());
        }
        OwnedFd::from_raw_fd(descriptor)
    };
    let path = format!("/proc/self/fd/{}", program.as_raw_fd());
    File::from(program.try_clone()?).write_all(POSIX_PORT)?;
    let cpu = plan.cpus[0];
    let mut command = Command::new(path);
    command
        .arg(what)
        .arg((plan.warm_up + plan.rounds).to_string());
    command.stdin(Stdio::null()).stderr(Stdio::null());
    // SAFETY: between fork and exec only system calls for the process itself.
    let output = unsafe {
        command
            .pre_exec(move || {
                libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL);
                prepare(cpu);
                Ok(())
            })
            .output()?
    };
    samples(&output.stdout, plan, output.status.success()).map(of)
}

fn batch(samples_ps: impl Iterator<Item = u64>) -> Batch {
    Batch {
        samples_ps: samples_ps.collect(),
        ..Batch::default()
    }
}

fn of_ns(samples: Vec<u64>) -> Batch {
    batch(samples.into_iter().map(|ns| ns * 1000))
}

fn of_ticks(samples: Vec<u64>) -> Batch {
    batch(samples.into_iter().map(|ticks| clock::to_ps(ticks as u32)))
}

/// How late a bare `clock_nanosleep` to each absolute millisecond returns.
///
/// # Errors
/// If the process cannot be had.
pub fn tick_floor(plan: &Plan) -> io::Result<Batch> {
    let floor = |wanted| {
        let mut due = clock::monotonic_ns();
        loop {
            due += TICK_NS;
            clock::sleep_until(due);
            if SAMPLES.take(clock::monotonic_ns() - due, wanted) {
                return Ok(());
            }
        }
    };
    in_process(plan, floor).map(of_ns)
}

/// Runs a kernel with these tasks, of one priority, until one stops it.
fn kernel<F: Fn(&TaskContext) + Send + 'static>(
    bodies: impl IntoIterator<Item = F>,
) -> io::Result<()> {
    let kernel = Kernel::take().map_err(io::Error::other)?;
    for body in bodies {
        let options = TaskOptions::new("measured", Priority::new(2));
        kernel.spawn(&options, body).map_err(io::Error::other)?;
    }
    kernel.start(Clock::Wall).map_err(io::Error::other)
}

/// How late a task of ours wakes that delays until each tick, from the tick's absolute time.
///
/// # Errors
/// If the process cannot be had, or the kernel does not start.
pub fn tick(plan: &Plan) -> io::Result<Batch> {
    let periodic = |wanted| {
        kernel([move |ctx: &TaskContext| {
            let mut wake = ctx.now();
            loop {
                ctx.delay_until(&mut wake, Ticks(1));
                let late = host::elapsed_ns() - u64::from(wake.0) * TICK_NS;
                if SAMPLES.take(late, wanted) {
                    ctx.stop();
                }
            }
        }])
    };
    in_process(plan, periodic).map(of_ns)
}

/// From the call of a yield in one task to its end in the other.
///
/// # Errors
/// If the process cannot be had, or the kernel does not start.
pub fn switch(plan: &Plan) -> io::Result<Batch> {
    let yielders = |wanted| {
        let yielder = move |ctx: &TaskContext| {
            loop {
                let began = STAMP.load(Relaxed);
                let took = clock::ticks().wrapping_sub(began);
                if began != 0 && SAMPLES.take(u64::from(took), wanted) {
                    ctx.stop();
                }
                STAMP.store(clock::ticks(), Relaxed);
                ctx.yield_now();
            }
        };
        kernel([yielder, yielder])
    };
    in_process(plan, yielders).map(of_ticks)
}

/// From the interrupt of the tick to the task that it wakes; the idle task is interrupted.
///
/// # Errors
/// If the process cannot be had, or the kernel does not start.
pub fn switch_from_interrupt(plan: &Plan) -> io::Result<Batch> {
    let interrupted = |wanted| {
        host::observe_ticks(Some(|_| STAMP.store(clock::ticks(), Relaxed)));
        kernel([move |ctx: &TaskContext| {
            let mut wake = ctx.now();
            loop {
                ctx.delay_until(&mut wake, Ticks(1));
                let took = clock::ticks().wrapping_sub(STAMP.load(Relaxed));
                if SAMPLES.take(u64::from(took), wanted) {
                    ctx.stop();
                }
            }
        }])
    };
    in_process(plan, interrupted).map(of_ticks)
}
