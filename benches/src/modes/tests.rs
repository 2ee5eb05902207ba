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

#[test]
fn the_range_is_that_of_nine_turns_in_ten_in_one_state() {
    let case: Vec<Option<f64>> = (1..=100).map(|at| Some(f64::from(at) * 2.0)).collect();
    assert_eq!(range(&case, &[Some(2.0); 100]), Some([6.0, 95.0]));
    let mut floor = vec![Some(2.0); 100];
    floor[10..].fill(None);
    assert_eq!(range(&case, &floor), Some([1.0, 10.0]));
    floor[9] = None;
    assert_eq!(range(&case, &floor), None);
}

/// Also if a whole run is up to 5 % faster or slower than the next: what two runs of one program
/// differed by on a virtual machine.
#[test]
fn the_range_covers_the_next_run() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let runs: Vec<[Vec<f64>; 2]> = (0..400)
        .map(|_| {
            let near = lines(&mut rng, 80.0, 0.025, 1)[0] / 1e3;
            [near, 74.0].map(|median| lines(&mut rng, median, 0.05, 60))
        })
        .collect();
    let ratio = |[case, floor]: &[Vec<f64>; 2]| {
        let p50 = |of: &[f64]| tandem_page::format::median(of).unwrap();
        p50(case) / p50(floor)
    };
    let covered = runs.windows(2).filter(|pair| {
        let [case, floor] = pair[0].each_ref().map(|of| of.iter().map(|ps| Some(*ps)));
        let [low, high] = range(&case.collect::<Vec<_>>(), &floor.collect::<Vec<_>>()).unwrap();
        (low..high).contains(&ratio(&pair[1]))
    });
    assert!(covered.count() >= 380);
}
