//! The statistics against known values, by simulation, and by their properties.

use super::*;
use proptest::prelude::*;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng as _;
use rand_distr::{Distribution as _, LogNormal, Normal};

fn close(a: f64, b: f64) -> bool {
    (a - b).abs() < 1e-9
}

#[test]
fn u_has_its_exact_distribution() {
    // Mann and Whitney's recursion, worked by hand: 3 of 6 can be chosen in 20 ways.
    let ways = u_distribution(3, 3);
    assert_eq!(ways, [1.0, 1.0, 2.0, 3.0, 3.0, 3.0, 3.0, 2.0, 1.0, 1.0]);
    assert_eq!(u_distribution(2, 3), [1.0, 1.0, 2.0, 2.0, 2.0, 1.0, 1.0]);
    // 10 choose 5, 40 choose 20.
    assert!(close(u_distribution(5, 5).iter().sum(), 252.0));
    assert!(close(
        u_distribution(20, 20).iter().sum(),
        137_846_528_820.0
    ));
}

#[test]
fn the_exact_test_gives_the_values_of_the_tables() {
    let up_to = |n: u32| (1..=n).map(f64::from).collect::<Vec<f64>>();
    let above = |n: u32, by: f64| up_to(n).iter().map(|v| v + by).collect::<Vec<f64>>();
    // Wholly apart: 2 of C(n + m, n) ways.
    assert!(close(
        mann_whitney_p(&up_to(3), &above(3, 100.0)),
        2.0 / 20.0
    ));
    assert!(close(
        mann_whitney_p(&up_to(5), &above(5, 100.0)),
        2.0 / 252.0
    ));
    assert!(close(
        mann_whitney_p(&above(8, 100.0), &up_to(8)),
        2.0 / 12_870.0
    ));
    // U = 1 for 4 and 4: 2 (1 + 1) of 70 ways.
    let (a, b) = ([1.0, 2.0, 3.0, 5.0], [4.0, 6.0, 7.0, 8.0]);
    assert!(close(mann_whitney_p(&a, &b), 4.0 / 70.0));
    // The middle of the distribution is no evidence at all.
    assert!(close(mann_whitney_p(&[1.0, 4.0], &[2.0, 3.0]), 1.0));
}

#[test]
fn critical_values_are_those_of_the_tables() {
    // Two-sided 5 %: U is significant up to these (tables of Mann and Whitney's U).
    for (n, m, critical) in [
        (5, 5, 2),
        (8, 8, 13),
        (10, 10, 23),
        (12, 7, 18),
        (20, 20, 127),
    ] {
        assert_eq!(cut(n, m, 0.025), Some(critical), "{n} {m}");
    }
    assert_eq!(cut(3, 3, 0.025), None);
}

#[test]
fn equal_values_share_their_ranks_and_the_test_stays_exact() {
    // Ranks 1.5 1.5 3.5 | 3.5 5.5 5.5: of the 20 choices of three, those as far from 10.5 as 6.5
    // are {1.5 1.5 3.5} twice and {5.5 5.5 3.5} twice.
    let p = mann_whitney_p(&[1.0, 1.0, 2.0], &[2.0, 3.0, 3.0]);
    assert!(close(p, 4.0 / 20.0), "{p}");
    assert!(close(mann_whitney_p(&[7.0; 10], &[7.0; 12]), 1.0));
    assert!(close(mann_whitney_p(&[7.0; 100], &[7.0; 100]), 1.0));
}

#[test]
fn the_approximation_meets_the_exact_value() {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let normal = Normal::new(0.0, 1.0).unwrap();
    for shift in [0.0, 0.4, 0.8] {
        let a: Vec<f64> = (0..20).map(|_| normal.sample(&mut random)).collect();
        let b: Vec<f64> = (0..20)
            .map(|_| normal.sample(&mut random) + shift)
            .collect();
        let ranks = doubled_ranks(&a, &b);
        let sum = ranks[..20].iter().sum();
        let (exact, normal) = (exact_p(&ranks, 20, sum), normal_p(&ranks, 20, sum));
        assert!((exact - normal).abs() < 0.01, "{exact} {normal}");
    }
}

#[test]
fn the_normal_distribution_has_its_quantiles() {
    assert!((normal_quantile(0.025) - 1.959_963_985).abs() < 1e-6);
    assert!((normal_quantile(0.0005) - 3.290_526_731).abs() < 1e-6);
}

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
fn welch_agrees_with_a_worked_example() {
    // Means 2 and 5, variances 1 and 4, three values each: t = 3 / sqrt(5/3), 2.94 degrees.
    let (p, interval) = welch(&[1.0, 2.0, 3.0], &[3.0, 5.0, 7.0], 0.95).unwrap();
    let (t, freedom) = (3.0 / (5.0_f64 / 3.0).sqrt(), (25.0 / 9.0) / (17.0 / 18.0));
    assert!((p - student_p(t, freedom)).abs() < 1e-12);
    assert!((0.09..0.12).contains(&p), "{p}");
    assert_eq!(interval.middle, 3.0);
    assert!(interval.low < 0.0 && interval.high > 6.0);
    assert!(welch(&[1.0], &[1.0, 2.0], 0.95).is_none());
}

#[test]
fn welch_is_not_rash_with_three_batches() {
    let mut random = ChaCha8Rng::seed_from_u64(10);
    let runs = 2000;
    let mut errors = 0;
    for _ in 0..runs {
        let log = |values: Vec<f64>| values.into_iter().map(f64::ln).collect::<Vec<_>>();
        let a = log(batches(&mut random, 3, 1.0));
        let b = log(batches(&mut random, 3, 1.0));
        errors += u32::from(welch(&a, &b, 0.95).unwrap().0 <= 0.05);
    }
    // 100 expected at most; Welch errs on the safe side with so few.
    assert!((30..=130).contains(&errors), "{errors} of {runs}");
}

/// Batches of a run on a machine like ours: most alike, some far off.
fn batches(random: &mut ChaCha8Rng, n: usize, factor: f64) -> Vec<f64> {
    let noise = LogNormal::new(0.0, 0.06).unwrap();
    (0..n)
        .map(|_| 80.0 * factor * noise.sample(random))
        .collect()
}

#[test]
fn without_a_change_the_test_errs_as_rarely_as_it_says() {
    let mut random = ChaCha8Rng::seed_from_u64(7);
    // 12 and 15 are exact, 40 and 30 approximated.
    for (n, m) in [(12, 15), (40, 30)] {
        let (runs, alpha) = (1000, 0.05);
        let mut errors = 0;
        for _ in 0..runs {
            let (a, b) = (batches(&mut random, n, 1.0), batches(&mut random, m, 1.0));
            errors += u32::from(mann_whitney_p(&a, &b) <= alpha);
        }
        // 50 expected; 3.5 deviations of the binomial distribution are 24.
        assert!((20..=74).contains(&errors), "{n} {m}: {errors} of {runs}");
    }
}

#[test]
fn a_tenth_more_is_found() {
    let mut random = ChaCha8Rng::seed_from_u64(8);
    let runs = 200;
    let mut found = 0;
    for _ in 0..runs {
        let (a, b) = (batches(&mut random, 20, 1.0), batches(&mut random, 20, 1.1));
        found += u32::from(mann_whitney_p(&a, &b) <= 0.05);
    }
    assert!(found > 190, "{found} of {runs}");
}

#[test]
fn the_interval_holds_the_shift_as_often_as_it_says() {
    let mut random = ChaCha8Rng::seed_from_u64(9);
    for (n, m) in [(10, 12), (30, 40)] {
        let runs = 1000;
        let mut held = 0;
        for _ in 0..runs {
            let log = |values: Vec<f64>| values.into_iter().map(f64::ln).collect::<Vec<_>>();
            let a = log(batches(&mut random, n, 1.0));
            let b = log(batches(&mut random, m, 1.1));
            let interval = shift(&a, &b, 0.95).unwrap();
            held += u32::from((interval.low..=interval.high).contains(&1.1_f64.ln()));
        }
        // 950 expected at least; 3.5 deviations are 24.
        assert!((926..=985).contains(&held), "{n} {m}: {held} of {runs}");
    }
}

#[test]
fn too_few_values_bound_nothing() {
    let interval = shift(&[1.0, 2.0], &[5.0, 6.0], 0.95).unwrap();
    assert_eq!(interval.middle, 4.0);
    assert_eq!(
        (interval.low, interval.high),
        (f64::NEG_INFINITY, f64::INFINITY)
    );
    assert!(shift(&[], &[1.0], 0.95).is_none());
    assert_eq!(mann_whitney_p(&[], &[1.0]), 1.0);
}

#[test]
fn holm_multiplies_by_what_is_left() {
    // Worked by hand: 0.01 x 4, 0.02 x 3, 0.03 x 2, and never below the one before.
    let adjusted = holm(&[0.03, 0.01, 0.9, 0.02]);
    for (is, shall) in adjusted.iter().zip([0.06, 0.04, 0.9, 0.06]) {
        assert!(close(*is, shall), "{adjusted:?}");
    }
    assert!(holm(&[]).is_empty());
}

/// Values with equal ones among them.
fn sample() -> impl Strategy<Value = Vec<f64>> {
    prop::collection::vec((0_u32..30).prop_map(f64::from), 1..15)
}

proptest! {
    #[test]
    fn the_test_does_not_care_which_sample_is_first(a in sample(), b in sample()) {
        let p = mann_whitney_p(&a, &b);
        prop_assert!((0.0..=1.0).contains(&p) && p > 0.0);
        prop_assert!(close(p, mann_whitney_p(&b, &a)));
    }

    #[test]
    fn the_test_sees_ranks_only(a in sample(), b in sample()) {
        let bent = |values: &[f64]| values.iter().map(|v| v.exp()).collect::<Vec<f64>>();
        prop_assert!(close(mann_whitney_p(&a, &b), mann_whitney_p(&bent(&a), &bent(&b))));
    }

    #[test]
    fn the_interval_moves_with_the_sample(a in sample(), b in sample(), by in -9_i32..9) {
        let by = f64::from(by);
        let moved: Vec<f64> = b.iter().map(|v| v + by).collect();
        let (one, other) = (shift(&a, &b, 0.95).unwrap(), shift(&a, &moved, 0.95).unwrap());
        prop_assert!(close(one.middle + by, other.middle));
        prop_assert!(one.low <= one.middle && one.middle <= one.high);
        prop_assert!(one.low.is_infinite() || close(one.low + by, other.low));
    }

    #[test]
    fn holm_never_makes_a_value_smaller_and_keeps_the_order(
        p in prop::collection::vec(0.0..1.0_f64, 0..30)
    ) {
        let adjusted = holm(&p);
        for (i, a) in p.iter().enumerate() {
            prop_assert!(adjusted[i] >= *a && adjusted[i] <= 1.0);
            prop_assert!(adjusted[i] <= a * p.len() as f64 + 1e-12);
            for (j, b) in p.iter().enumerate() {
                prop_assert!(a > b || adjusted[i] <= adjusted[j] + 1e-12);
            }
        }
    }
}
