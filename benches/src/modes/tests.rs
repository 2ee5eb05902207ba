//! Mixtures with known states must be found, and one state must not be split.

use super::*;
use chacha20::ChaCha8Rng;
use chacha20::rand_core::SeedableRng as _;
use rand_distr::{Distribution, LogNormal};

/// Draws `count` times of a line around this median, ps, which differ by about `by`.
fn lines(rng: &mut ChaCha8Rng, median_ns: f64, by: f64, count: usize) -> Vec<f64> {
    let times = LogNormal::new((1e3 * median_ns).ln(), by).unwrap();
    (0..count).map(|_| times.sample(rng)).collect()
}

/// Asserts that these states are found, each with its median within 4 %, and the share of the lines
/// in it within 2 %.
fn assert_states(all: &[f64], expected: &[(f64, f64)]) {
    let found = find(all);
    let medians: Vec<f64> = found.iter().map(|mode| mode.line_ps / 1e3).collect();
    assert_eq!(found.len(), expected.len(), "{medians:?} {expected:?}");
    for (mode, (median_ns, share)) in found.iter().zip(expected) {
        assert!(
            (mode.line_ps / 1e3 / median_ns - 1.0).abs() < 0.04,
            "{medians:?}"
        );
        let inside = all.iter().filter(|ps| mode.range.contains(&ps.ln()));
        let part = inside.count() as f64 / all.len() as f64;
        assert!((part - share).abs() < 0.02, "{part} {share}");
    }
}

#[test]
fn known_states_are_found_with_their_shares() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    for _ in 0..100 {
        let mut all = lines(&mut rng, 39.0, 0.04, 60);
        all.extend(lines(&mut rng, 74.0, 0.05, 340));
        all.extend(lines(&mut rng, 250.0, 0.06, 200));
        assert_states(&all, &[(39.0, 0.1), (74.0, 0.567), (250.0, 0.333)]);
        // Two neighbours at 1.5 times each other, as sparse as a run of 3 turns.
        let mut all = lines(&mut rng, 80.0, 0.05, 40);
        all.extend(lines(&mut rng, 120.0, 0.05, 20));
        assert_states(&all, &[(80.0, 0.667), (120.0, 0.333)]);
    }
}

/// Also if the state is wide, as on a processor with a mesh, and if stalls make a long tail.
#[test]
fn one_state_is_not_split() {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    for by in [0.01, 0.05, 0.1, 0.2] {
        for count in [20, 100, 1000] {
            for _ in 0..100 {
                let mut all = lines(&mut rng, 150.0, by, count);
                let stalls = count / 40;
                all.extend(lines(&mut rng, 500.0, 0.8, stalls));
                let found = find(&all);
                assert_eq!(found.len(), 1, "{by} {count}: {found:?}");
            }
        }
    }
    assert_eq!(find(&[]), []);
    assert_eq!(find(&[74e3; 30]).len(), 1);
}

#[test]
fn a_batch_is_in_a_state_if_both_its_lines_are() {
    let modes = find(&[[74e3; 20], [250e3; 20]].concat());
    let expected = [
        ([75e3, 73e3], Some(0)),
        ([240e3, 260e3], Some(1)),
        ([75e3, 250e3], None),
    ];
    for (lines, state) in expected {
        assert_eq!(of_batch(&modes, lines), state);
    }
}

/// The range must hold the next run in 95 % of all pairs of runs, also if the times of a run drift.
#[test]
fn the_range_covers_the_next_run() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut drawn = |median: f64| -> Vec<Option<f64>> {
        lines(&mut rng, median, 0.05, 60)
            .into_iter()
            .map(Some)
            .collect()
    };
    let ratio = |case: &[Option<f64>], floor: &[Option<f64>]| {
        let p50 = |of: &[Option<f64>]| {
            let all: Vec<f64> = of.iter().copied().flatten().collect();
            tandem_page::format::median(&all).unwrap()
        };
        p50(case) / p50(floor)
    };
    let runs: Vec<_> = (0..400).map(|_| [drawn(80.0), drawn(74.0)]).collect();
    let covered = runs.windows(2).filter(|pair| {
        let [[case, floor], [next_case, next_floor]] = [&pair[0], &pair[1]];
        let by = next_run(case, floor).unwrap();
        let off = ratio(next_case, next_floor) / ratio(case, floor);
        (1.0 / by..by).contains(&off)
    });
    let share = covered.count() as f64 / 399.0;
    assert!((0.92..0.99).contains(&share), "{share}");
    // A run of 3 turns says nothing of the next one.
    assert_eq!(next_run(&[Some(1.0); 3], &[Some(1.0); 3]), None);
}
