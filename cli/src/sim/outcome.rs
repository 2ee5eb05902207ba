//! What the campaign needs of one sequence, and the line that one process tells another.

use tandem_sim::faults::{Verdict, Violation};

/// What became of one sequence.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Outcome {
    pub(super) number: u64,
    /// The longest time without control.
    pub(super) gap_ns: u64,
    /// Systems that suspended themselves.
    pub(super) suspended: u64,
    /// Virtual time of the run.
    pub(super) simulated_ns: u64,
    pub(super) violations: Vec<Violation>,
}

impl Outcome {
    pub(super) fn new(number: u64, verdict: Verdict) -> Self {
        Self {
            number,
            gap_ns: verdict.gap.as_ns(),
            suspended: verdict.suspended as u64,
            simulated_ns: verdict.simulated.as_ns(),
            violations: verdict.violations,
        }
    }

    /// The line; [`Self::of`] reads it.
    pub(super) fn line(&self) -> String {
        let code = |violation| Violation::ALL.iter().position(|it| it == violation);
        let codes = self.violations.iter().filter_map(code);
        let numbers = [self.number, self.gap_ns, self.suspended, self.simulated_ns];
        let words = numbers.into_iter().chain(codes.map(|code| code as u64));
        words.fold("=".to_owned(), |line, word| format!("{line} {word}"))
    }

    /// `None` if the line is none of an outcome.
    pub(super) fn of(line: &str) -> Option<Self> {
        let mut words = line.strip_prefix("= ")?.split_whitespace();
        let mut number = || words.next()?.parse().ok();
        Some(Self {
            number: number()?,
            gap_ns: number()?,
            suspended: number()?,
            simulated_ns: number()?,
            violations: words
                .map(|word| Violation::ALL.get(word.parse::<usize>().ok()?).copied())
                .collect::<Option<_>>()?,
        })
    }
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
            violations: vec![Violation::Gap, Violation::Panic],
        };
        assert_eq!(Outcome::of(&outcome.line()), Some(outcome));
        assert_eq!(Outcome::of("= 1 2 3 4 99"), None, "no such violation");
        assert_eq!(Outcome::of("a line of the library"), None);
    }
}
