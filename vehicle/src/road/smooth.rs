//! Polylines: sampling at equal distances and smoothing without shrinking curves.

use crate::geometry::{Vec2, wrap_angle};

/// Standard deviation of the smoothing kernel, m. A corner of 0.02 rad becomes a curve with less
/// than 0.7 m/s² of lateral acceleration at 30 m/s; a curve with 60 m radius moves by 6 cm.
const SIGMA: f64 = 15.0;
/// The same where that kernel would leave the mapped line, m: the first one moves a bend of 20 m
/// radius by 12 cm. The second is used if the first makes a bend sharper than [`SHARPEST`].
const SIGMAS_IN_BENDS: [f64; 2] = [8.0, 11.0];
/// A narrower kernel must not make a sharper bend than this, 1/m: maps have corners where roads
/// have bends inside the domain, which ends a tenth above.
const SHARPEST: f64 = 1.0 / 22.0;
/// The narrow kernel's share begins where the wide one moves the line by the first of these, and is
/// whole from the second on, m.
const LEAVES: (f64, f64) = (0.25, 0.5);

/// Length over which the bend of a line is measured, m.
const BEND_M: f64 = 10.0;

/// Returns how sharply the line bends over [`BEND_M`] around this point, 1/m.
pub(super) fn bend(points: &[Vec2], at: usize, step: f64) -> f64 {
    // Between the middles of both pieces.
    let pieces = (BEND_M / step) as usize;
    let piece = |from: usize| (points[from + 1] - points[from]).angle();
    let (first, last) = (at.saturating_sub(pieces.div_ceil(2)), points.len() - 2);
    let turn = wrap_angle(piece((first + pieces).min(last)) - piece(first.min(last)));
    turn.abs() / (pieces as f64 * step)
}

/// Returns points every `step` metres along the line, both ends included (the last distance may be
/// longer by up to half a step).
pub(super) fn resampled(points: &[Vec2], step: f64) -> Vec<Vec2> {
    let length: f64 = points.windows(2).map(|w| (w[1] - w[0]).norm()).sum();
    let count = ((length / step).round() as usize).max(2);
    let exact = length / count as f64;
    let mut samples = Vec::with_capacity(count + 1);
    let (mut index, mut before) = (0, 0.0);
    for sample in 0..=count {
        let wanted = sample as f64 * exact;
        let mut piece = (points[index + 1] - points[index]).norm();
        while before + piece < wanted && index + 2 < points.len() {
            before += piece;
            index += 1;
            piece = (points[index + 1] - points[index]).norm();
        }
        let t = if piece > 0.0 {
            ((wanted - before) / piece).min(1.0)
        } else {
            0.0
        };
        samples.push(points[index].lerp(points[index + 1], t));
    }
    samples
}

/// Smooths noise and corners, and leaves sharp bends where they are: they get a narrower kernel.
pub(super) fn smoothed(points: &[Vec2], step: f64) -> Vec<Vec2> {
    let wide = twiced(points, step, SIGMA);
    let (from, to) = LEAVES;
    let share = |(raw, smooth): (&Vec2, &Vec2)| {
        (((*raw - *smooth).norm() - from) / (to - from)).clamp(0.0, 1.0)
    };
    let shares: Vec<f64> = points.iter().zip(&wide).map(share).collect();
    if shares.iter().all(|share| *share <= 0.0) {
        return wide;
    }
    // A bend keeps one kernel, and the change between the two makes no corner.
    let reach = (3.0 * SIGMA / step) as usize;
    let around = |index: usize| {
        let near = &shares[index.saturating_sub(reach)..shares.len().min(index + reach + 1)];
        Vec2::new(near.iter().copied().fold(0.0, f64::max), 0.0)
    };
    let shares: Vec<Vec2> = (0..shares.len()).map(around).collect();
    let shares = gaussian(&shares, step, SIGMA);
    let with = |sigma: f64| -> Vec<Vec2> {
        let narrow = twiced(points, step, sigma);
        let both = wide.iter().zip(&narrow).zip(&shares);
        both.map(|((wide, narrow), share)| wide.lerp(*narrow, share.x))
            .collect()
    };
    let is_bend = |line: &Vec<Vec2>| {
        let headings = headings(line);
        let mut bends = headings.windows(3);
        bends.all(|it| wrap_angle(it[2] - it[0]).abs() <= 2.0 * step * SHARPEST)
    };
    let found = SIGMAS_IN_BENDS.into_iter().map(with).find(is_bend);
    found.unwrap_or(wide)
}

/// Smooths twice and adds back what the second pass removed ("twicing", Tukey 1977): a kernel of
/// fourth order, which does not change parabolas.
fn twiced(points: &[Vec2], step: f64, sigma: f64) -> Vec<Vec2> {
    let once = gaussian(points, step, sigma);
    let twice = gaussian(&once, step, sigma);
    once.iter()
        .zip(&twice)
        .map(|(a, b)| *a * 2.0 - *b)
        .collect()
}

/// Returns the moving average with a Gaussian kernel of this width, m; the ends are continued
/// straight.
fn gaussian(points: &[Vec2], step: f64, sigma: f64) -> Vec<Vec2> {
    let reach = (4.0 * sigma / step) as isize;
    let weights: Vec<f64> = (-reach..=reach)
        .map(|k| (-0.5 * (k as f64 * step / sigma).powi(2)).exp())
        .collect();
    let sum: f64 = weights.iter().sum();
    let last = points.len() as isize - 1;
    let point = |index: isize| {
        if index < 0 {
            points[0] + (points[0] - points[1]) * -index as f64
        } else if index > last {
            let (end, before) = (points[last as usize], points[last as usize - 1]);
            end + (end - before) * (index - last) as f64
        } else {
            points[index as usize]
        }
    };
    (0..=last)
        .map(|centre| {
            let average = weights
                .iter()
                .enumerate()
                .fold(Vec2::default(), |sum, (k, weight)| {
                    sum + point(centre + k as isize - reach) * *weight
                });
            average * (1.0 / sum)
        })
        .collect()
}

/// Returns the direction at each point, from its neighbours.
pub(super) fn headings(points: &[Vec2]) -> Vec<f64> {
    let last = points.len() - 1;
    (0..points.len())
        .map(|i| (points[(i + 1).min(last)] - points[i.saturating_sub(1)]).angle())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_circle_keeps_its_radius_and_a_corner_becomes_a_curve() {
        let circle: Vec<Vec2> = (0..120)
            .map(|i| Vec2::from_angle(f64::from(i) * 2.0 / 60.0) * 60.0)
            .collect();
        for point in &smoothed(&circle, 2.0)[40..80] {
            assert!((point.norm() - 60.0).abs() < 0.06, "{}", point.norm());
        }
        let quarter = |i| Vec2::from_angle(f64::from(i) / 10.0) * 30.0;
        let quarter: Vec<Vec2> = (0..16).map(quarter).collect();
        let line = [
            &[Vec2::new(30.0, -100.0)],
            &quarter[..],
            &[Vec2::new(-100.0, 30.0)],
        ];
        let line = resampled(&line.concat(), 2.0);
        for (raw, smooth) in line.iter().zip(smoothed(&line, 2.0)) {
            assert!((*raw - smooth).norm() < 0.2, "{raw:?} {smooth:?}");
        }
        let corner = [
            Vec2::new(-200.0, 0.0),
            Vec2::default(),
            Vec2::from_angle(0.02) * 200.0,
        ];
        let smooth = smoothed(&resampled(&corner, 2.0), 2.0);
        let bend = headings(&smooth)
            .windows(2)
            .map(|w| (w[1] - w[0]) / 2.0)
            .fold(0.0, f64::max);
        assert!(bend * 30.0 * 30.0 < 0.7, "{bend}");
    }

    #[test]
    fn samples_are_equally_far_apart() {
        let line = [
            Vec2::default(),
            Vec2::new(3.0, 0.0),
            Vec2::new(3.0, 7.1),
            Vec2::new(13.0, 7.1),
        ];
        let samples = resampled(&line, 0.1);
        assert_eq!(samples[0], line[0]);
        assert!((samples[samples.len() - 1] - line[3]).norm() < 1e-9);
        assert!(samples.windows(2).all(|w| (w[1] - w[0]).norm() < 0.101));
    }
}
