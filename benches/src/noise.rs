//! The machine's own noise: the pauses of a program that only reads the clock.

use crate::clock::{from_ns, monotonic_ns, ps_per_tick, sleep_until, step_ticks, ticks, to_ps};
use crate::harness::{Batch, BatchPlan, alone};
use crate::shared::SharedPage;
use std::io;

/// Length of a window of the spin, ns; each window gives one sample.
const WINDOW_NS: u64 = 100_000;
/// A longer pause between two time stamps is not caused by the loop itself, ns.
const GAP_NS: u64 = 1_000;

/// Reads the clock again and again on this CPU. If two readings lie far apart, an interrupt,
/// another process or the hypervisor ran between them. A sample is the longest pause within 100 us;
/// all pauses above 1 us are counted.
pub(crate) fn gaps(plan: &BatchPlan, cpu: usize) -> io::Result<Batch> {
    let shared = SharedPage::new()?;
    alone(cpu, &shared, |role| {
        let (window, limit) = (from_ns(WINDOW_NS), from_ns(GAP_NS));
        let (mut count, mut longest_of_all, mut lost, mut spanned) = (0u32, 0, 0u64, 0u64);
        for _ in 0..plan.rounds {
            let begin = ticks();
            let (mut last, mut longest) = (begin, 0);
            while last.wrapping_sub(begin) < window {
                let now = ticks();
                let pause = now.wrapping_sub(last);
                longest = longest.max(pause);
                if pause > limit {
                    count += 1;
                    lost += u64::from(pause);
                }
                last = now;
            }
            longest_of_all = longest.max(longest_of_all);
            spanned += u64::from(last.wrapping_sub(begin));
            role.log.push(0, longest);
        }
        let (count, spanned) = (f64::from(count), spanned as f64);
        role.log.note(0, count * 1e12 / (spanned * ps_per_tick()));
        role.log.note(1, to_ps(longest_of_all) as f64 / 1e3);
        role.log.note(2, lost as f64 / spanned);
    })?;
    let noted = |at| shared.log(0).noted(at);
    Ok(Batch::collect(&shared, 1, 1)
        .carrying(0)
        .with_fact("gaps above 1 us per second", noted(0))
        .with_fact("longest gap, ns", noted(1))
        .with_fact("lost share of the time", noted(2))
        .with_fact("step of the clock, ns", to_ps(step_ticks()) as f64 / 1e3))
}

/// Sleeps until a time 500 us ahead, again and again. A sample is how late the sleep ends.
pub(crate) fn timer(plan: &BatchPlan) -> io::Result<Batch> {
    const PERIOD_NS: u64 = 500_000;
    let shared = SharedPage::new()?;
    alone(plan.cpus[0], &shared, |role| {
        for _ in 0..plan.rounds {
            let due = monotonic_ns() + PERIOD_NS;
            sleep_until(due);
            let late_ns = monotonic_ns().saturating_sub(due);
            role.log.push(0, from_ns(late_ns));
        }
    })?;
    Ok(Batch::collect(&shared, 1, 1).carrying(0))
}
