//! Several processes that contend for a lock all the time: how long each waits, and how fair it is.

use crate::clock::{from_ns, ticks, to_ps};
use crate::harness::{Batch, BatchPlan, give_way};
use crate::shared::SharedPage;
use crate::worker::{BatchPart, Child, PartContext, perform};
use std::io;
use std::sync::atomic::{AtomicU32, Ordering};

/// One process's access to the critical section.
pub trait Exclusion {
    /// Enters the critical section, runs `stay` in it, and leaves.
    fn inside(&mut self, stay: impl FnOnce());
}

/// `processes` (2 or 3) contend for as many microseconds as the plan has rounds. The first and the
/// third share the near CPU. A sample is the time from the request to the entry. Each stay adds 1
/// to a shared word, which must equal the number of stays at the end.
///
/// # Errors
/// If the processes or the shared memory cannot be created, an end failed, or two were inside at
/// once.
pub fn contended<E: Exclusion>(
    plan: &BatchPlan,
    shared: &SharedPage,
    processes: usize,
    enter: impl Fn(usize) -> E,
) -> io::Result<Batch> {
    let span = from_ns(1_000 * plan.rounds as u64);
    let enter = &enter;
    let part = |core: usize| {
        BatchPart::on(plan.cpus[core % 2], move |role: &mut PartContext<'_>| {
            let mut exclusion = enter(core);
            let word = &role.shared.guarded;
            role.shared.meet(processes as u32);
            role.begin();
            let (begin, mut stays, mut longest) = (ticks(), 0u32, 0);
            loop {
                let wanted = ticks();
                let mut waited = 0;
                exclusion.inside(|| {
                    waited = ticks().wrapping_sub(wanted);
                    // Not one atomic addition: the lock must exclude the other processes between
                    // the load and the store.
                    word.store(word.load(Ordering::Relaxed) + 1, Ordering::Relaxed);
                });
                stays += 1;
                longest = longest.max(waited);
                role.log.push(0, waited);
                if ticks().wrapping_sub(begin) >= span {
                    break;
                }
            }
            role.end();
            role.log.note(0, f64::from(stays));
            role.log.note(1, to_ps(longest) as f64 / 1e3);
            Ok(())
        })
    };
    perform(shared, (0..processes).map(part).collect())?;
    let stays: Vec<f64> = (0..processes).map(|n| shared.log(n).noted(0)).collect();
    let all: f64 = stays.iter().sum();
    if f64::from(shared.guarded.load(Ordering::Relaxed)) != all {
        return Err(io::Error::other("two were inside at once"));
    }
    let longest = (0..processes).map(|n| shared.log(n).noted(1));
    let batch = Batch::collect(shared, processes, all as usize).carrying(0);
    Ok(batch
        .with_fact("share of the least served, 1 is fair", least_share(&stays))
        .with_fact("longest wait, ns", longest.fold(0.0, f64::max))
        .with_fact("stays per second", all * 1e6 / plan.rounds as f64))
}

/// An owner takes the lock and is killed (-9) while another process on another CPU waits for it. A
/// sample is the time from the kill until the other process has locked and unlocked; the kernel
/// uses most of it. `own` creates the access of owner `n`; `bury` reports that owner `n` has died.
/// `take` creates a function that locks, unlocks, and returns whether the last owner had died.
pub(crate) fn recovered<E: Exclusion, F: FnMut() -> bool>(
    plan: &BatchPlan,
    shared: &SharedPage,
    own: impl Fn(u32) -> E,
    bury: impl Fn(u32),
    take: impl FnOnce() -> F,
) -> io::Result<Batch> {
    let [held, killed, taken] = shared.spare.each_ref();
    let wait_for = |word: &AtomicU32, value| {
        while word.load(Ordering::Acquire) != value {
            give_way();
        }
    };
    let deaths = (plan.warm_up + plan.rounds) as u32;
    let supervisor = BatchPart::on(plan.cpus[0], |role| {
        role.shared.meet(2);
        for death in 1..=deaths {
            let owner = Child::start(plan.cpus[0], || {
                own(death).inside(|| {
                    held.store(death, Ordering::Release);
                    loop {
                        // SAFETY: the call has no pointer. The owner sleeps until it is killed.
                        unsafe { libc::pause() };
                    }
                });
                false
            })?;
            wait_for(held, death);
            // The waiter gets time to notice that the lock is held, and to back off.
            std::thread::sleep(std::time::Duration::from_micros(100));
            killed.store(ticks(), Ordering::Relaxed);
            drop(owner);
            bury(death);
            wait_for(taken, death);
        }
        Ok(())
    });
    let waiter = BatchPart::on(plan.cpus[1], |role| {
        let mut take = take();
        role.shared.meet(2);
        for death in 1..=deaths {
            wait_for(held, death);
            let is_recovered = take();
            let now = ticks();
            if !is_recovered {
                return Err(io::Error::other("it was taken from a living owner"));
            }
            if death as usize > plan.warm_up {
                let since = killed.load(Ordering::Relaxed);
                role.log.push(0, now.wrapping_sub(since));
            }
            taken.store(death, Ordering::Release);
        }
        Ok(())
    });
    perform(shared, vec![supervisor, waiter])?;
    Ok(Batch::collect(shared, 2, plan.rounds).carrying(0))
}

/// Returns the smallest share of a process, divided by the fair share: 1 if all are equal, 0 if one
/// never enters.
fn least_share(served: &[f64]) -> f64 {
    let all: f64 = served.iter().sum();
    let least = served.iter().copied().fold(f64::INFINITY, f64::min);
    if all > 0.0 {
        least * served.len() as f64 / all
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_served_is_measured_by_its_fair_share() {
        assert_eq!(least_share(&[5.0, 5.0, 5.0]), 1.0);
        assert_eq!(least_share(&[30.0, 10.0]), 0.5);
        assert_eq!(least_share(&[7.0, 0.0, 5.0]), 0.0);
        assert_eq!(least_share(&[0.0, 0.0]), 0.0);
    }
}
