//! Whether two samples differ: Welch's test on trimmed means, and Holm's correction for many tests.
//!
//! Latencies have long tails, and a batch now and then lies far off. Of ten values or more the
//! lowest and the highest tenth do not count for the mean, and count as their neighbours for its
//! variance (Yuen). A handful of values counts in full: then an outlier makes the test blind, not
//! rash, because it widens what the test takes for noise.
//!
//! Sources: Welch, "The generalization of 'Student's' problem when several different population
//! variances are involved", 1947; Yuen, "The two-sample trimmed t for unequal population
//! variances", 1974; Holm, "A simple sequentially rejective multiple test procedure", 1979.

/// Share of a sample that is trimmed at either end.
const TRIMMED: f64 = 0.1;

/// An estimate with its confidence interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Interval {
    /// The estimate.
    pub middle: f64,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// A trimmed mean, the variance of that mean, and how many values it rests on.
struct Mean {
    mean: f64,
    variance: f64,
    count: f64,
}

/// `None` for less than two values.
fn trimmed(values: &[f64]) -> Option<Mean> {
    let all = values.len();
    if all < 2 {
        return None;
    }
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let cut = (TRIMMED * all as f64) as usize;
    let kept = &sorted[cut..all - cut];
    let count = kept.len() as f64;
    let mean = kept.iter().sum::<f64>() / count;
    // What was cut counts as its nearest neighbour that was kept.
    let (low, high) = (kept[0], kept[kept.len() - 1]);
    let pulled_in: Vec<f64> = sorted.iter().map(|value| value.clamp(low, high)).collect();
    let center = pulled_in.iter().sum::<f64>() / all as f64;
    let squares: f64 = pulled_in.iter().map(|v| (v - center).powi(2)).sum();
    // Values that are equal to the last digit were rounded; they are not without noise.
    let least = (mean * 1e-6).powi(2).max(1e-12) / count;
    Some(Mean {
        mean,
        variance: (squares / (count * (count - 1.0))).max(least),
        count,
    })
}

/// Two-sided p-value of the test that two samples have the same mean, and by how much `b` lies
/// above `a`, with the interval that holds the true distance with this confidence. `None` for less
/// than two values in a sample.
#[must_use]
pub fn difference(a: &[f64], b: &[f64], confidence: f64) -> Option<(f64, Interval)> {
    let (a, b) = (trimmed(a)?, trimmed(b)?);
    let variance = a.variance + b.variance;
    let part = |mean: &Mean| mean.variance.powi(2) / (mean.count - 1.0);
    let freedom = variance.powi(2) / (part(&a) + part(&b));
    let middle = b.mean - a.mean;
    let p = student_p(middle / variance.sqrt(), freedom);
    // The distance at which p is what is left of the confidence.
    let (mut near, mut far) = (0.0, 1e6);
    while far - near > 1e-9 * far {
        let t = f64::midpoint(near, far);
        if student_p(t, freedom) > 1.0 - confidence {
            near = t;
        } else {
            far = t;
        }
    }
    let reach = far * variance.sqrt();
    let (low, high) = (middle - reach, middle + reach);
    Some((p, Interval { middle, low, high }))
}

/// How probable it is that Student's t lies at least this far from 0.
fn student_p(t: f64, freedom: f64) -> f64 {
    beta_share(freedom / (freedom + t * t), freedom / 2.0, 0.5)
}

/// The regularised incomplete beta function, by its continued fraction (DLMF 8.17.22) from the
/// side on which that converges fast.
fn beta_share(x: f64, a: f64, b: f64) -> f64 {
    if x > (a + 1.0) / (a + b + 2.0) {
        return 1.0 - beta_share(1.0 - x, b, a);
    }
    if x <= 0.0 {
        return 0.0;
    }
    let beta = libm::lgamma(a) + libm::lgamma(b) - libm::lgamma(a + b);
    let front = (a * x.ln() + b * (1.0 - x).ln() - beta).exp() / a;
    // From the inside out: what 60 terms leave is far below a double's last digit here.
    let mut fraction = 1.0;
    for m in (1..=60).rev() {
        let m = f64::from(m);
        let even = m * (b - m) * x / ((a + 2.0 * m - 1.0) * (a + 2.0 * m));
        let before = m - 1.0;
        let odd =
            -(a + before) * (a + b + before) * x / ((a + 2.0 * before) * (a + 2.0 * before + 1.0));
        fraction = 1.0 + odd / (1.0 + even / fraction);
    }
    front / fraction
}

/// Holm's correction: the p-values adjusted so that all those below alpha together hold at least
/// one false one with probability alpha at most, whatever their dependence.
#[must_use]
pub fn holm(p: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..p.len()).collect();
    order.sort_by(|i, j| p[*i].total_cmp(&p[*j]));
    let mut adjusted = vec![1.0; p.len()];
    let mut largest: f64 = 0.0;
    for (smaller, place) in order.into_iter().enumerate() {
        largest = largest.max(p[place] * (p.len() - smaller) as f64).min(1.0);
        adjusted[place] = largest;
    }
    adjusted
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng as _;
    use rand_distr::{Distribution as _, LogNormal};

    #[test]
    fn students_t_has_the_values_of_the_tables() {
        // Two-sided 5 %, 1 % and 0.1 %: one degree of freedom has the closed form of Cauchy.
        for (t, freedom, p) in [
            (12.706_205, 1.0, 0.05),
            (4.302_653, 2.0, 0.05),
            (2.776_445, 4.0, 0.05),
            (4.604_095, 4.0, 0.01),
            (8.610_302, 4.0, 0.001),
            (2.042_272, 30.0, 0.05),
            (1.0, 1.0, 0.5),
            (0.0, 7.0, 1.0),
        ] {
            let is = student_p(t, freedom);
            assert!((is - p).abs() < 1e-6 * p.max(0.1), "{t} {freedom}: {is}");
        }
    }

    #[test]
    fn the_test_agrees_with_a_worked_example() {
        // Means 2 and 5, variances 1 and 4, three values each: t = 3 / sqrt(5/3), 2.94 degrees.
        let (p, interval) = difference(&[1.0, 2.0, 3.0], &[3.0, 5.0, 7.0], 0.95).unwrap();
        let (t, freedom) = (3.0 / (5.0_f64 / 3.0).sqrt(), (25.0 / 9.0) / (17.0 / 18.0));
        assert!((p - student_p(t, freedom)).abs() < 1e-12);
        assert!((0.09..0.12).contains(&p), "{p}");
        assert_eq!(interval.middle, 3.0);
        assert!(interval.low < 0.0 && interval.high > 6.0);
        assert!(difference(&[1.0], &[1.0, 2.0], 0.95).is_none());
    }

    #[test]
    fn an_outlier_among_ten_does_not_count() {
        let mut a: Vec<f64> = (0..10).map(f64::from).collect();
        let b: Vec<f64> = a.iter().map(|value| value + 8.0).collect();
        let without = difference(&a, &b, 0.95).unwrap();
        a[9] = 1e6;
        assert_eq!(difference(&a, &b, 0.95).unwrap(), without);
        assert!(without.0 < 1e-3, "{without:?}");
    }

    /// Logarithms of batches of a run on a machine like ours: most alike, some far off.
    fn batches(random: &mut ChaCha8Rng, n: usize, factor: f64) -> Vec<f64> {
        let noise = LogNormal::new(0.0, 0.06).unwrap();
        let stall = LogNormal::new(-4.5, 1.0).unwrap();
        let mut one = || (80.0_f64 * factor * noise.sample(random)).ln() + stall.sample(random);
        (0..n).map(|_| one()).collect()
    }

    #[test]
    fn without_a_change_the_test_errs_as_rarely_as_it_says_and_the_interval_holds() {
        let mut random = ChaCha8Rng::seed_from_u64(7);
        for (n, m) in [(3, 3), (4, 9), (12, 15), (40, 30)] {
            let (runs, alpha) = (1000, 0.05);
            let mut errors = 0;
            for _ in 0..runs {
                let (a, b) = (batches(&mut random, n, 1.0), batches(&mut random, m, 1.0));
                let (p, interval) = difference(&a, &b, 0.95).unwrap();
                let holds = (interval.low..=interval.high).contains(&0.0);
                assert_eq!(holds, p > alpha, "{p} {interval:?}");
                errors += u32::from(p <= alpha);
            }
            // 50 expected; 3.5 deviations of the binomial distribution are 24. With a handful of
            // values and a tail the test errs on the safe side.
            assert!(errors <= 74, "{n} {m}: {errors} of {runs}");
        }
    }

    #[test]
    fn a_tenth_more_is_found() {
        let mut random = ChaCha8Rng::seed_from_u64(8);
        let runs = 200;
        let mut found = 0;
        for _ in 0..runs {
            let (a, b) = (batches(&mut random, 20, 1.0), batches(&mut random, 20, 1.1));
            found += u32::from(difference(&a, &b, 0.95).unwrap().0 <= 0.05);
        }
        assert!(found > 190, "{found} of {runs}");
    }

    #[test]
    fn holm_multiplies_by_what_is_left() {
        // Worked by hand: 0.01 x 4, 0.02 x 3, 0.03 x 2, and never below the one before.
        let adjusted = holm(&[0.03, 0.01, 0.9, 0.02]);
        for (is, shall) in adjusted.iter().zip([0.06, 0.04, 0.9, 0.06]) {
            assert!((is - shall).abs() < 1e-9, "{adjusted:?}");
        }
        assert!(holm(&[]).is_empty());
    }
}
