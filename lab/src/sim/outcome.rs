//! The outcome of one sequence for the campaign, and the line in which one process tells it to
//! another.

use tandem_sim::faults::{Kind, State, Verdict, Violation};

/// The outcome of one sequence.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Outcome {
    pub(super) number: u64,
    /// The longest time without control.
    pub(super) gap_ns: u64,
    /// Systems that suspended themselves.
    pub(super) suspended: u64,
    /// Virtual time of the run.
    pub(super) simulated_ns: u64,
    /// Every frame and event of the run, as one number.
    pub(super) digest: u64,
    pub(super) violations: Vec<Violation>,
    /// What its faults hit: the label of the kind, and the place of the state in [`State::ALL`].
    pub(super) covered: Vec<(String, usize)>,
}

impl Outcome {
    pub(super) fn new(number: u64, verdict: Verdict) -> Self {
        Self {
            number,
            gap_ns: verdict.gap.as_ns(),
            suspended: verdict.suspended as u64,
            simulated_ns: verdict.simulated.as_ns(),
            digest: verdict.digest,
            violations: verdict.violations,
            covered: verdict.covered.into_iter().filter_map(hit).collect(),
        }
    }

    /// The line; [`Self::of`] reads it.
    pub(super) fn line(&self) -> String {
        let code = |violation| Violation::ALL.iter().position(|it| it == violation);
        let codes = self.violations.iter().filter_map(code);
        let numbers = [
            self.number,
            self.gap_ns,
            self.suspended,
            self.simulated_ns,
            self.digest,
        ];
        let words = numbers.into_iter().chain(codes.map(|code| code as u64));
        let mut line = words.fold("=".to_owned(), |line, word| format!("{line} {word}"));
        for (kind, state) in &self.covered {
            line.push_str(&format!(" {}:{state}", kind.replace(' ', "_")));
        }
        line
    }

    /// `None` if the line is none of an outcome.
    pub(super) fn of(line: &str) -> Option<Self> {
        let mut words: Vec<&str> = line.strip_prefix("= ")?.split_whitespace().collect();
        let hits = words.partition_point(|word| !word.contains(':'));
        let covered = words.split_off(hits);
        let mut words = words.into_iter();
        let mut number = || words.next()?.parse().ok();
        Some(Self {
            number: number()?,
            gap_ns: number()?,
            suspended: number()?,
            simulated_ns: number()?,
            digest: number()?,
            violations: words
                .map(|word| Violation::ALL.get(word.parse::<usize>().ok()?).copied())
                .collect::<Option<_>>()?,
            covered: covered
                .into_iter()
                .map(|word| {
                    let (kind, state) = word.split_once(':')?;
                    Some((kind.replace('_', " "), state.parse().ok()?))
                })
                .collect::<Option<_>>()?,
        })
    }
}

fn hit((kind, state): (Kind, State)) -> Option<(String, usize)> {
    let state = State::ALL.iter().position(|it| *it == state)?;
    Some((kind.label(), state))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_outcome_survives_its_line() {
        let outcome = Outcome {
            number: 7,
            gap_ns: 19_400_000,
            suspended: 1,
            simulated_ns: 4_000_000_000,
            digest: u64::MAX,
            violations: vec![Violation::Gap, Violation::Panic],
            covered: vec![("cut heartbeat-1".to_owned(), 3), ("mute".to_owned(), 0)],
        };
        assert_eq!(Outcome::of(&outcome.line()), Some(outcome));
        assert_eq!(Outcome::of("= 1 2 3 4 5 99"), None, "no such violation");
        assert_eq!(Outcome::of("a line of the library"), None);
    }
}
