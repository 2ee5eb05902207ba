//! The processes of one batch: started pinned, watched, and ended, whatever happens.
//!
//! Each part is forked for one batch only and inherits nothing from earlier batches. If one dies or
//! the whole takes longer than [`LIMIT`], all are killed and the batch is an error, not a hang.
//! Each dies with the benchmark itself.

use crate::clock::{cpu_ns, monotonic_ns};
use crate::shared::{Log, PARTS, Shared, note};
use std::fs;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// The longest that a batch may take.
pub const LIMIT: Duration = Duration::from_secs(20);

/// One process of a batch.
pub struct Part<'a> {
    cpu: usize,
    run: Run<'a>,
}

/// Whether parts get SCHED_FIFO.
static REALTIME: AtomicBool = AtomicBool::new(false);
/// Priorities of this process, which ends a batch that hangs, and of its parts.
const PRIORITIES: [libc::c_int; 2] = [20, 10];

/// Lets this process and all parts from now on have SCHED_FIFO; `false` if it is refused.
#[must_use]
pub fn ask_for_realtime() -> bool {
    let granted = set_fifo(PRIORITIES[0]);
    REALTIME.store(granted, Ordering::Relaxed);
    granted
}

fn set_fifo(priority: libc::c_int) -> bool {
    let priority = libc::sched_param {
        sched_priority: priority,
    };
    // SAFETY: the calling thread, and a valid parameter.
    unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &priority) == 0 }
}

/// What a part does.
type Run<'a> = Box<dyn FnOnce(&mut Role<'_>) -> io::Result<()> + 'a>;

impl<'a> Part<'a> {
    /// A process that runs `run` on this CPU.
    pub fn on(cpu: usize, run: impl FnOnce(&mut Role<'_>) -> io::Result<()> + 'a) -> Self {
        Self {
            cpu,
            run: Box::new(run),
        }
    }
}

/// What a part knows of its batch.
pub struct Role<'a> {
    /// The memory that it shares with the other parts.
    pub shared: &'a Shared,
    /// Where it writes its samples.
    pub log: Log,
    cpu_at_begin: u64,
    before: Resident,
}

impl Role<'_> {
    /// The role of a second thread of this part, which writes as part `number`.
    #[must_use]
    pub fn beside(&self, number: usize) -> Self {
        Self {
            log: self.shared.log(number),
            ..*self
        }
    }

    /// The span whose CPU time counts begins: after warm-up.
    pub fn begin(&mut self) {
        self.cpu_at_begin = cpu_ns();
    }

    /// It ends. What the part has in memory now counts.
    pub fn end(&mut self) {
        let used = cpu_ns() - self.cpu_at_begin;
        self.log.set(note::CPU_NS, used as f64);
        self.note_memory();
    }

    fn note_memory(&self) {
        let (before, now) = (self.before, Resident::now());
        let grown = |before: u64, now: u64| now.saturating_sub(before) as f64;
        let private = grown(before.private, now.private);
        self.log.set(note::PRIVATE, private);
        self.log.set(note::SHARED, grown(before.shared, now.shared));
    }
}

/// Runs the parts to their ends.
///
/// # Errors
/// If a process cannot be had, a part failed or died, or all took longer than [`LIMIT`].
pub fn perform(shared: &Shared, parts: Vec<Part<'_>>) -> io::Result<()> {
    perform_within(LIMIT, shared, parts)
}

/// As [`perform`], with a limit of its own.
///
/// # Errors
/// As [`perform`].
pub fn perform_within(limit: Duration, shared: &Shared, parts: Vec<Part<'_>>) -> io::Result<()> {
    assert!(parts.len() <= PARTS);
    let mut children = Vec::with_capacity(parts.len());
    for (number, part) in parts.into_iter().enumerate() {
        // On an error those that run already are killed when `children` is dropped.
        children.push(Child::start(part.cpu, || play(shared, number, part.run))?);
    }
    let outcome = watch(&mut children, limit);
    // All before the first is waited for: under SCHED_FIFO one that spins keeps another from dying.
    children.iter().for_each(Child::kill_now);
    drop(children);
    outcome.map_err(|error| {
        let said = (0..PARTS).map(|number| shared.log(number).said());
        said.into_iter()
            .find(|text| !text.is_empty())
            .map_or(error, io::Error::other)
    })
}

/// What a part does in its own process. Whether it came to its end.
fn play(shared: &Shared, number: usize, run: Run<'_>) -> bool {
    // The message goes to the parent, not to the terminal.
    std::panic::set_hook(Box::new(|_| {}));
    shared.touch();
    // The first look takes memory itself.
    Resident::now();
    let mut role = Role {
        shared,
        log: shared.log(number),
        cpu_at_begin: 0,
        before: Resident::now(),
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

/// Waits until all have ended well.
fn watch(children: &mut [Child], limit: Duration) -> io::Result<()> {
    let until = monotonic_ns() + limit.as_nanos() as u64;
    while children.iter().any(Child::is_running) {
        let mut fds: Vec<_> = children
            .iter()
            .filter(|child| child.is_running())
            .map(|child| libc::pollfd {
                fd: child.pidfd,
                events: libc::POLLIN,
                revents: 0,
            })
            .collect();
        let left_ms = until.saturating_sub(monotonic_ns()) / 1_000_000;
        if left_ms == 0 {
            let seconds = limit.as_secs_f32();
            let text = format!("it did not end within {seconds} s");
            return Err(io::Error::new(io::ErrorKind::TimedOut, text));
        }
        // SAFETY: `fds` is a valid array of this length. A signal (Ctrl-C) only ends the wait.
        unsafe { libc::poll(fds.as_mut_ptr(), fds.len() as libc::nfds_t, left_ms as i32) };
        for child in children.iter_mut() {
            child.look()?;
        }
    }
    Ok(())
}

/// Forks this process: 0 in the child, its id in the parent. The child has to leave by `_exit`.
///
/// # Errors
/// If there is no process to be had, or this one has more than one thread: another thread may hold
/// a lock, for example of the allocator, which no thread of the child would ever release.
pub fn fork() -> io::Result<libc::pid_t> {
    if fs::read_dir("/proc/self/task")?.count() != 1 {
        return Err(io::Error::other("a process with threads is not forked"));
    }
    // SAFETY: this process has one thread, so the child is a whole copy of it.
    match unsafe { libc::fork() } {
        -1 => Err(io::Error::last_os_error()),
        pid => Ok(pid),
    }
}

/// A process of our own; it is killed when this is dropped.
pub struct Child {
    pid: libc::pid_t,
    pidfd: i32,
    running: bool,
}

impl Child {
    /// Runs `body` in a child process on this CPU; it ends with status 0 if that returns true.
    ///
    /// # Errors
    /// If there is no process to be had, or this one has more than one thread.
    pub fn start(cpu: usize, body: impl FnOnce() -> bool) -> io::Result<Self> {
        // SAFETY: takes no pointer.
        let parent = unsafe { libc::getpid() };
        let pid = fork()?;
        if pid == 0 {
            // SAFETY: only sets this process's own death signal and its own answer to Ctrl-C: the
            // parent ends the batch. A parent that died before would never be told.
            unsafe {
                libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL);
                libc::signal(libc::SIGINT, libc::SIG_IGN);
                if libc::getppid() != parent {
                    libc::_exit(1);
                }
            }
            pin(cpu);
            if REALTIME.load(Ordering::Relaxed) {
                set_fifo(PRIORITIES[1]);
            }
            let done = catch_unwind(AssertUnwindSafe(body)).unwrap_or(false);
            // SAFETY: ends the child without running the parent's exit handlers.
            unsafe { libc::_exit(i32::from(!done)) };
        }
        // SAFETY: takes no pointer; `pid` is our child and not waited for yet.
        let pidfd = unsafe { libc::syscall(libc::SYS_pidfd_open, pid, 0) } as i32;
        let child = Self {
            pid,
            pidfd,
            running: true,
        };
        if pidfd < 0 {
            return Err(io::Error::last_os_error());
        }
        Ok(child)
    }

    /// Whether it was running at the last check.
    #[must_use]
    pub const fn is_running(&self) -> bool {
        self.running
    }

    /// Checks whether it has ended. Never blocks.
    fn look(&mut self) -> io::Result<()> {
        self.reap(libc::WNOHANG)
    }

    /// Waits until it has ended.
    ///
    /// # Errors
    /// If it did not end well.
    pub fn join(mut self) -> io::Result<()> {
        self.reap(0)
    }

    /// Kills it (-9) and waits until it is gone.
    pub fn kill(self) {
        drop(self);
    }

    fn kill_now(&self) {
        if self.running {
            // SAFETY: the child is ours and not waited for yet.
            unsafe { libc::kill(self.pid, libc::SIGKILL) };
        }
    }

    fn reap(&mut self, options: i32) -> io::Result<()> {
        let mut status = 0;
        // SAFETY: `status` is a valid place; the child is ours and not waited for yet.
        if self.running && unsafe { libc::waitpid(self.pid, &mut status, options) } == self.pid {
            self.running = false;
            if status != 0 {
                return Err(io::Error::other("one end of the measurement died"));
            }
        }
        Ok(())
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        self.kill_now();
        // Nothing is to be waited for if it was not running.
        let _ = self.reap(0);
        if self.pidfd >= 0 {
            // SAFETY: the descriptor is ours and not used after this.
            unsafe { libc::close(self.pidfd) };
        }
    }
}

/// Pins the calling thread to a CPU.
pub fn pin(cpu: usize) {
    core_affinity::set_for_current(core_affinity::CoreId { id: cpu });
}

/// Memory of this process that is in use, in bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Resident {
    private: u64,
    shared: u64,
}

impl Resident {
    fn now() -> Self {
        fs::read_to_string("/proc/self/smaps").map_or(Self::default(), |text| Self::parse(&text))
    }

    /// Sums the anonymous memory, and what is resident of shared mappings (their permissions end in
    /// `s`): see proc_pid_smaps(5).
    fn parse(smaps: &str) -> Self {
        let mut sum = Self::default();
        let mut is_shared = false;
        for line in smaps.lines() {
            let mut fields = line.split_whitespace();
            let (Some(key), Some(value)) = (fields.next(), fields.next()) else {
                continue;
            };
            let bytes = || value.parse::<u64>().map_or(0, |kib| kib * 1024);
            match key {
                "Rss:" if is_shared => sum.shared += bytes(),
                "Anonymous:" if !is_shared => sum.private += bytes(),
                _ if !key.ends_with(':') => is_shared = value.ends_with('s'),
                _ => {}
            }
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shared_and_private_memory_are_told_apart() {
        let smaps = "\
55e0-55f0 r-xp 00000000 08:01 17 /bin/x
Rss:                 100 kB
Anonymous:             0 kB
7f00-7f10 rw-p 00000000 00:00 0
Rss:                  12 kB
Anonymous:             8 kB
VmFlags: rd wr
7f20-7f30 rw-s 00000000 00:01 5 /dev/shm/lmu
Rss:                  32 kB
Anonymous:             0 kB
";
        let expected = Resident {
            private: 8 << 10,
            shared: 32 << 10,
        };
        assert_eq!(Resident::parse(smaps), expected);
    }
}
