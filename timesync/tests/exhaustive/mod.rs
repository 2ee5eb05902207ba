//! Every sequence of a number of faults, tried on one protocol.

use std::fmt::Debug;

/// Runs each sequence of `length` of these fates, at the start and after three good ones, with
/// `quiet` good ones at its end. No sample may be wrong, and the last fate must give one. `run`
/// returns of each sample its place and its error, ns. Returns the number of samples.
pub(crate) fn no_sequence_gives_a_wrong_sample<F: Copy + Debug>(
    fates: &[F],
    (good, length, quiet): (F, u32, usize),
    run: impl Fn(&[F]) -> Vec<(usize, i64)>,
) -> usize {
    let mut given = 0;
    for prefix in [0, 3] {
        for number in 0..fates.len().pow(length) {
            let digit = |n: u32| fates[number / fates.len().pow(n) % fates.len()];
            let mut sequence = vec![good; prefix];
            sequence.extend((0..length).map(digit));
            sequence.extend(vec![good; quiet]);
            let samples = run(&sequence);
            assert!(
                samples.iter().all(|&(_, error)| error == 0),
                "{sequence:?}: {samples:?}"
            );
            let last = samples.last().map(|&(n, _)| n);
            assert_eq!(
                last,
                Some(sequence.len() - 1),
                "{sequence:?}: does not recover"
            );
            given += samples.len();
        }
    }
    given
}
