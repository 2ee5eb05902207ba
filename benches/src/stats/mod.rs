//! Whether two samples differ: the test of Mann and Whitney, the shift between the samples with its
//! confidence interval, and Holm's correction for many tests.
//!
//! Ranks assume nothing about the shape of the distributions: latencies have long tails. But a
//! handful of values has too few orders to prove anything by ranks, however far apart they lie. For
//! these there is Welch's test, which looks at distances, and which a tail makes blind rather than
//! rash: an outlier widens what it takes for noise.
//!
//! Sources: Mann and Whitney, "On a test of whether one of two random variables is stochastically
//! larger than the other", 1947; Hodges and Lehmann, "Estimates of location based on rank tests",
//! 1963; Welch, "The generalization of 'Student's' problem when several different population
//! variances are involved", 1947; Holm, "A simple sequentially rejective multiple test procedure", 1979.

/// Up to so many values in both samples the test is exact; beyond, the normal approximation is
/// good to some 1e-3.
const EXACT_UP_TO: usize = 40;

/// Two-sided p-value of the test of Mann and Whitney: how probable so different ranks are if both
/// samples come from the same distribution. 1 if a sample is empty.
///
/// Equal values share their ranks; the exact distribution is that of the ranks as they are.
#[must_use]
pub fn mann_whitney_p(a: &[f64], b: &[f64]) -> f64 {
    if a.is_empty() || b.is_empty() {
        return 1.0;
    }
    let ranks = doubled_ranks(a, b);
    let sum: u64 = ranks[..a.len()].iter().sum();
    let p = if ranks.len() <= EXACT_UP_TO {
        exact_p(&ranks, a.len(), sum)
    } else {
        normal_p(&ranks, a.len(), sum)
    };
    p.min(1.0)
}

/// The smallest p-value that samples of these sizes can have: that of samples wholly apart.
#[must_use]
pub fn least_p(n: usize, m: usize) -> f64 {
    // 2 over (n + m choose n).
    let choose = (1..=n).map(|i| (m + i) as f64 / i as f64).product::<f64>();
    (2.0 / choose).min(1.0)
}

/// Mean and variance of the mean; `None` for less than two values.
fn mean_of(values: &[f64]) -> Option<(f64, f64)> {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    // Values that are equal to the last digit were rounded; they are not without noise.
    let least = (mean * 1e-6).powi(2).max(1e-12);
    (values.len() > 1).then(|| (mean, (squares / (count - 1.0)).max(least) / count))
}

/// Two-sided p-value of Welch's test that two samples have the same mean, and the difference of
/// the means with its interval. `None` for less than two values in a sample.
#[must_use]
pub fn welch(a: &[f64], b: &[f64], confidence: f64) -> Option<(f64, Interval)> {
    let ((mean_a, var_a), (mean_b, var_b)) = (mean_of(a)?, mean_of(b)?);
    let variance = var_a + var_b;
    let part = |var: f64, count: usize| var.powi(2) / (count - 1) as f64;
    let freedom = variance.powi(2) / (part(var_a, a.len()) + part(var_b, b.len()));
    let middle = mean_b - mean_a;
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

/// Twice the rank of each value among all values, those of `a` first; equal values get the
/// middle of their ranks, hence the factor.
fn doubled_ranks(a: &[f64], b: &[f64]) -> Vec<u64> {
    let values: Vec<f64> = a.iter().chain(b).copied().collect();
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|i, j| values[*i].total_cmp(&values[*j]));
    let mut ranks = vec![0; values.len()];
    let mut below = 0_u64;
    for equal in order.chunk_by(|i, j| values[*i].total_cmp(&values[*j]).is_eq()) {
        let count = equal.len() as u64;
        for place in equal {
            // The middle of below + 1 ..= below + count, doubled.
            ranks[*place] = 2 * below + count + 1;
        }
        below += count;
    }
    ranks
}

/// Of all ways to choose `n` of these ranks, the share whose sum lies at least as far from the
/// expected one as `sum`.
fn exact_p(ranks: &[u64], n: usize, sum: u64) -> f64 {
    let total: u64 = ranks.iter().sum();
    // ways[k][s]: ways to choose k ranks with the sum s. A double carries the largest count, 40
    // choose 20, exactly.
    let mut ways = vec![vec![0.0_f64; total as usize + 1]; n + 1];
    ways[0][0] = 1.0;
    for (i, rank) in ranks.iter().enumerate() {
        let rank = *rank as usize;
        for k in (1..=n.min(i + 1)).rev() {
            let (fewer, more) = ways.split_at_mut(k);
            for (with, without) in more[0][rank..].iter_mut().zip(&fewer[k - 1]) {
                *with += without;
            }
        }
    }
    // In units of 1 / ranks.len(), so that all is whole.
    let distance = |sum: u64| (sum * ranks.len() as u64).abs_diff(total * n as u64);
    let all: f64 = ways[n].iter().sum();
    let as_far = |(other, _): &(usize, &f64)| distance(*other as u64) >= distance(sum);
    let far: f64 = ways[n]
        .iter()
        .enumerate()
        .filter(as_far)
        .map(|(_, w)| w)
        .sum();
    far / all
}

/// The normal approximation, with the variance that equal ranks leave and half a rank for
/// continuity.
fn normal_p(ranks: &[u64], n: usize, sum: u64) -> f64 {
    let (count, n) = (ranks.len() as f64, n as f64);
    let mean = ranks.iter().sum::<u64>() as f64 / count;
    let squares: f64 = ranks.iter().map(|rank| (*rank as f64 - mean).powi(2)).sum();
    // Sum of n ranks drawn without replacement.
    let variance = n * (count - n) / count * squares / (count - 1.0);
    if variance <= 0.0 {
        return 1.0;
    }
    let distance = ((sum as f64 - n * mean).abs() - 1.0).max(0.0);
    libm::erfc(distance / variance.sqrt() / std::f64::consts::SQRT_2)
}

/// An estimate with its confidence interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Interval {
    /// The estimate.
    pub middle: f64,
    /// Lower end; minus infinity if the samples are too small to bound it.
    pub low: f64,
    /// Upper end; infinity if the samples are too small to bound it.
    pub high: f64,
}

/// By how much `b` lies above `a` (Hodges and Lehmann: the median of all differences), with the
/// interval that holds the true shift with probability `confidence`, by the same ranks as
/// [`mann_whitney_p`]. `None` if a sample is empty.
#[must_use]
pub fn shift(a: &[f64], b: &[f64], confidence: f64) -> Option<Interval> {
    let mut differences: Vec<f64> = b
        .iter()
        .flat_map(|b| a.iter().map(move |a| b - a))
        .collect();
    differences.sort_unstable_by(f64::total_cmp);
    let count = differences.len();
    let middle = tandem_page::format::median(&differences)?;
    // The test does not reject a shift that has more than `cut` differences on either side.
    let (low, high) = match cut(a.len(), b.len(), (1.0 - confidence) / 2.0) {
        Some(cut) => (differences[cut], differences[count - 1 - cut]),
        None => (f64::NEG_INFINITY, f64::INFINITY),
    };
    Some(Interval { middle, low, high })
}

/// The largest u with P(U <= u) <= `tail` for samples of these sizes without equal values; `None`
/// if even 0 is more probable.
fn cut(n: usize, m: usize, tail: f64) -> Option<usize> {
    if n + m > EXACT_UP_TO {
        let (n, m) = (n as f64, m as f64);
        let deviation = (n * m * (n + m + 1.0) / 12.0).sqrt();
        let u = n * m / 2.0 - 0.5 - normal_quantile(tail) * deviation;
        return (u >= 0.0).then_some(u as usize);
    }
    let ways = u_distribution(n, m);
    let all: f64 = ways.iter().sum();
    let mut below = 0.0;
    let mut cut = None;
    for (u, count) in ways.iter().enumerate() {
        below += count / all;
        if below > tail {
            break;
        }
        cut = Some(u);
    }
    cut
}

/// In how many ways U takes each value from 0 to n m, without equal values.
fn u_distribution(n: usize, m: usize) -> Vec<f64> {
    // Gauss: the product over i of (1 - q^(m + i)) / (1 - q^i), as a polynomial in q.
    let mut ways = vec![0.0; n * m + 1];
    ways[0] = 1.0;
    for i in 1..=n {
        for u in (m + i..ways.len()).rev() {
            ways[u] -= ways[u - m - i];
        }
        for u in i..ways.len() {
            ways[u] += ways[u - i];
        }
    }
    ways
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

/// How many deviations above the mean the upper `tail` begins (0 < tail < 0.5).
fn normal_quantile(tail: f64) -> f64 {
    let (mut low, mut high) = (0.0, 40.0);
    while high - low > 1e-9 {
        let middle = f64::midpoint(low, high);
        if libm::erfc(middle / std::f64::consts::SQRT_2) / 2.0 > tail {
            low = middle;
        } else {
            high = middle;
        }
    }
    high
}

#[cfg(test)]
mod tests;
