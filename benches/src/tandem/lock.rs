//! The lock: free, contended, and after the death of its owner.

use super::lmu;
use crate::clock::{from_ns, ticks};
use crate::floor::cas::CHUNK;
use crate::harness::{Batch, Plan, give_way, time_chunks};
use crate::mutual_exclusion::{Exclusion, contended};
use crate::shared::Shared;
use crate::worker::{Child, Part, Role, perform};
use std::hint::black_box;
use std::io;
use std::sync::atomic::{AtomicU32, Ordering};
use tandem_shm::incarnation::Incarnation;
use tandem_shm::lock::Lock;
use tandem_shm::map::{Layout, Map};
use tandem_shm::region::{Region, SharedLock};
use tandem_shm::sync::spin;

const LOCK: Region<SharedLock> = Region::first("lock");
const LAYOUT: Layout = LOCK.end();

fn attach(map: &Map<'static>, core: usize, generation: u32) -> Lock<'static> {
    let incarnation = lmu::announce(map, core, generation);
    LOCK.attach(map, incarnation).expect("it fits")
}

/// Taking and giving back a lock that no other core wants.
///
/// # Errors
/// If the process or the shared memory cannot be had.
pub fn free(plan: &Plan) -> io::Result<Batch> {
    let (shared, map) = lmu::shared(LAYOUT)?;
    let part = Part::on(plan.cpus[0], |role| {
        let mut lock = attach(&map, 0, 1);
        time_chunks(plan, CHUNK, role, || {
            black_box(lock.try_lock().is_some());
        });
        Ok(())
    });
    perform(&shared, vec![part])?;
    let batch = Batch::collect(&shared, 1, plan.rounds, lmu::bytes(LAYOUT));
    Ok(batch.per_operation(CHUNK))
}

/// The lock of one core. Beside others on its CPU it gives way when it has waited for a while.
struct Contender {
    lock: Lock<'static>,
    shares_cpu: bool,
}

impl Exclusion for Contender {
    fn inside(&mut self, stay: impl FnOnce()) {
        let shares_cpu = self.shares_cpu;
        let relax = |pause| {
            spin(pause);
            if shares_cpu && pause >= 16 {
                give_way();
            }
        };
        let guard = self.lock.lock(u32::MAX, relax);
        stay();
        drop(guard);
    }
}

/// `processes` cores want the lock all the time.
///
/// # Errors
/// As [`contended`].
pub fn under_contention(plan: &Plan, processes: usize) -> io::Result<Batch> {
    let (shared, map) = lmu::shared(LAYOUT)?;
    contended(plan, &shared, processes, lmu::bytes(LAYOUT), |core| {
        Contender {
            lock: attach(&map, core, 1),
            shares_cpu: processes > 2,
        }
    })
}

const OWNER: usize = 0;
const SUPERVISOR_CPU: usize = 0;
/// Words of the case behind the lock: the generation that holds the lock, the time at which it
/// was killed, and the last generation that was recovered from.
const HELD_AT: usize = lmu::own_words(LAYOUT);
const KILLED_AT: usize = HELD_AT + 16;
const RECOVERED_AT: usize = HELD_AT + 32;

/// An owner takes the lock and is killed (-9); the supervisor, which has seen it end, marks its
/// incarnation as dead; a core that waits on another CPU takes the lock over. A sample is the time
/// from the kill to the guard, as for the robust mutex; most of it is the kernel's.
///
/// # Errors
/// If the processes or the shared memory cannot be had, or an end failed.
pub fn recovery(plan: &Plan) -> io::Result<Batch> {
    let (shared, map) = lmu::shared(LAYOUT)?;
    let deaths = (plan.warm_up + plan.rounds) as u32;
    let supervisor = Part::on(plan.cpus[SUPERVISOR_CPU], |role| {
        role.shared.meet(2);
        (1..=deaths).try_for_each(|generation| one_death(role.shared, &map, plan, generation))
    });
    let taker = Part::on(plan.cpus[1], |role| {
        let mut lock = attach(&map, 1, 1);
        role.shared.meet(2);
        for generation in 1..=deaths {
            take_over(role, plan, &mut lock, generation)?;
        }
        Ok(())
    });
    perform(&shared, vec![supervisor, taker])?;
    let mut batch = Batch::collect(&shared, 2, plan.rounds, lmu::bytes(LAYOUT)).carrying(0);
    batch.cpu_ns_per_message = None;
    Ok(batch)
}

fn word(shared: &Shared, at: usize) -> &'static AtomicU32 {
    &shared.case()[at]
}

fn wait_for(word: &AtomicU32, value: u32, wait: fn()) {
    while word.load(Ordering::Acquire) != value {
        wait();
    }
}

fn one_death(shared: &Shared, map: &Map<'static>, plan: &Plan, generation: u32) -> io::Result<()> {
    let owner = Child::start(plan.cpus[SUPERVISOR_CPU], || {
        let mut lock = attach(map, OWNER, generation);
        let guard = lock.lock(u32::MAX, spin);
        word(shared, HELD_AT).store(generation, Ordering::Release);
        loop {
            // SAFETY: takes no pointer. The owner sleeps until it is killed.
            unsafe { libc::pause() };
            black_box(&guard);
        }
    })?;
    wait_for(word(shared, HELD_AT), generation, give_way);
    // The taker gets time to notice that the lock is held, and to back off.
    let since = ticks();
    while ticks().wrapping_sub(since) < from_ns(20_000) {
        spin(1);
    }
    word(shared, KILLED_AT).store(ticks(), Ordering::Relaxed);
    owner.kill();
    let dead = Incarnation::new(OWNER, generation).expect("an incarnation");
    map.incarnations().mark_dead(dead);
    wait_for(word(shared, RECOVERED_AT), generation, give_way);
    Ok(())
}

fn take_over(
    role: &mut Role<'_>,
    plan: &Plan,
    lock: &mut Lock<'_>,
    generation: u32,
) -> io::Result<()> {
    wait_for(word(role.shared, HELD_AT), generation, || spin(1));
    let acquired = lock.lock(u32::MAX, spin);
    let now = ticks();
    let recovered = acquired.is_ok_and(|acquired| acquired.is_recovered());
    if !recovered {
        return Err(io::Error::other("the lock was taken from a living owner"));
    }
    let killed = word(role.shared, KILLED_AT).load(Ordering::Relaxed);
    if generation as usize > plan.warm_up {
        role.log.push(0, now.wrapping_sub(killed));
    }
    word(role.shared, RECOVERED_AT).store(generation, Ordering::Release);
    Ok(())
}
