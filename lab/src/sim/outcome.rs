//! The outcome of one sequence for the campaign, and the line in which one process reports it to
//! another.

use serde::{Deserialize, Serialize};
use tandem_faults::Kind;
use tandem_record::verdict::Rule;
use tandem_sim::{SequenceState, Tried};

/// The outcome of one sequence.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Outcome {
    pub(super) number: u64,
    /// The longest time without control, ns.
    pub(super) gap_ns: u64,
    /// Number of systems that suspended themselves.
    pub(super) suspended: u64,
    /// Virtual time of the run, ns.
    pub(super) simulated_ns: u64,
    /// A digest of all frames and events of the run.
    pub(super) digest: u64,
    pub(super) violations: Vec<Rule>,
    /// The faults and the states of the systems that they hit: the label of the kind, and the
    /// index of the state in [`SequenceState::ALL`].
    pub(super) covered: Vec<(String, usize)>,
}

impl Outcome {
    pub(super) fn new(number: u64, trial: Tried) -> Self {
        let hit = |(kind, state): (Kind, SequenceState)| {
            let state = SequenceState::ALL.iter().position(|it| *it == state)?;
            Some((kind.label(), state))
        };
        Self {
            number,
            gap_ns: trial.gap.as_ns(),
            suspended: trial.suspended as u64,
            simulated_ns: trial.simulated.as_ns(),
            digest: trial.digest,
            violations: trial.violations,
            covered: trial.covered.into_iter().filter_map(hit).collect(),
        }
    }

    /// Returns the line that [`Self::of`] parses.
    pub(super) fn line(&self) -> serde_json::Result<String> {
        Ok(serde_json::to_string(self)? + "\n")
    }

    /// Parses an outcome; `None` if the line does not hold one.
    pub(super) fn of(line: &str) -> Option<Self> {
        serde_json::from_str(line).ok()
    }
}
