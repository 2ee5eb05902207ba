//! Runs real processes that share memory, as the host implements an LMU, but without a board.

use std::panic::{AssertUnwindSafe, catch_unwind};

use tandem_shm::incarnation::{Incarnation, Incarnations};
use tandem_shm::lock::{Acquired, Lock};
use tandem_shm::sync::{AtomicU32, Ordering, spin};

/// Longest lifetime of a child, in seconds: a watchdog that ends a test that hangs.
const WATCHDOG_S: u32 = 120;

/// Returns zeroed words that all children share. They exist until the test process ends.
pub(crate) fn shared(words: usize) -> &'static [AtomicU32] {
    let bytes = words * 4;
    // SAFETY: a new anonymous mapping, page-aligned and zeroed, never unmapped; atomics have
    // interior mutability, so other processes may write to it.
    unsafe {
        let at = libc::mmap(
            core::ptr::null_mut(),
            bytes,
            libc::PROT_READ | libc::PROT_WRITE,
            libc::MAP_SHARED | libc::MAP_ANONYMOUS,
            -1,
            0,
        );
        assert_ne!(at, libc::MAP_FAILED);
        core::slice::from_raw_parts(at.cast(), words)
    }
}

/// A child process; killed when it is dropped.
pub(crate) struct Child(libc::pid_t);

impl Child {
    /// Runs `f` in a child process, which ends when `f` returns.
    ///
    /// # Panics
    /// If this process has another thread. That thread may hold a lock, for example of the
    /// allocator, which no thread of the child would ever release.
    pub(crate) fn start(f: impl FnOnce()) -> Self {
        let threads = std::fs::read_dir("/proc/self/task").unwrap().count();
        assert_eq!(threads, 1, "only a process with one thread is forked");
        // SAFETY: this process has one thread, so the child is a complete copy of it: no lock is
        // held by a thread that the child lacks. It ends without running the parent's destructors.
        unsafe {
            let parent = libc::getpid();
            match libc::fork() {
                0 => {
                    libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL);
                    libc::alarm(WATCHDOG_S);
                    if libc::getppid() != parent {
                        libc::_exit(2);
                    }
                    let end = catch_unwind(AssertUnwindSafe(f));
                    libc::_exit(i32::from(end.is_err()))
                }
                pid => {
                    assert!(pid > 0, "fork");
                    Self(pid)
                }
            }
        }
    }

    pub(crate) fn signal(&self, signal: libc::c_int) {
        // SAFETY: sends a signal to a child that has not been waited for.
        unsafe { libc::kill(self.0, signal) };
    }

    /// Waits until the child ends or stops, and returns the status word of `waitpid`.
    fn wait(&self, options: libc::c_int) -> libc::c_int {
        let mut status = 0;
        // SAFETY: waits for a child that has not been waited for.
        let pid = unsafe { libc::waitpid(self.0, &mut status, options) };
        assert_eq!(pid, self.0);
        status
    }

    /// Returns whether the child still runs.
    pub(crate) fn is_running(&self) -> bool {
        // SAFETY: an all-zero `siginfo_t` is valid; `waitid` fills it, and with WNOWAIT the child
        // can be waited for again.
        unsafe {
            let mut info: libc::siginfo_t = core::mem::zeroed();
            let options = libc::WEXITED | libc::WNOHANG | libc::WNOWAIT;
            libc::waitid(libc::P_PID, self.0 as libc::id_t, &mut info, options);
            info.si_pid() == 0
        }
    }

    /// Waits until the child has stopped itself.
    pub(crate) fn wait_stopped(&self) {
        assert!(libc::WIFSTOPPED(self.wait(libc::WUNTRACED)));
    }

    /// Waits until the child ends, and checks that it ended without an error.
    pub(crate) fn join(self) {
        assert_eq!(self.wait(0), 0, "the child failed or its watchdog ended it");
        core::mem::forget(self);
    }

    /// Sends `kill -9`, and waits until the child is dead.
    pub(crate) fn kill(self) {}
}

impl Drop for Child {
    fn drop(&mut self) {
        self.signal(libc::SIGKILL);
        self.wait(0);
    }
}

/// Gives the CPU to another process.
pub(crate) fn give_way() {
    // SAFETY: the call takes no arguments and accesses no memory.
    unsafe { libc::sched_yield() };
}

pub(crate) fn sleep_us(us: u64) {
    std::thread::sleep(std::time::Duration::from_micros(us));
}

/// Waits for the lock without a time limit. The three processes may have to share a CPU.
pub(crate) fn take<'l, 'a>(lock: &'l mut Lock<'a>) -> Acquired<'l, 'a> {
    lock.lock(u32::MAX, |pause| {
        spin(pause);
        if pause >= 16 {
            give_way();
        }
    })
    .unwrap()
}

/// Announces an incarnation in this table and returns it.
pub(crate) fn announce(
    incarnations: Incarnations<'_>,
    core: usize,
    generation: u32,
) -> Incarnation {
    let incarnation = Incarnation::new(core, generation).unwrap();
    incarnations.announce(incarnation).unwrap();
    incarnation
}

/// Waits until `count` processes or threads have arrived here.
pub(crate) fn meet(word: &AtomicU32, count: u32) {
    word.fetch_add(1, Ordering::SeqCst);
    while word.load(Ordering::SeqCst) < count {
        give_way();
    }
}
