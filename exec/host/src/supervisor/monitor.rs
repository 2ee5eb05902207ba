//! Alive, deadline and logical supervision of one process. It begins when the process is ready.
//!
//! The three kinds are those of AUTOSAR's platform health management.

use tandem_board::{Duration, Instant};

use super::ProcessFailure;
use crate::manifest::{AliveLimits, ProcessPlan};

#[derive(Debug)]
pub(super) struct Monitor {
    cycle_ends: Instant,
    alive: u32,
    wrong_cycles: u32,
    /// For each deadline, when its first checkpoint was reached.
    since: Vec<Option<Instant>>,
    last: Option<u32>,
}

impl Monitor {
    /// Returns `None` if the process is not supervised.
    pub(super) fn begin(plan: &ProcessPlan, now: Instant) -> Option<Self> {
        let deadlines = plan.deadlines.len();
        let supervised = plan.alive.is_some() || plan.logical.is_some() || deadlines > 0;
        supervised.then(|| Self {
            cycle_ends: now + plan.alive.map_or(Duration::ZERO, |it| it.every),
            alive: 0,
            wrong_cycles: 0,
            since: vec![None; deadlines],
            last: None,
        })
    }

    pub(super) const fn alive(&mut self) {
        self.alive = self.alive.saturating_add(1);
    }

    pub(super) fn checkpoint(
        &mut self,
        plan: &ProcessPlan,
        number: u32,
        at: Instant,
    ) -> Option<ProcessFailure> {
        let last = self.last.replace(number);
        if let Some(order) = &plan.logical {
            let is_right = match last {
                None => order.first.contains(&number),
                Some(last) => order.next.contains(&(last, number)),
            };
            if !is_right {
                return Some(ProcessFailure::Order(number));
            }
        }
        for (limits, since) in plan.deadlines.iter().zip(&mut self.since) {
            if limits.to == number
                && let Some(since) = since.take()
            {
                let took = at.since(since);
                if took < limits.least || took > limits.most {
                    return Some(ProcessFailure::Deadline(limits.from, limits.to));
                }
            }
            if limits.from == number {
                *since = Some(at);
            }
        }
        None
    }

    pub(super) fn tick(&mut self, plan: &ProcessPlan, now: Instant) -> Option<ProcessFailure> {
        for (limits, since) in plan.deadlines.iter().zip(&self.since) {
            if since.is_some_and(|since| now.since(since) > limits.most) {
                return Some(ProcessFailure::Deadline(limits.from, limits.to));
            }
        }
        self.judge_cycle(plan.alive?, now)
    }

    fn judge_cycle(&mut self, limits: AliveLimits, now: Instant) -> Option<ProcessFailure> {
        if now < self.cycle_ends {
            return None;
        }
        let count = core::mem::take(&mut self.alive);
        if now >= self.cycle_ends + limits.every {
            // The launcher was late by a cycle or more: it does not know when the reports came.
            self.cycle_ends = now + limits.every;
            return None;
        }
        self.cycle_ends += limits.every;
        if (limits.least..=limits.most).contains(&count) {
            self.wrong_cycles = 0;
            return None;
        }
        self.wrong_cycles += 1;
        (self.wrong_cycles > limits.tolerated).then_some(ProcessFailure::Alive(count))
    }

    /// Returns when [`Monitor::tick`] is due.
    pub(super) fn next(&self, plan: &ProcessPlan) -> Instant {
        let cycle = plan.alive.map_or(Instant::NEVER, |_| self.cycle_ends);
        let deadlines = plan.deadlines.iter().zip(&self.since);
        // A deadline is broken when more than its time has passed.
        let due = deadlines
            .filter_map(|(limits, since)| Some((*since)? + limits.most + Duration::from_ns(1)));
        due.fold(cycle, Instant::min)
    }
}
