//! The outcome of one sequence for the campaign, and the line in which one process reports it to
//! another.

use serde::{Deserialize, Serialize};
use tandem_faults::Kind;
use tandem_record::verdict::Rule;
use tandem_sim::{SequenceState, Tried};

/// The outcome of one sequence.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
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
    /// Of wrong values: the time from the fault to the finding, ns, and the offset from the lane,
    /// m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) found_ns: Option<u64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) aside_m: Option<f64>,
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
            found_ns: trial.found.map(|found| found.after.as_ns()),
            aside_m: trial.aside_m,
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
