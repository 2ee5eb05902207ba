//! `.hgrm`: a distribution in the text format of HdrHistogram's tools and plotters.

use hdrhistogram::Histogram;
use std::fmt::Write as _;

/// Lines for each halving of the distance to 100 %.
const STEPS: u32 = 5;

/// The text of the file. Values are multiplied by `scale`: 1e-3 shows picoseconds as nanoseconds.
#[must_use]
pub fn text(histogram: &Histogram<u64>, scale: f64) -> String {
    let mut text = String::from("       Value     Percentile TotalCount 1/(1-Percentile)\n\n");
    // Writing to a string cannot fail.
    for step in histogram.iter_quantiles(STEPS) {
        let value = step.value_iterated_to() as f64 * scale;
        let quantile = step.quantile_iterated_to();
        let count = histogram.count_between(0, step.value_iterated_to());
        let _ = write!(text, "{value:12.6} {quantile:2.12} {count:10}");
        if quantile < 1.0 {
            let _ = write!(text, " {:14.2}", 1.0 / (1.0 - quantile));
        }
        text.push('\n');
    }
    let (mean, deviation, max) = if histogram.is_empty() {
        (0.0, 0.0, 0.0)
    } else {
        let max = histogram.value_at_quantile(1.0) as f64;
        (histogram.mean(), histogram.stdev(), max)
    };
    let _ = writeln!(
        text,
        "#[Mean    = {:12.6}, StdDeviation   = {:12.6}]",
        mean * scale,
        deviation * scale
    );
    let _ = writeln!(
        text,
        "#[Max     = {:12.6}, Total count    = {:12}]",
        max * scale,
        histogram.len()
    );
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn histogram(values: impl IntoIterator<Item = u64>) -> Histogram<u64> {
        let mut histogram = Histogram::new(3).unwrap();
        for value in values {
            histogram.record(value).unwrap();
        }
        histogram
    }

    /// Reads the lines as a plotter does: four columns of numbers, three in the last line.
    fn read(text: &str) -> Vec<Vec<f64>> {
        let mut lines = text.lines();
        let header: Vec<&str> = lines.next().unwrap().split_whitespace().collect();
        assert_eq!(
            header,
            ["Value", "Percentile", "TotalCount", "1/(1-Percentile)"]
        );
        let data = lines.filter(|line| !line.starts_with('#') && !line.trim().is_empty());
        let columns = |line: &str| {
            let fields = line.split_whitespace();
            fields.map(|field| field.parse().unwrap()).collect()
        };
        data.map(columns).collect()
    }

    #[test]
    fn the_file_gives_the_distribution_back() {
        // 1 to 10,000 ns, in picoseconds.
        let histogram = histogram((1..=10_000).map(|ns| ns * 1000));
        let lines = read(&text(&histogram, 1e-3));
        assert!(lines.len() > 40);
        let (last, others) = lines.split_last().unwrap();
        assert_eq!(last.len(), 3);
        assert_eq!(last[1..], [1.0, 10_000.0]);
        for line in others {
            let [value, quantile, count, rarity] = line[..] else {
                panic!("{line:?}");
            };
            // The tolerance: a precision of three digits, and the step of the grid.
            assert!(
                (value - 10_000.0 * quantile).abs() <= 0.002 * value + 1.0,
                "{line:?}"
            );
            assert!((count - 10_000.0 * quantile).abs() <= 12.0, "{line:?}");
            assert!((rarity * (1.0 - quantile) - 1.0).abs() < 0.01, "{line:?}");
        }
        let ordered = |column: usize| {
            lines
                .windows(2)
                .all(|pair| pair[0][column] <= pair[1][column])
        };
        assert!((0..3).all(ordered));
    }

    #[test]
    fn the_file_ends_with_mean_and_largest() {
        let text = text(&histogram([1_000, 3_000]), 1e-3);
        let comments: Vec<&str> = text.lines().filter(|line| line.starts_with('#')).collect();
        assert_eq!(comments.len(), 2);
        assert!(
            comments[0].starts_with("#[Mean    =     2.00"),
            "{}",
            comments[0]
        );
        assert!(
            comments[1].ends_with("Total count    =            2]"),
            "{}",
            comments[1]
        );
    }

    #[test]
    fn nothing_measured_is_still_a_file() {
        let text = text(&histogram([]), 1.0);
        assert!(text.ends_with("Max     =     0.000000, Total count    =            0]\n"));
    }
}
