//! Alive, deadline and logical supervision of one process. It begins when the process is ready.
//!
//! The three kinds are those of AUTOSAR's platform health management.

use tandem_board::{Duration, Instant};

use tandem_manifest::{DeadlineLimits, LogicalOrder, ProcessPlan};

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
    pub(super) fn begin(plan: &ProcessPlan, now: Instant) -> Self {
        Self {
            cycle_ends: now + plan.alive.map_or(Duration::ZERO, |it| it.every),
            alive: 0,
            wrong_cycles: 0,
            since: vec![None; plan.deadlines.len()],
            last: None,
        }
    }

    pub(super) const fn alive(&mut self) {
        self.alive = self.alive.saturating_add(1);
    }

    pub(super) fn checkpoint(
        &mut self,
        plan: &ProcessPlan,
        number: u32,
        at: Instant,
    ) -> Option<String> {
        let last = self.last.replace(number);
        let is_wrong = |order: &LogicalOrder| match last {
            None => !order.first.contains(&number),
            Some(last) => !order.next.contains(&(last, number)),
        };
        if plan.logical.as_ref().is_some_and(is_wrong) {
            return Some(format!("checkpoint {number} is out of order"));
        }
        for (limits, since) in plan.deadlines.iter().zip(&mut self.since) {
            if limits.to == number
                && let Some(took) = since.take().map(|since| at.since(since))
                && (took < limits.least || took > limits.most)
            {
                return Some(missed(limits));
            }
            if limits.from == number {
                *since = Some(at);
            }
        }
        None
    }

    pub(super) fn tick(&mut self, plan: &ProcessPlan, now: Instant) -> Option<String> {
        for (limits, since) in plan.deadlines.iter().zip(&self.since) {
            if since.is_some_and(|since| now.since(since) > limits.most) {
                return Some(missed(limits));
            }
        }
        let limits = plan.alive.filter(|_| now >= self.cycle_ends)?;
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
        let is_wrong = self.wrong_cycles > limits.tolerated;
        is_wrong.then(|| format!("it was alive {count} times in a cycle"))
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

fn missed(limits: &DeadlineLimits) -> String {
    let DeadlineLimits { from, to, .. } = limits;
    format!("from checkpoint {from} to {to} it was too fast or too slow")
}
