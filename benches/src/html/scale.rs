//! Logarithmic axes.

/// A logarithmic axis from a range of values to a range of the picture.
#[derive(Clone, Copy, Debug)]
pub(super) struct Scale {
    low: f64,
    high: f64,
    from: f64,
    to: f64,
}

impl Scale {
    /// An axis that holds these values, which must be larger than 0, with a margin on both sides;
    /// `None` if there are none.
    pub(super) fn over(values: impl Iterator<Item = f64>, from: f64, to: f64) -> Option<Self> {
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for value in values.filter(|value| *value > 0.0 && value.is_finite()) {
            low = low.min(value.log10());
            high = high.max(value.log10());
        }
        if low > high {
            return None;
        }
        let margin = (0.04 * (high - low)).max(0.05);
        Some(Self {
            low: low - margin,
            high: high + margin,
            from,
            to,
        })
    }

    /// As [`Scale::over`], for values within these bounds; those outside stand at the ends.
    pub(super) fn within(
        values: impl Iterator<Item = f64>,
        (low, high): (f64, f64),
        from: f64,
        to: f64,
    ) -> Option<Self> {
        Self::over(values.map(|value| value.clamp(low, high)), from, to)
    }

    /// Whether a value lies within the axis.
    pub(super) fn holds(&self, value: f64) -> bool {
        value > 0.0 && (self.low..=self.high).contains(&value.log10())
    }

    /// Where a value stands; those outside of the axis stand at its ends.
    pub(super) fn at(&self, value: f64) -> f64 {
        let log = value.max(1e-300).log10().clamp(self.low, self.high);
        self.from + (log - self.low) / (self.high - self.low) * (self.to - self.from)
    }

    /// Round values within the range: 1, 2 and 5 of each power of ten if it is short, else the
    /// powers alone.
    pub(super) fn ticks(&self) -> Vec<f64> {
        let steps: &[f64] = if self.high - self.low > 2.6 {
            &[1.0]
        } else {
            &[1.0, 2.0, 5.0]
        };
        let powers = self.low.floor() as i32..=self.high.ceil() as i32;
        let all = powers.flat_map(|power| steps.iter().map(move |step| step * 10_f64.powi(power)));
        all.filter(|tick| (self.low..=self.high).contains(&tick.log10()))
            .collect()
    }
}

/// Moves places, ordered from above to below, so far apart that two are never closer than `gap`,
/// and keeps them within the range as far as they fit.
pub(super) fn spread(places: &[f64], gap: f64, (top, bottom): (f64, f64)) -> Vec<f64> {
    let mut order: Vec<usize> = (0..places.len()).collect();
    order.sort_by(|i, j| places[*i].total_cmp(&places[*j]));
    let mut spread = places.to_vec();
    let mut next = top;
    for place in &order {
        spread[*place] = spread[*place].max(next);
        next = spread[*place] + gap;
    }
    let mut next = bottom;
    for place in order.iter().rev() {
        spread[*place] = spread[*place].min(next);
        next = spread[*place] - gap;
    }
    spread
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_ratios_are_equal_distances() {
        let scale = Scale::over([10.0, 1000.0].into_iter(), 0.0, 100.0).unwrap();
        let (a, b, c) = (scale.at(10.0), scale.at(100.0), scale.at(1000.0));
        assert!((b - a - (c - b)).abs() < 1e-9 && a > 0.0 && c < 100.0);
        assert_eq!(scale.at(0.0), 0.0);
        assert!(Scale::over([0.0].into_iter(), 0.0, 1.0).is_none());
    }

    #[test]
    fn ticks_are_round_and_not_too_many() {
        let ticks = |low, high| {
            Scale::over([low, high].into_iter(), 0.0, 1.0)
                .unwrap()
                .ticks()
        };
        assert_eq!(ticks(80.0, 900.0), [100.0, 200.0, 500.0, 1000.0]);
        assert_eq!(
            ticks(1.1, 90_000.0),
            [1.0, 10.0, 100.0, 1000.0, 10_000.0, 100_000.0]
        );
    }

    #[test]
    fn labels_never_overlap() {
        let spread = spread(&[10.0, 11.0, 11.5, 99.0, 100.0], 15.0, (0.0, 100.0));
        let mut sorted = spread.clone();
        sorted.sort_by(f64::total_cmp);
        assert!(
            sorted.windows(2).all(|pair| pair[1] - pair[0] >= 14.999),
            "{spread:?}"
        );
        assert!(sorted[0] >= 0.0 && sorted[4] <= 100.0);
    }
}
