//! Activation skew: how far apart two processes on two CPUs begin the same cycle.

use crate::clock::{monotonic_ns, sleep_until};
use crate::harness::{Batch, BatchPlan};
use crate::shared::SharedPage;
use crate::worker::{BatchPart, ask_for_fifo, perform};
use std::hint::spin_loop;
use std::io;

/// Period of the cycles, ns.
const PERIOD_NS: u64 = 1_000_000;
/// The last part of a wait that may be spent spinning, ns.
pub(crate) const SPIN_NS: u64 = 100_000;

/// Two processes that sleep with `clock_nanosleep` until the same instants, and spin for the last
/// `spin_ns`: what no synchronisation can improve.
pub(crate) fn floor(plan: &BatchPlan, spin_ns: u64) -> io::Result<Batch> {
    let shared = SharedPage::new()?;
    let begin_ns = monotonic_ns() + 20 * PERIOD_NS;
    let part = |cpu: usize| {
        BatchPart::on(plan.cpus[cpu], move |role| {
            ask_for_fifo();
            for cycle in 0..(plan.warm_up + plan.rounds) as u64 {
                let due_ns = begin_ns + cycle * PERIOD_NS;
                sleep_until(due_ns - spin_ns);
                while monotonic_ns() < due_ns {
                    spin_loop();
                }
                let late_ns = monotonic_ns() - due_ns;
                if cycle >= plan.warm_up as u64 {
                    role.log.push(0, u32::try_from(late_ns).unwrap_or(u32::MAX));
                }
            }
            Ok(())
        })
    };
    perform(&shared, vec![part(0), part(1)])?;
    Ok(skew_of(&shared))
}

/// The difference between both processes' lateness in each cycle; parts 0 and 1 have logged it, ns.
pub(crate) fn skew_of(shared: &SharedPage) -> Batch {
    let [first, second] = [0, 1].map(|number| shared.log(number));
    let both = first.samples(0).zip(second.samples(0));
    let (mut samples_ps, mut late_ns) = (vec![], 0);
    for (a, b) in both {
        // 0 would be below the clock's resolution.
        samples_ps.push(u64::from(a.abs_diff(b)).max(1) * 1000);
        late_ns = a.max(b).max(late_ns);
    }
    Batch {
        samples_ps,
        ..Batch::default()
    }
    .with_fact("longest lateness, us", f64::from(late_ns) / 1e3)
}
