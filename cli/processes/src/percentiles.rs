//! Distributions of time spans, and the `.hgrm` files that HdrHistogram's tools read.

use hdrhistogram::Histogram;
use serde::Serialize;

/// A distribution of time spans, stored in nanoseconds with four significant digits.
pub struct Spans {
    histogram: Histogram<u64>,
}

impl Spans {
    /// Makes the distribution of these spans, in milliseconds. Negative spans count as zero.
    pub fn from_ms(spans_ms: impl IntoIterator<Item = f64>) -> Self {
        // The constant bounds are valid, so the fallback is never reached.
        let mut histogram = Histogram::new_with_bounds(1, 3_600_000_000_000, 4)
            .unwrap_or_else(|_| unreachable!("constant bounds"));
        for span_ms in spans_ms {
            histogram.saturating_record((span_ms * 1e6).max(0.0) as u64);
        }
        Self { histogram }
    }

    /// Returns the number of spans.
    pub fn count(&self) -> u64 {
        self.histogram.len()
    }

    /// Returns the span in ms that `percent` of all spans do not exceed; `None` without spans.
    pub fn percentile_ms(&self, percent: f64) -> Option<f64> {
        (self.count() > 0).then(|| self.histogram.value_at_percentile(percent) as f64 * 1e-6)
    }

    /// Returns the largest span, ms.
    pub fn max_ms(&self) -> Option<f64> {
        self.percentile_ms(100.0)
    }

    /// Returns the points of the curve over percentiles: (1 / (1 − p), ms). The last point is the
    /// maximum. Its percentile is that of one span among all spans.
    pub fn curve(&self) -> Vec<(f64, f64)> {
        if self.count() == 0 {
            return Vec::new();
        }
        let rarest = self.count().max(2) as f64;
        let mut points: Vec<(f64, f64)> = Vec::new();
        for step in self.histogram.iter_quantiles(10) {
            let rarity = (1.0 / (1.0 - step.quantile_iterated_to()).max(1e-12)).min(rarest);
            points.push((rarity, step.value_iterated_to() as f64 * 1e-6));
        }
        points
    }

    /// Returns the text of a `.hgrm` file, with values in milliseconds.
    pub fn to_hgrm(&self) -> String {
        tandem_page::hgrm::text(&self.histogram, 1e-6)
    }
}

/// The magnitudes of deviations, µs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct DeviationFigures {
    /// Median.
    pub p50_us: f64,
    /// 99th percentile.
    pub p99_us: f64,
    /// Largest.
    pub max_us: f64,
    /// How many there are.
    pub count: u64,
}

impl DeviationFigures {
    /// Of deviations in ns; `None` without any.
    pub fn of_ns(deviations_ns: impl IntoIterator<Item = i64>) -> Option<Self> {
        let sizes = deviations_ns.into_iter().map(i64::unsigned_abs);
        let spans = Spans::from_ms(sizes.map(|ns| ns as f64 * 1e-6));
        let us = |percent| Some(spans.percentile_ms(percent)? * 1e3);
        Some(Self {
            p50_us: us(50.0)?,
            p99_us: us(99.0)?,
            max_us: us(100.0)?,
            count: spans.count(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_those_of_the_values() {
        let spans = Spans::from_ms((1..=1000).map(f64::from));
        assert!((spans.percentile_ms(50.0).unwrap() - 500.0).abs() < 0.1);
        assert!((spans.percentile_ms(99.0).unwrap() - 990.0).abs() < 0.1);
        assert!((spans.max_ms().unwrap() - 1000.0).abs() < 0.1);
    }

    #[test]
    fn no_value_has_no_percentile_and_still_a_file() {
        let spans = Spans::from_ms([]);
        assert_eq!(spans.percentile_ms(99.0), None);
        assert!(spans.curve().is_empty());
        assert!(spans.to_hgrm().contains("Total count    =            0"));
    }

    #[test]
    fn the_file_ends_at_the_maximum_and_counts_all() {
        let text = Spans::from_ms([10.0, 10.0, 12.5]).to_hgrm();
        let last = text.lines().rfind(|line| !line.starts_with('#')).unwrap();
        let fields: Vec<&str> = last.split_whitespace().collect();
        assert_eq!(fields[1..3], ["1.000000000000", "3"]);
        assert!((fields[0].parse::<f64>().unwrap() - 12.5).abs() < 0.01);
    }
}
