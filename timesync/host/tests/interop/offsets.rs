//! Offsets that programs have printed, and their distribution.

use std::fmt;

/// Absolute offsets in ns, the smallest first.
pub(crate) struct Offsets(Vec<i64>);

/// Returns all numbers behind a text; a fraction is cut off.
pub(crate) fn numbers(said: &str, before: &str) -> Vec<i64> {
    let number = |text: &str| {
        let text = text.trim_start();
        let end = text.find(|it: char| !it.is_ascii_digit() && it != '-');
        text[..end.unwrap_or(text.len())].parse().ok()
    };
    said.split(before).skip(1).filter_map(number).collect()
}

impl Offsets {
    pub(crate) fn ours(said: &str) -> Self {
        Self::new(numbers(said, "\"offset_ns\":"), said)
    }

    /// Each eighth of ours, as ptp4l tells them.
    pub(crate) fn some_of_ours(said: &str) -> Self {
        let all = numbers(said, "\"offset_ns\":");
        Self::new(all.into_iter().step_by(8).collect(), said)
    }

    pub(crate) fn ptp4l(said: &str) -> Self {
        Self::new(numbers(said, "master offset"), said)
    }

    /// Of each measurement, before statime's filter.
    pub(crate) fn statime(said: &str) -> Self {
        Self::new(numbers(said, ", offset: Some(Duration { inner:"), said)
    }

    fn new(numbers: Vec<i64>, said: &str) -> Self {
        // In the first quarter rates and delays are not known well.
        let first = numbers.len() / 4;
        let settled = numbers.into_iter().skip(first);
        let mut offsets: Vec<i64> = settled.map(i64::abs).collect();
        offsets.sort_unstable();
        assert!(offsets.len() > 3, "{} offsets: {said}", offsets.len());
        Self(offsets)
    }

    fn percentile(&self, percent: usize) -> i64 {
        self.0[(self.0.len() - 1) * percent / 100]
    }

    /// Asserts that the median is no worse than twice the other one and 1 µs: a scheduler that is
    /// busy makes one of two programs look bad. A campaign's figures are finer.
    pub(crate) fn no_worse_than(&self, other: &Self) {
        let bound = 2 * other.percentile(50) + 1_000;
        assert!(self.percentile(50) <= bound, "{self} against {other}");
    }
}

impl fmt::Display for Offsets {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [p50, p99, max] = [50, 99, 100].map(|it| self.percentile(it));
        let count = self.0.len();
        write!(f, "p50 {p50} p99 {p99} max {max} ns of {count}")
    }
}
