//! The judge of a campaign: what must hold under any faults on any board.

use crate::entry::Fault;
use crate::sequence::Sequence;
use tandem_record::verdict::{Finding, Rule};
use tandem_vehicle::gate::Acceptance;
use tandem_vehicle::mastership::Mastership;

/// Changes of the driver that one fault explains: away, and back when its consequence shows.
const CHANGES_OF_A_FAULT: usize = 2;

/// What a campaign observed during a sequence of faults.
#[derive(Clone, Copy, Debug)]
pub struct Observed<'e> {
    /// The faults.
    pub faults: &'e [Fault],
    /// The control frames that acted, in order.
    pub acted: &'e [Acceptance],
    /// Changes of the driver that only the faults can explain.
    pub changes: usize,
    /// Collisions that the vehicle caused.
    pub collisions: usize,
}

impl Observed<'_> {
    /// Returns the rules that are broken.
    #[must_use]
    pub fn findings(&self) -> Vec<Finding> {
        let mut mastership = Mastership::default();
        for frame in self.acted {
            mastership.accept(frame.at_ns, frame.system, frame.term);
        }
        let is_old = |pair: &&[Acceptance]| {
            let same = pair[0].term == pair[1].term;
            pair[1].term < pair[0].term || (same && pair[0].system != pair[1].system)
        };
        let old_terms = self.acted.windows(2).filter(is_old).count();
        let most_changes = CHANGES_OF_A_FAULT * self.faults.len() + 1;
        // Two faults may together end a mastership that neither would end alone.
        let spared = matches!(self.faults, [one] if one.spares_the_master());
        let needless = if spared { self.changes } else { 0 };
        let figures = [
            (Rule::OldTerm, old_terms as f64, 0.0),
            (
                Rule::TwoMasters,
                mastership.two_masters_ns() as f64 * 1e-6,
                0.0,
            ),
            (Rule::Changes, self.changes as f64, most_changes as f64),
            (Rule::Needless, needless as f64, 0.0),
            (Rule::Collision, self.collisions as f64, 0.0),
        ];
        let broken = figures.into_iter().filter(|(_, is, most)| is > most);
        let words = |rule: Rule, is, most| format!("{}: {is}, at most {most}", rule.row().words);
        broken
            .map(|(rule, is, most)| Finding::new(rule, [is, most], words(rule, is, most)))
            .collect()
    }
}

/// Why these faults are known to break this rule (`docs/redundancy.md`); `None` if they must not.
#[must_use]
pub fn known(sequence: &Sequence, rule: Rule) -> Option<&'static str> {
    (rule == Rule::Changes && sequence.spoils_frames_of_both())
        .then_some("frames of both systems are lost or wrong, so each relieves the other rightly")
}
