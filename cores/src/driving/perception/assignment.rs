//! Assignment of detections to tracks with the least total cost.
//!
//! Shortest augmenting paths with potentials, O(n² m): R. Jonker, A. Volgenant, "A Shortest
//! Augmenting Path Algorithm for Dense and Sparse Linear Assignment Problems", Computing 38 (1987).

use heapless::Vec;

use super::{MAX_DETECTIONS, MAX_TRACKS};

/// A pair outside the gate.
pub(crate) const IMPOSSIBLE: f32 = 1e6;
/// Cost of leaving a track without a detection: more than any pair within the gate.
const UNASSIGNED: f32 = 60.0;
/// Real columns, and one separate column for every track that stays without a detection.
const COLUMNS: usize = MAX_DETECTIONS + MAX_TRACKS;

/// Costs of all pairs; rows are tracks, columns are detections.
pub(crate) type Costs = Vec<[f32; MAX_DETECTIONS], MAX_TRACKS>;

/// The detection of each track.
type Assigned = [Option<usize>; MAX_TRACKS];

/// Returns the detection of each track, if it has one of the first `detections`. Time is bounded by
/// `MAX_TRACKS² × (MAX_DETECTIONS + MAX_TRACKS)` steps.
pub(crate) fn assign(costs: &Costs, detections: usize) -> Assigned {
    let detections = detections.min(MAX_DETECTIONS);
    undisputed(costs, detections).unwrap_or_else(|| by_paths(costs, detections))
}

/// Returns the only pairs within the gate, if no two of them share a track or a detection.
fn undisputed(costs: &Costs, detections: usize) -> Option<Assigned> {
    let mut result = [None; MAX_TRACKS];
    let mut taken = [false; MAX_DETECTIONS];
    for (row, own) in costs.iter().zip(&mut result) {
        for (column, &cost) in row[..detections].iter().enumerate() {
            if cost == IMPOSSIBLE {
                continue;
            }
            if taken[column] || own.is_some() || cost.is_nan() || cost >= UNASSIGNED {
                return None;
            }
            (taken[column], *own) = (true, Some(column));
        }
    }
    Some(result)
}

/// Returns the assignment by shortest augmenting paths.
fn by_paths(costs: &Costs, detections: usize) -> Assigned {
    let tracks = costs.len();
    let columns = detections + tracks;
    let cost = |row: usize, column: usize| {
        if column < detections {
            costs[row][column]
        } else if column == detections + row {
            UNASSIGNED
        } else {
            IMPOSSIBLE
        }
    };
    // Row 0 and column 0 are virtual: the algorithm needs them.
    let mut row_potential = [0.0_f32; MAX_TRACKS + 1];
    let mut column_potential = [0.0_f32; COLUMNS + 1];
    let mut row_of = [0_usize; COLUMNS + 1];
    for row in 1..=tracks {
        let mut before = [0_usize; COLUMNS + 1];
        let mut slack = [f32::INFINITY; COLUMNS + 1];
        let mut visited = [false; COLUMNS + 1];
        row_of[0] = row;
        let mut column = 0;
        while row_of[column] != 0 {
            visited[column] = true;
            let (mut least, mut next) = (f32::INFINITY, 0);
            let here = row_of[column];
            for other in 1..=columns {
                if visited[other] {
                    continue;
                }
                let reduced =
                    cost(here - 1, other - 1) - row_potential[here] - column_potential[other];
                if reduced < slack[other] {
                    slack[other] = reduced;
                    before[other] = column;
                }
                if slack[other] < least {
                    least = slack[other];
                    next = other;
                }
            }
            for other in 0..=columns {
                if visited[other] {
                    row_potential[row_of[other]] += least;
                    column_potential[other] -= least;
                } else {
                    slack[other] -= least;
                }
            }
            column = next;
        }
        while column != 0 {
            let back = before[column];
            row_of[column] = row_of[back];
            column = back;
        }
    }
    let mut result = [None; MAX_TRACKS];
    for column in 1..=detections {
        let row = row_of[column];
        if row > 0 && costs[row - 1][column - 1] < UNASSIGNED {
            result[row - 1] = Some(column - 1);
        }
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    fn costs(rows: &[&[f32]]) -> Costs {
        let row = |values: &&[f32]| {
            let mut row = [IMPOSSIBLE; MAX_DETECTIONS];
            row[..values.len()].copy_from_slice(values);
            row
        };
        rows.iter().map(row).collect()
    }

    #[test]
    fn the_least_sum_wins_over_the_nearest_neighbour() {
        // Greedy would give track 0 its detection 0 (cost 1) and leave track 1 with cost 20.
        let result = assign(&costs(&[&[1.0, 2.0], &[1.5, 20.0]]), 2);
        assert_eq!(&result[..2], &[Some(1), Some(0)]);
    }

    #[test]
    fn outside_the_gate_nothing_is_assigned() {
        let result = assign(&costs(&[&[IMPOSSIBLE, IMPOSSIBLE], &[IMPOSSIBLE, 3.0]]), 2);
        assert_eq!(&result[..2], &[None, Some(1)]);
        assert_eq!(assign(&costs(&[]), 5), [None; MAX_TRACKS]);
        assert_eq!(assign(&costs(&[&[] as &[f32]; 5]), 0), [None; MAX_TRACKS]);
    }

    /// Compares with all permutations of small problems with seeded costs.
    #[test]
    fn as_good_as_trying_all() {
        let mut seed = 1_u32;
        let mut random = || {
            seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (seed >> 16) as f32 / 65_536.0 * 40.0
        };
        let mut undisputed_ones = 0;
        for round in 0..400 {
            let (tracks, detections) = (4, 5);
            let gate = if round % 2 == 0 { 25.0 } else { 5.0 };
            let mut problem = costs(&[&[] as &[f32]; 4]);
            for row in &mut problem {
                for cost in row.iter_mut().take(detections) {
                    let value = random();
                    *cost = if value > gate { IMPOSSIBLE } else { value };
                }
            }
            let result = assign(&problem, detections);
            assert_eq!(result, by_paths(&problem, detections));
            undisputed_ones += u32::from(undisputed(&problem, detections).is_some());
            let total: f32 = (0..tracks)
                .map(|t| result[t].map_or(UNASSIGNED, |d| problem[t][d]))
                .sum();
            assert!((total - best(&problem, 0, tracks, detections, 0)).abs() < 1e-2);
        }
        assert!((20..380).contains(&undisputed_ones), "{undisputed_ones}");
    }

    fn best(problem: &Costs, track: usize, tracks: usize, detections: usize, used: u32) -> f32 {
        if track == tracks {
            return 0.0;
        }
        let mut least = UNASSIGNED + best(problem, track + 1, tracks, detections, used);
        for detection in 0..detections {
            if used & 1 << detection == 0 && problem[track][detection] < UNASSIGNED {
                let rest = best(
                    problem,
                    track + 1,
                    tracks,
                    detections,
                    used | 1 << detection,
                );
                least = least.min(problem[track][detection] + rest);
            }
        }
        least
    }
}
