//! The processes of one batch: started pinned, watched, and always ended.
//!
//! Each part is forked for one batch only and inherits nothing from earlier batches. If one dies or
//! the whole takes longer than [`LIMIT`], all are killed and the batch is an error, not a hang.
//! Each part is killed when the benchmark dies.

use crate::clock::cpu_ns;
use crate::shared::{CPU_NS, Log, PARTS, SharedPage};
use rustix::event::{PollFd, PollFlags, poll};
use rustix::process::{
    Pid, PidfdFlags, Signal, WaitId, WaitIdOptions, getpid, getppid, pidfd_open, pidfd_send_signal,
    set_parent_process_death_signal, waitid,
};
use std::fs;
use std::io;
use std::os::fd::{AsFd as _, OwnedFd};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// The longest that a batch may take.
pub const LIMIT: Duration = Duration::from_secs(60);

/// One process of a batch.
pub struct BatchPart<'a> {
    cpu: usize,
    run: Run<'a>,
}

/// Whether parts get SCHED_FIFO.
static REALTIME: AtomicBool = AtomicBool::new(false);
/// Priorities of this process, which ends a batch that hangs, and of its parts.
const PRIORITIES: [libc::c_int; 2] = [20, 10];

/// Sets SCHED_FIFO for this process and all later parts; `false` if it is refused.
#[must_use]
pub fn ask_for_realtime() -> bool {
    let granted = set_fifo(PRIORITIES[0]);
    REALTIME.store(granted, Ordering::Relaxed);
    granted
}

/// Sets SCHED_FIFO for the calling process, with the priority of a part; `false` if it is refused.
pub fn ask_for_fifo() -> bool {
    set_fifo(PRIORITIES[1])
}

fn set_fifo(priority: libc::c_int) -> bool {
    let priority = libc::sched_param {
        sched_priority: priority,
    };
    // SAFETY: the calling thread, and a valid parameter.
    unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &priority) == 0 }
}

/// The code of a part.
type Run<'a> = Box<dyn FnOnce(&mut PartContext<'_>) -> io::Result<()> + 'a>;

impl<'a> BatchPart<'a> {
    /// A process that runs `run` on this CPU.
    pub fn on(cpu: usize, run: impl FnOnce(&mut PartContext<'_>) -> io::Result<()> + 'a) -> Self {
        Self {
            cpu,
            run: Box::new(run),
        }
    }
}

/// The context of a part in its batch.
pub struct PartContext<'a> {
    /// The memory that it shares with the other parts.
    pub shared: &'a SharedPage,
    /// Where it writes its samples.
    pub log: Log,
    cpu_at_begin: u64,
}

impl PartContext<'_> {
    /// Returns the context for a second thread of this part, which records as part `number`.
    #[must_use]
    pub fn beside(&self, number: usize) -> Self {
        Self {
            log: self.shared.log(number),
            ..*self
        }
    }

    /// Begins the span whose CPU time counts. Called after warm-up.
    pub fn begin(&mut self) {
        self.cpu_at_begin = cpu_ns();
    }

    /// Ends that span.
    pub fn end(&mut self) {
        let used = cpu_ns() - self.cpu_at_begin;
        self.log.note(CPU_NS, used as f64);
    }
}

/// Runs all parts until they end.
///
/// # Errors
/// If a process cannot be created, a part failed or died, or all took longer than [`LIMIT`].
pub fn perform(shared: &SharedPage, parts: Vec<BatchPart<'_>>) -> io::Result<()> {
    perform_within(LIMIT, shared, parts)
}

/// As [`perform`], with this limit.
///
/// # Errors
/// As [`perform`].
pub fn perform_within(
    limit: Duration,
    shared: &SharedPage,
    parts: Vec<BatchPart<'_>>,
) -> io::Result<()> {
    assert!(parts.len() <= PARTS);
    let mut children = Vec::with_capacity(parts.len());
    for (number, part) in parts.into_iter().enumerate() {
        // On an error, processes that already run are killed when `children` is dropped.
        children.push(Child::start(part.cpu, || play(shared, number, part.run))?);
    }
    let outcome = watch(&mut children, limit);
    // Kill all, then wait: under SCHED_FIFO a child that spins prevents others from ending.
    children.iter().for_each(Child::kill);
    drop(children);
    outcome.map_err(|error| {
        let said = (0..PARTS).map(|number| shared.log(number).said());
        said.into_iter()
            .find(|text| !text.is_empty())
            .map_or(error, io::Error::other)
    })
}

/// Runs a part in its own process. Returns whether it reached its end.
fn play(shared: &SharedPage, number: usize, run: Run<'_>) -> bool {
    // The message goes to the parent, not to the terminal.
    std::panic::set_hook(Box::new(|_| {}));
    shared.touch();
    let mut role = PartContext {
        shared,
        log: shared.log(number),
        cpu_at_begin: 0,
    };
    let outcome = catch_unwind(AssertUnwindSafe(|| run(&mut role)));
    let log = shared.log(number);
    role.log.close();
    match outcome {
        Ok(Ok(())) => return true,
        Ok(Err(error)) => log.say(&error.to_string()),
        Err(panic) => {
            let text = panic.downcast_ref::<String>().map(String::as_str);
            let text = text.or(panic.downcast_ref::<&str>().copied());
            log.say(text.unwrap_or("an end of the measurement panicked"));
        }
    }
    false
}

/// Waits until all have ended without an error.
fn watch(children: &mut [Child], limit: Duration) -> io::Result<()> {
    let until = Instant::now() + limit;
    while children.iter().any(|child| child.running) {
        let left = until.saturating_duration_since(Instant::now());
        if left.is_zero() {
            let text = format!("it did not end within {} s", limit.as_secs_f32());
            return Err(io::Error::new(io::ErrorKind::TimedOut, text));
        }
        let running = children.iter().filter(|child| child.running);
        let mut fds: Vec<_> = running
            .map(|child| PollFd::new(&child.pidfd, PollFlags::IN))
            .collect();
        // A signal (Ctrl-C) only ends the wait.
        let _ = poll(&mut fds, left.try_into().ok().as_ref());
        for child in children.iter_mut() {
            child.reap(WaitIdOptions::NOHANG)?;
        }
    }
    Ok(())
}

/// A process of our own; it is killed (-9) when this is dropped.
pub struct Child {
    pidfd: OwnedFd,
    running: bool,
}

impl Child {
    /// Runs `body` in a child process on this CPU. The child's status is 0 if `body` returns true.
    ///
    /// # Errors
    /// If no process can be created, or this one has more than one thread: another thread may
    /// hold a lock, for example of the allocator, which no thread of the child would ever release.
    pub fn start(cpu: usize, body: impl FnOnce() -> bool) -> io::Result<Self> {
        if fs::read_dir("/proc/self/task")?.count() != 1 {
            return Err(io::Error::other("a process with threads is not forked"));
        }
        let parent = getpid();
        // SAFETY: this process has one thread, so the child is a whole copy of it.
        let pid = unsafe { libc::fork() };
        if pid < 0 {
            return Err(io::Error::last_os_error());
        }
        if let Some(pid) = Pid::from_raw(pid) {
            let pidfd = pidfd_open(pid, PidfdFlags::empty())?;
            let running = true;
            return Ok(Self { pidfd, running });
        }
        let tied = set_parent_process_death_signal(Some(Signal::KILL));
        // SAFETY: only makes this process ignore Ctrl-C: the parent ends the batch.
        unsafe { libc::signal(libc::SIGINT, libc::SIG_IGN) };
        pin(cpu);
        if REALTIME.load(Ordering::Relaxed) {
            ask_for_fifo();
        }
        // Without this check, a parent that died before the call would go unnoticed.
        let done = tied.is_ok()
            && getppid() == Some(parent)
            && catch_unwind(AssertUnwindSafe(body)).unwrap_or(false);
        // SAFETY: ends the child without running the parent's exit handlers.
        unsafe { libc::_exit(i32::from(!done)) };
    }

    fn kill(&self) {
        // It may have ended already.
        let _ = pidfd_send_signal(&self.pidfd, Signal::KILL);
    }

    /// Records whether the child has ended; an error if its status is not 0.
    fn reap(&mut self, options: WaitIdOptions) -> io::Result<()> {
        let of = WaitId::PidFd(self.pidfd.as_fd());
        if self.running
            && let Ok(Some(status)) = waitid(of, options | WaitIdOptions::EXITED)
        {
            self.running = false;
            if status.exit_status() != Some(0) {
                return Err(io::Error::other("one end of the measurement died"));
            }
        }
        Ok(())
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        self.kill();
        // If the child had already ended, this does not wait.
        let _ = self.reap(WaitIdOptions::empty());
    }
}

/// Pins the calling thread to a CPU.
pub fn pin(cpu: usize) {
    core_affinity::set_for_current(core_affinity::CoreId { id: cpu });
}
