//! Counts which faults have hit a system in which state.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use serde_json::{Value, json};
use tandem_board::RoleLamp;
use tandem_faults::Kind;
use tandem_sim::SequenceState;

use super::outcome::Outcome;

const STATES: usize = SequenceState::ALL.len();

/// Number of hits, by the label of the fault and the state.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Coverage(BTreeMap<String, [u64; STATES]>);

const fn name(state: SequenceState) -> &'static str {
    match state {
        SequenceState::Off => "off",
        SequenceState::Reset => "in reset",
        SequenceState::Shows(RoleLamp::Starting) => "starting",
        SequenceState::Shows(RoleLamp::Master) => "master",
        SequenceState::Shows(RoleLamp::DegradedMaster) => "degraded",
        SequenceState::Shows(RoleLamp::Standby) => "standby",
        SequenceState::Shows(RoleLamp::Suspended) => "suspended",
    }
}

impl Coverage {
    pub(super) fn of(outcomes: &[Outcome]) -> Self {
        let mut all = Self::default();
        for (kind, state) in outcomes.iter().flat_map(|outcome| &outcome.covered) {
            let row = all.0.entry(kind.clone()).or_default();
            if let Some(count) = row.get_mut(*state) {
                *count += 1;
            }
        }
        all
    }

    pub(super) fn add(&mut self, other: &Self) {
        for (kind, counts) in &other.0 {
            let row = self.0.entry(kind.clone()).or_default();
            row.iter_mut()
                .zip(counts)
                .for_each(|(sum, count)| *sum += count);
        }
    }

    pub(super) fn json(&self) -> Value {
        json!(self.0)
    }

    /// Parses the output of [`Coverage::json`]; `None` if `value` has another form.
    pub(super) fn of_json(value: &Value) -> Option<Self> {
        serde_json::from_value(value.clone()).ok().map(Self)
    }

    /// Returns how many combinations were hit; if `whole`, also the table and the missing ones.
    pub(super) fn text(&self, whole: bool) -> String {
        let mut text = String::new();
        if whole {
            let heads: Vec<&str> = SequenceState::ALL.map(name).into();
            let _ = writeln!(
                text,
                "| fault hits a system that is | {} |",
                heads.join(" | ")
            );
            let _ = writeln!(text, "|---|{}", "---:|".repeat(STATES));
            for (kind, counts) in &self.0 {
                let counts: Vec<String> = counts.iter().map(u64::to_string).collect();
                let _ = writeln!(text, "| {kind} | {} |", counts.join(" | "));
            }
        }
        let labels = Kind::labels();
        let hit = |label: &String, state| self.0.get(label).is_some_and(|row| row[state] > 0);
        let mut holes = Vec::new();
        for state in 0..STATES {
            let missing: Vec<&str> = labels
                .iter()
                .filter(|label| !hit(label, state))
                .map(String::as_str)
                .collect();
            match missing.len() {
                0 => {}
                count if count == labels.len() => {
                    holes.push(format!("{}: all", name(SequenceState::ALL[state])));
                }
                _ => holes.push(format!(
                    "{}: {}",
                    name(SequenceState::ALL[state]),
                    missing.join(", ")
                )),
            }
        }
        let cells = labels.len() * STATES;
        let covered = labels
            .iter()
            .map(|label| (0..STATES).filter(|state| hit(label, *state)).count())
            .sum::<usize>();
        let _ = write!(text, "covered {covered} of {cells} cells of fault × state");
        let shown = if whole {
            holes.join("; ")
        } else {
            String::new()
        };
        let _ = match shown.as_str() {
            "" => writeln!(text),
            shown => writeln!(text, "; not: {shown}"),
        };
        text
    }
}
