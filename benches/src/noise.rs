//! What the machine does by itself: the pauses of a program that only reads the clock.

use crate::clock::{from_ns, monotonic_ns, sleep_until, step_ticks, ticks, to_ps};
use crate::harness::{Batch, Plan};
use crate::shared::Shared;
use crate::worker::{Part, perform};
use std::io;

/// Windows of the spin; each gives one sample.
const WINDOW_NS: u64 = 100_000;
/// A pause between two time stamps that is longer than this is not the spin's own.
const GAP_NS: u64 = 1_000;

/// Reads the clock again and again on this CPU. Two readings that lie far apart had something
/// between them: an interrupt, another process, the hypervisor. A sample is the longest pause
/// within 100 us; all pauses above 1 us are counted.
///
/// # Errors
/// If the process or the shared memory cannot be had.
pub fn gaps(plan: &Plan, cpu: usize) -> io::Result<Batch> {
    let shared = Shared::new()?;
    let part = Part::on(cpu, |role| {
        let (window, limit) = (from_ns(WINDOW_NS), from_ns(GAP_NS));
        let mut gaps = Gaps::default();
        for _ in 0..plan.rounds {
            let begin = ticks();
            let (mut last, mut longest) = (begin, 0);
            while last.wrapping_sub(begin) < window {
                let now = ticks();
                let pause = now.wrapping_sub(last);
                longest = longest.max(pause);
                if pause > limit {
                    gaps.add(pause);
                }
                last = now;
            }
            gaps.spanned += u64::from(last.wrapping_sub(begin));
            role.log.push(0, longest);
        }
        role.log.note(0, gaps.per_second());
        role.log.note(1, to_ps(gaps.longest) as f64 / 1e3);
        role.log.note(2, gaps.share());
        Ok(())
    });
    perform(&shared, vec![part])?;
    let log = shared.log(0);
    Ok(bare(Batch::collect(&shared, 1, plan.rounds, 0))
        .with_fact("gaps above 1 us per second", log.noted(0))
        .with_fact("longest gap, ns", log.noted(1))
        .with_fact("lost share of the time", log.noted(2))
        .with_fact("step of the clock, ns", to_ps(step_ticks()) as f64 / 1e3))
}

/// Without what has no meaning where no message goes.
fn bare(batch: Batch) -> Batch {
    Batch {
        cpu_ns_per_message: None,
        memory_bytes: None,
        payload_bytes: 0,
        ..batch
    }
}

/// All long pauses of a spin, in ticks.
#[derive(Clone, Copy, Debug, Default)]
struct Gaps {
    count: u32,
    longest: u32,
    lost: u64,
    spanned: u64,
}

impl Gaps {
    fn add(&mut self, pause: u32) {
        self.count += 1;
        self.longest = self.longest.max(pause);
        self.lost += u64::from(pause);
    }

    fn per_second(&self) -> f64 {
        let spanned_ps = self.spanned as f64 * crate::clock::ps_per_tick();
        f64::from(self.count) * 1e12 / spanned_ps.max(1.0)
    }

    fn share(&self) -> f64 {
        self.lost as f64 / self.spanned.max(1) as f64
    }
}

/// Sleeps until a point in time 500 us ahead, again and again. A sample is how late the sleep ends.
///
/// # Errors
/// If the process or the shared memory cannot be had.
pub fn timer(plan: &Plan) -> io::Result<Batch> {
    const PERIOD_NS: u64 = 500_000;
    let shared = Shared::new()?;
    let part = Part::on(plan.cpus[0], |role| {
        for _ in 0..plan.rounds {
            let due = monotonic_ns() + PERIOD_NS;
            sleep_until(due);
            role.log
                .push(0, from_ns(monotonic_ns().saturating_sub(due)));
        }
        Ok(())
    });
    perform(&shared, vec![part])?;
    Ok(bare(Batch::collect(&shared, 1, plan.rounds, 0)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_add_up() {
        let second = (1e12 / crate::clock::ps_per_tick()) as u64;
        let mut gaps = Gaps::default();
        for pause in [second / 10, second / 5] {
            gaps.add(pause as u32);
        }
        gaps.spanned = 2 * second;
        assert!((gaps.per_second() - 1.0).abs() < 1e-3);
        assert!((gaps.share() - 0.15).abs() < 1e-3);
        assert_eq!(u64::from(gaps.longest), second / 5);
    }
}
