//! The mutex of the POSIX threads in shared memory, plain and robust: see pthread_mutex_lock(3p)
//! and pthread_mutexattr_setrobust(3).

use crate::floor::CHUNK;
use crate::harness::{Batch, BatchPlan, repeated};
use crate::mutual_exclusion::{Exclusion, contended, recovered};
use crate::shared::SharedPage;
use std::io;

/// Whether the next owner learns that the last one died.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Death {
    /// The next owner is not informed: the mutex stays locked.
    Fatal,
    /// The kernel unlocks it, and the next owner is informed (PTHREAD_MUTEX_ROBUST).
    Robust,
}

/// A mutex in the first words of the case, shared between processes.
#[derive(Clone, Copy)]
struct Mutex(*mut libc::pthread_mutex_t);

impl Mutex {
    /// Creates the mutex, once for all processes.
    fn create(shared: &SharedPage, death: Death) -> Self {
        let mutex = Self(shared.line(0).as_ptr().cast());
        let robust = match death {
            Death::Fatal => libc::PTHREAD_MUTEX_STALLED,
            Death::Robust => libc::PTHREAD_MUTEX_ROBUST,
        };
        // SAFETY: the mutex has enough zeroed and aligned memory (the case has a page), which stays
        // mapped as long as any process of the batch lives; no process uses it before it is made.
        unsafe {
            let mut attributes: libc::pthread_mutexattr_t = std::mem::zeroed();
            libc::pthread_mutexattr_init(&mut attributes);
            libc::pthread_mutexattr_setpshared(&mut attributes, libc::PTHREAD_PROCESS_SHARED);
            libc::pthread_mutexattr_setrobust(&mut attributes, robust);
            libc::pthread_mutex_init(mutex.0, &attributes);
            libc::pthread_mutexattr_destroy(&mut attributes);
        }
        mutex
    }

    /// Locks it. Returns whether its last owner died while it held it.
    fn lock(self) -> bool {
        // SAFETY: the mutex was made and is mapped.
        let died = unsafe { libc::pthread_mutex_lock(self.0) } == libc::EOWNERDEAD;
        if died {
            // SAFETY: as above; the calling thread holds it.
            unsafe { libc::pthread_mutex_consistent(self.0) };
        }
        died
    }

    fn unlock(self) {
        // SAFETY: the mutex was made and is mapped, and the calling thread holds it.
        unsafe { libc::pthread_mutex_unlock(self.0) };
    }
}

impl Exclusion for Mutex {
    fn inside(&mut self, stay: impl FnOnce()) {
        self.lock();
        stay();
        self.unlock();
    }
}

/// Locks and unlocks a mutex that no other process uses.
pub(crate) fn free(plan: &BatchPlan, death: Death) -> io::Result<Batch> {
    let shared = SharedPage::new()?;
    let mutex = Mutex::create(&shared, death);
    repeated(plan, &shared, CHUNK, || {
        || {
            mutex.lock();
            mutex.unlock();
        }
    })
}

/// `processes` contend for it all the time.
pub(crate) fn under_contention(
    plan: &BatchPlan,
    processes: usize,
    death: Death,
) -> io::Result<Batch> {
    let shared = SharedPage::new()?;
    let mutex = Mutex::create(&shared, death);
    contended(plan, &shared, processes, |_| mutex)
}

/// An owner takes the robust mutex and is killed while another process waits for it; the kernel
/// detects the death.
pub(crate) fn recovery(plan: &BatchPlan) -> io::Result<Batch> {
    let shared = SharedPage::new()?;
    let mutex = Mutex::create(&shared, Death::Robust);
    let take = || {
        let died = mutex.lock();
        mutex.unlock();
        died
    };
    recovered(plan, &shared, |_| mutex, |_| (), || take)
}
