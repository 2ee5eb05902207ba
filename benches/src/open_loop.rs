//! Messages at a fixed rate, and the mistake that a ping-pong makes.
//!
//! A ping-pong sends the next message when the last one was answered: it is a *closed
//! loop*. When the machine stalls for 10 ms, the sender stalls with it, and of the hundred messages
//! that a real sender would have sent in that time (100 us apart), each of which would have been
//! late, the ping-pong sees one. It asks for the time only when the system is ready to give it;
//! G. Tene calls that *coordinated omission* ("How NOT to measure latency", 2013). Its high
//! percentiles are too good by as much as a stall is longer than a round.
//!
//! Here the sender follows a timetable that nothing shifts (an *open loop*). Message `k` is due at
//! `begin + k * period`, and its latency counts **from when it was due**, not from when it left: if
//! the sender itself was held up, or the message before it, that is time that the receiver had to
//! wait. The same messages counted from when they really left are reported as `naive`, so that one
//! sees what a closed loop hides: with a stall the naive figures stay small where the true ones
//! grow.
//!
//! What is sent may be overtaken by something newer (a signal, a newest value): a message counts as
//! arrived when it or a newer one has.

use crate::clock::{from_ns, ticks, to_ps};
use crate::harness::{Batch, End, Plan};
use crate::shared::Shared;
use crate::worker::{Part, perform};
use std::hint::spin_loop;
use std::io;

/// Distance of the messages: 10 000 a second.
pub const PERIOD_NS: u64 = 100_000;

/// Sends as many messages as the plan has rounds, one each [`PERIOD_NS`]. The sender spins until
/// each is due, on a CPU of its own; CPU time is the receiver's alone.
///
/// # Errors
/// If the processes or the shared memory cannot be had, or an end failed.
pub fn at_fixed_rate<N: End, F: End>(
    plan: &Plan,
    own_bytes: u64,
    near: impl FnOnce(&Shared) -> N,
    far: impl FnOnce(&Shared) -> F,
) -> io::Result<Batch> {
    let shared = Shared::new()?;
    let period = from_ns(PERIOD_NS);
    let messages = (plan.warm_up + plan.rounds) as u32;
    let sender = Part::on(plan.cpus[0], |role| {
        let mut end = near(role.shared);
        role.shared.meet(2);
        let begin = ticks().wrapping_add(period);
        role.log.note(0, f64::from(begin));
        for k in 0..messages {
            let due = begin.wrapping_add(k.wrapping_mul(period));
            while (ticks().wrapping_sub(due) as i32) < 0 {
                spin_loop();
            }
            role.log.push(1, ticks());
            // Never zero, which some ends take for "nothing yet".
            end.send(2 * k + 1);
        }
        Ok(())
    });
    let receiver = Part::on(plan.cpus[1], |role| {
        let mut end = far(role.shared);
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
    let timetable = Timetable {
        begin: shared.log(0).noted(0) as u32,
        period,
    };
    let left: Vec<u32> = shared.log(0).samples(1).collect();
    let arrived: Vec<u32> = shared.log(1).samples(1).collect();
    let mut latencies = timetable.latencies(&left, &arrived);
    latencies.drain(..plan.warm_up.min(latencies.len()));
    let mut batch = Batch::collect(&shared, 2, messages as usize, own_bytes);
    batch.round_trips_ps.clear();
    batch.samples_ps = latencies
        .iter()
        .map(|latency| to_ps(latency.true_))
        .collect();
    let mut naive: Vec<u32> = latencies.iter().map(|latency| latency.naive).collect();
    naive.sort_unstable();
    let at = |quantile: f64| {
        let place = (naive.len().saturating_sub(1)) as f64 * quantile;
        naive
            .get(place as usize)
            .map_or(0.0, |&ticks| to_ps(ticks) as f64 / 1e3)
    };
    Ok(batch
        .with_fact("naive p50, ns", at(0.5))
        .with_fact("naive p99, ns", at(0.99))
        .with_fact("naive p99.9, ns", at(0.999))
        .with_fact("longest naive, ns", at(1.0))
        .with_fact("messages per second", 1e9 / PERIOD_NS as f64))
}

/// When the messages are due, in ticks.
#[derive(Clone, Copy, Debug)]
struct Timetable {
    begin: u32,
    period: u32,
}

/// How late one message was, in ticks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Latency {
    /// From when it was due.
    true_: u32,
    /// From when it left.
    naive: u32,
}

impl Timetable {
    fn latencies(self, left: &[u32], arrived: &[u32]) -> Vec<Latency> {
        let times = left.iter().zip(arrived).enumerate();
        let latency = |(k, (left, arrived)): (usize, (&u32, &u32))| {
            let due = self
                .begin
                .wrapping_add((k as u32).wrapping_mul(self.period));
            Latency {
                true_: arrived.wrapping_sub(due),
                naive: arrived.wrapping_sub(*left),
            }
        };
        times.map(latency).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TIMETABLE: Timetable = Timetable {
        begin: u32::MAX - 99,
        period: 100,
    };

    /// Due at -100, 0, 100, 200 (the clock wraps): each takes 7 from when it leaves.
    #[test]
    fn a_sender_in_time_makes_no_difference() {
        let left = [u32::MAX - 99, 0, 100, 200];
        let arrived = left.map(|left: u32| left.wrapping_add(7));
        for latency in TIMETABLE.latencies(&left, &arrived) {
            assert_eq!((latency.true_, latency.naive), (7, 7));
        }
    }

    /// The sender stalls until 195 and then sends what is overdue at once: the naive latencies do
    /// not show it, the true ones do.
    #[test]
    fn a_stall_counts_for_every_message_that_was_due_in_it() {
        let left = [u32::MAX - 99, 195, 196, 200];
        let arrived = left.map(|left: u32| left.wrapping_add(7));
        let latencies = TIMETABLE.latencies(&left, &arrived);
        let naive: Vec<_> = latencies.iter().map(|latency| latency.naive).collect();
        let true_: Vec<_> = latencies.iter().map(|latency| latency.true_).collect();
        assert_eq!(naive, [7, 7, 7, 7]);
        assert_eq!(true_, [7, 202, 103, 7]);
    }
}
