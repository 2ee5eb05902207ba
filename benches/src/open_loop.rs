//! Messages at a fixed rate: an *open loop*, because a stall does not change when messages are due.
//! Message `k` is due at `begin + k * period`. Its latency counts from that time; `naive` counts
//! from when it left, and a ping-pong measures only that. G. Tene calls this error *coordinated
//! omission* ("How NOT to measure latency", 2013): docs/performance.md.
//!
//! A newer message may overtake an older one (a signal, a newest value): a message counts as
//! arrived when it or a newer one has arrived.

use crate::clock::{from_ns, ticks, to_ps};
use crate::harness::{Batch, BatchPlan, End};
use crate::shared::SharedPage;
use crate::worker::{BatchPart, perform};
use std::hint::spin_loop;
use std::io;

/// Period of the messages: 10,000 a second.
const PERIOD_NS: u64 = 100_000;

/// Sends as many messages as the plan has rounds, one each [`PERIOD_NS`]. The sender spins until
/// each is due, on its own CPU; CPU time is the receiver's alone.
pub(crate) fn at_fixed_rate<E: End>(
    plan: &BatchPlan,
    end: impl Fn(&SharedPage, [usize; 2]) -> E,
) -> io::Result<Batch> {
    let shared = SharedPage::new()?;
    let period = from_ns(PERIOD_NS);
    let messages = (plan.warm_up + plan.rounds) as u32;
    let sender = BatchPart::on(plan.cpus[0], |role| {
        let mut end = end(role.shared, [0, 1]);
        role.shared.meet(2);
        let begin = ticks().wrapping_add(period);
        role.log.note(0, f64::from(begin));
        for k in 0..messages {
            let due = begin.wrapping_add(k.wrapping_mul(period));
            while (ticks().wrapping_sub(due) as i32) < 0 {
                spin_loop();
            }
            role.log.push(1, ticks());
            // Never zero: for some ends zero means "nothing yet".
            end.send(2 * k + 1);
        }
        Ok(())
    });
    let receiver = BatchPart::on(plan.cpus[1], |role| {
        let mut end = end(role.shared, [1, 0]);
        role.shared.meet(2);
        role.begin();
        let mut next = 0;
        while next < messages {
            let newest = end.receive() / 2;
            let now = ticks();
            for _ in next..=newest {
                role.log.push(1, now);
            }
            next = next.max(newest + 1);
        }
        role.end();
        Ok(())
    });
    perform(&shared, vec![sender, receiver])?;
    let begin = shared.log(0).noted(0) as u32;
    let [left, arrived] = [0, 1].map(|part| shared.log(part).samples(1).collect::<Vec<u32>>());
    let [samples_ps, naive_ps] = latencies([begin, period], &left, &arrived).map(|all| {
        let counting = all.into_iter().skip(plan.warm_up);
        counting.map(to_ps).collect()
    });
    let batch = Batch {
        samples_ps,
        naive_ps,
        round_trips_ps: vec![],
        ..Batch::collect(&shared, 2, messages as usize)
    };
    Ok(batch.with_fact("messages per second", 1e9 / PERIOD_NS as f64))
}

/// Returns each message's latency in ticks: from when it was due, and from when it left.
fn latencies([begin, period]: [u32; 2], left: &[u32], arrived: &[u32]) -> [Vec<u32>; 2] {
    let due = (0..).map(|k: u32| begin.wrapping_add(k.wrapping_mul(period)));
    let from_due = arrived.iter().zip(due);
    [
        from_due.map(|(at, due)| at.wrapping_sub(due)).collect(),
        arrived
            .iter()
            .zip(left)
            .map(|(at, left)| at.wrapping_sub(*left))
            .collect(),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Due at -100, 0, 100, 200 (the clock wraps); each arrives 7 after it leaves. A sender that
    /// stalls until 195 sends all overdue messages at once: only the true latencies show this.
    #[test]
    fn a_stall_counts_for_every_message_that_was_due_in_it() {
        const BEGIN: u32 = u32::MAX - 99;
        for (left, expected) in [
            ([BEGIN, 0, 100, 200], [7, 7, 7, 7]),
            ([BEGIN, 195, 196, 200], [7, 202, 103, 7]),
        ] {
            let arrived = left.map(|left: u32| left.wrapping_add(7));
            let [from_due, naive] = latencies([BEGIN, 100], &left, &arrived);
            assert_eq!((&from_due[..], &naive[..]), (&expected[..], &[7; 4][..]));
        }
    }
}
