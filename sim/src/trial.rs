//! A sequence of faults on the simulated machine.

use crate::bench::{Bench, Profile};
pub use crate::sequence_judge::Tried;
use crate::sequence_judge::longest_gap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use tandem_faults::Sequence;
use tandem_record::verdict::Rule;

/// After its faults, a sequence runs until master and standby are stable. A sequence whose number
/// is a multiple of this always runs for the whole time of [`Bench::settles_within`].
const HEALS_WHOLLY: u64 = 16;

impl Profile {
    /// Runs a sequence. `keeps_events`: whether to keep the events of the cores.
    #[must_use]
    pub fn run(self, sequence: &Sequence, keeps_events: bool) -> (Tried, Bench) {
        if let Some(setting) = sequence.setting {
            return self.run_values(sequence, setting, keeps_events);
        }
        let mut bench = Bench::suffering(self, &sequence.faults, 0, keeps_events);
        if sequence.from_power_on {
            bench.power_on();
        } else {
            bench.reach_dual();
        }
        bench.pair.reseed(sequence.number);
        let begin = bench.pair.now();
        bench.suffer(&sequence.faults, sequence.span);
        let restored = bench.pair.now();
        bench.heal(sequence.number.is_multiple_of(HEALS_WHOLLY));
        let bound = sequence.bound(&self.bounds());
        let bound = bound.map(|(_, bound)| bound + self.time.allowance());
        let mut trial = bench.judge(&sequence.faults, [begin, restored], bound);
        if let Some((until, bound)) = sequence.bound_while_one_is_sound(&self.bounds()) {
            let accepted = &bench.vehicle.borrow().accepted;
            let gap = longest_gap(accepted, begin, begin + until.min(sequence.span));
            let is_too_long = gap > bound + self.time.allowance();
            trial.violations.extend(is_too_long.then_some(Rule::Gap));
        }
        trial.violations.extend(bench.judge_roles(bound.is_some()));
        (trial, bench)
    }

    /// Removes faults from a sequence until each one left is needed to violate this rule.
    #[must_use]
    pub fn shrunk(self, sequence: &Sequence, rule: Rule) -> Sequence {
        let mut least = sequence.clone();
        while let Some(shorter) = (0..least.faults.len()).find_map(|index| {
            let mut shorter = least.clone();
            shorter.faults.remove(index);
            let breaks = self.try_run(&shorter).violations.contains(&rule);
            (breaks && !shorter.faults.is_empty()).then_some(shorter)
        }) {
            least = shorter;
        }
        least
    }

    /// Runs a sequence. A panic counts as a violation.
    #[must_use]
    pub fn try_run(self, sequence: &Sequence) -> Tried {
        let run = AssertUnwindSafe(|| self.run(sequence, false).0);
        catch_unwind(run).unwrap_or_else(|_| Tried {
            violations: vec![Rule::Panic],
            ..Tried::default()
        })
    }
}
