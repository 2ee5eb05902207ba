//! The mutex of the POSIX threads in shared memory, plain and robust: see pthread_mutex_lock(3p)
//! and pthread_mutexattr_setrobust(3).

use crate::clock::ticks;
use crate::floor::cas::CHUNK;
use crate::harness::{Batch, Plan, alone};
use crate::mutual_exclusion::{Exclusion, contended};
use crate::shared::Shared;
use crate::worker::{Child, Part, perform};
use std::io;
use std::sync::atomic::Ordering;

/// Whether the death of an owner is told to the next taker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Death {
    /// It is not: the mutex stays locked.
    Fatal,
    /// The kernel unlocks it, and the next taker is told (PTHREAD_MUTEX_ROBUST).
    Robust,
}

/// A mutex that lies in the first words of the case, shared between processes.
#[derive(Clone, Copy)]
struct Mutex(*mut libc::pthread_mutex_t);

impl Mutex {
    /// Makes it; once for all processes.
    fn create(shared: &Shared, death: Death) -> Self {
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

    /// Takes it; `true` if its last owner died with it.
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

/// Taking and giving back a mutex that no other process wants.
///
/// # Errors
/// As [`alone`].
pub fn mutex(plan: &Plan, death: Death) -> io::Result<Batch> {
    let prepare = |shared: &Shared| Ok(Mutex::create(shared, death));
    alone(plan, CHUNK, 64, prepare, |mutex| {
        mutex.lock();
        mutex.unlock();
    })
}

/// `processes` want it all the time.
///
/// # Errors
/// As [`contended`].
pub fn contended_mutex(plan: &Plan, processes: usize, death: Death) -> io::Result<Batch> {
    let shared = Shared::new()?;
    let mutex = Mutex::create(&shared, death);
    contended(plan, &shared, processes, 64, |_| mutex)
}

/// An owner takes the robust mutex and is killed (-9) while another process waits for it. A sample
/// is the time from the kill to the taker's turn: it is the kernel that sees the death, so there
/// is no announcement to count from.
///
/// # Errors
/// If the processes or the shared memory cannot be had, or an end failed.
pub fn mutex_recovery(plan: &Plan) -> io::Result<Batch> {
    let shared = Shared::new()?;
    let mutex = Mutex::create(&shared, Death::Robust);
    let [held, killed, recovered] = [8, 10, 12].map(|line| shared.line(line));
    let wait_for = |word: &std::sync::atomic::AtomicU32, value| {
        while word.load(Ordering::Acquire) != value {
            crate::harness::give_way();
        }
    };
    let deaths = (plan.warm_up + plan.rounds) as u32;
    let supervisor = Part::on(plan.cpus[0], move |role| {
        role.shared.meet(2);
        for death in 1..=deaths {
            let owner = Child::start(plan.cpus[0], || {
                mutex.lock();
                held.store(death, Ordering::Release);
                loop {
                    // SAFETY: takes no pointer. The owner sleeps until it is killed.
                    unsafe { libc::pause() };
                }
            })?;
            wait_for(held, death);
            std::thread::sleep(std::time::Duration::from_micros(100));
            killed.store(ticks(), Ordering::Relaxed);
            owner.kill();
            wait_for(recovered, death);
        }
        Ok(())
    });
    let taker = Part::on(plan.cpus[1], move |role| {
        role.shared.meet(2);
        for death in 1..=deaths {
            wait_for(held, death);
            let died = mutex.lock();
            let now = ticks();
            mutex.unlock();
            if !died {
                return Err(io::Error::other("the mutex was taken from a living owner"));
            }
            if death as usize > plan.warm_up {
                let since = killed.load(Ordering::Relaxed);
                role.log.push(0, now.wrapping_sub(since));
            }
            recovered.store(death, Ordering::Release);
        }
        Ok(())
    });
    perform(&shared, vec![supervisor, taker])?;
    let mut batch = Batch::collect(&shared, 2, plan.rounds, 64).carrying(0);
    batch.cpu_ns_per_message = None;
    Ok(batch)
}
