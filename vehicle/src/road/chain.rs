//! Which lanelets make up a lane, and the raw centre line along them.

use std::collections::HashMap;

use crate::commonroad::Lanelet;
use crate::geometry::{Vec2, wrap_angle};

/// Over this length the direction of an end of a lane is taken, m: single pieces are noisy.
const END_PIECE: f64 = 40.0;

/// A lane as indices into the lanelets of a file.
pub(super) struct Chain {
    pub(super) pieces: Vec<usize>,
    /// It begins where another lane was already: a fork, or a lane that opens.
    pub(super) opens: bool,
    /// It ends while a neighbour continues.
    pub(super) drops: bool,
}

/// A polyline with widths, before smoothing.
pub(super) struct CentreLine {
    pub(super) points: Vec<Vec2>,
    /// Arc length at each point.
    pub(super) stations: Vec<f64>,
    widths: Vec<f64>,
    /// Where each piece ends, and which lanelet it is.
    ends: Vec<(f64, usize)>,
}

/// Every lanelet is in at least one chain; after a merge several chains share lanelets.
pub(super) fn chains(lanelets: &[Lanelet]) -> Vec<Chain> {
    let places: HashMap<i64, usize> = lanelets
        .iter()
        .enumerate()
        .rev()
        .map(|(index, lanelet)| (lanelet.id, index))
        .collect();
    let index_of = |id: i64| places.get(&id).copied();
    let known = |ids: &[i64]| {
        ids.iter()
            .filter_map(|id| index_of(*id))
            .collect::<Vec<_>>()
    };
    let next: Vec<Option<usize>> = lanelets
        .iter()
        .map(|l| straightest(lanelets, l, &known(&l.successors)))
        .collect();
    let has_neighbour_that = |lanelet: &Lanelet, test: &dyn Fn(&Lanelet) -> bool| {
        neighbours(lanelets, &places, lanelet)
            .into_iter()
            .any(|index| test(&lanelets[index]))
    };
    let follow = |start: usize, seen: &mut [bool]| {
        let mut pieces = vec![start];
        seen[start] = true;
        while let Some(successor) = next[pieces[pieces.len() - 1]] {
            if pieces.contains(&successor) {
                break;
            }
            seen[successor] = true;
            pieces.push(successor);
        }
        let (first, last) = (&lanelets[start], &lanelets[pieces[pieces.len() - 1]]);
        let opens = !known(&first.predecessors).is_empty()
            || has_neighbour_that(first, &|l| !known(&l.predecessors).is_empty());
        let drops = known(&last.successors).is_empty()
            && has_neighbour_that(last, &|l| !known(&l.successors).is_empty());
        Chain {
            pieces,
            opens,
            drops,
        }
    };
    let mut seen = vec![false; lanelets.len()];
    let mut chains = Vec::new();
    let mut is_continued = vec![false; lanelets.len()];
    for successor in next.iter().flatten() {
        is_continued[*successor] = true;
    }
    for start in (0..lanelets.len()).filter(|index| !is_continued[*index]) {
        chains.push(follow(start, &mut seen));
    }
    // What is left are rings: they begin anywhere.
    while let Some(start) = seen.iter().position(|seen| !seen) {
        chains.push(follow(start, &mut seen));
    }
    chains
}

/// The successor whose centre line bends least from the lanelet's.
fn straightest(lanelets: &[Lanelet], from: &Lanelet, candidates: &[usize]) -> Option<usize> {
    let direction = |lanelet: &Lanelet, end: bool| {
        let line = centre_points(lanelet);
        let line: Vec<Vec2> = line.into_iter().map(|(point, _)| point).collect();
        if end {
            end_heading(&line)
        } else {
            start_heading(&line)
        }
    };
    let heading = direction(from, true);
    let bend = |index: usize| wrap_angle(direction(&lanelets[index], false) - heading).abs();
    candidates
        .iter()
        .copied()
        .min_by(|a, b| bend(*a).total_cmp(&bend(*b)))
}

/// All lanelets beside this one, over any number of lanes, in the same direction.
fn neighbours(lanelets: &[Lanelet], places: &HashMap<i64, usize>, lanelet: &Lanelet) -> Vec<usize> {
    let mut found = Vec::new();
    let mut open = vec![lanelet];
    while let Some(lanelet) = open.pop() {
        for id in [lanelet.left_neighbour, lanelet.right_neighbour]
            .into_iter()
            .flatten()
        {
            let index = places.get(&id).copied();
            if let Some(index) = index.filter(|index| !found.contains(index)) {
                found.push(index);
                open.push(&lanelets[index]);
            }
        }
    }
    found
}

/// The first lane that contains each lanelet, by the lanelet's id.
pub(super) fn lanes_by_id(lanelets: &[Lanelet], chains: &[Chain]) -> HashMap<i64, usize> {
    let mut lanes = HashMap::new();
    for (lane, chain) in chains.iter().enumerate() {
        for piece in &chain.pieces {
            lanes.entry(lanelets[*piece].id).or_insert(lane);
        }
    }
    lanes
}

/// The direction in which each lane continues beyond the map: the mean over all lanes that end side
/// by side, so that they stay side by side.
pub(super) fn run_out_headings(lanelets: &[Lanelet], chains: &[Chain]) -> Vec<f64> {
    let ends: Vec<(Vec2, f64)> = chains
        .iter()
        .map(|chain| {
            let line = centre_line(lanelets, chain);
            (line.points[line.points.len() - 1], line.last_heading())
        })
        .collect();
    (0..chains.len())
        .map(|index| {
            let heading = ends[index].1;
            let group = side_by_side(&ends, index);
            let offsets = group
                .iter()
                .map(|other| wrap_angle(ends[*other].1 - heading));
            let mean = offsets.sum::<f64>() / group.len() as f64;
            wrap_angle(heading + mean)
        })
        .collect()
}

/// The lanes whose ends can be reached from this one's in steps of one lane.
fn side_by_side(ends: &[(Vec2, f64)], start: usize) -> Vec<usize> {
    let mut group = vec![start];
    let mut next = 0;
    while next < group.len() {
        let (point, heading) = ends[group[next]];
        for (index, (other, other_heading)) in ends.iter().enumerate() {
            let near = (*other - point).norm() < 8.0;
            let parallel = wrap_angle(other_heading - heading).abs() < 0.2;
            if near && parallel && !group.contains(&index) {
                group.push(index);
            }
        }
        next += 1;
    }
    group
}

/// The centre line through all pieces of a chain.
pub(super) fn centre_line(lanelets: &[Lanelet], chain: &Chain) -> CentreLine {
    let mut line = CentreLine {
        points: Vec::new(),
        stations: Vec::new(),
        widths: Vec::new(),
        ends: Vec::new(),
    };
    for piece in &chain.pieces {
        for (point, width) in centre_points(&lanelets[*piece]) {
            let step = line
                .points
                .last()
                .map_or(0.0, |last| (point - *last).norm());
            if line.points.is_empty() || step > 0.05 {
                let station = line.stations.last().map_or(0.0, |station| station + step);
                line.points.push(point);
                line.stations.push(station);
                line.widths.push(width);
            }
        }
        line.ends
            .push((line.stations[line.stations.len() - 1], *piece));
    }
    if line.points.len() < 2 {
        // Bounds that cross each other leave a single point; a lane needs a direction.
        line.points.push(line.points[0] + Vec2::new(0.1, 0.0));
        line.stations.push(0.1);
        line.widths.push(line.widths[0]);
    }
    line
}

impl CentreLine {
    pub(super) fn first_heading(&self) -> f64 {
        start_heading(&self.points)
    }

    pub(super) fn last_heading(&self) -> f64 {
        end_heading(&self.points)
    }

    /// The lanelet at this station.
    pub(super) fn piece_at(&self, station: f64) -> usize {
        let found = self.ends.iter().find(|(end, _)| station < *end);
        found.unwrap_or(&self.ends[self.ends.len() - 1]).1
    }

    pub(super) fn width_at(&self, station: f64) -> f64 {
        let after = self.stations.partition_point(|s| *s <= station);
        let after = after.clamp(1, self.stations.len() - 1);
        let (from, to) = (self.stations[after - 1], self.stations[after]);
        let t = ((station - from) / (to - from)).clamp(0.0, 1.0);
        self.widths[after - 1] + (self.widths[after] - self.widths[after - 1]) * t
    }
}

/// Points halfway between the bounds, with the distance of the bounds.
fn centre_points(lanelet: &Lanelet) -> Vec<(Vec2, f64)> {
    let middle = |(a, b): (Vec2, Vec2)| (a.lerp(b, 0.5), (a - b).norm());
    if lanelet.left.len() == lanelet.right.len() {
        let pairs = lanelet
            .left
            .iter()
            .copied()
            .zip(lanelet.right.iter().copied());
        return pairs.map(middle).collect();
    }
    let count = lanelet.left.len().max(lanelet.right.len()) * 4;
    (0..=count)
        .map(|i| {
            let share = i as f64 / count as f64;
            middle((along(&lanelet.left, share), along(&lanelet.right, share)))
        })
        .collect()
}

/// The point at this share of the polyline's length.
fn along(points: &[Vec2], share: f64) -> Vec2 {
    let length: f64 = points.windows(2).map(|w| (w[1] - w[0]).norm()).sum();
    let mut left = share * length;
    for pair in points.windows(2) {
        let piece = (pair[1] - pair[0]).norm();
        if left <= piece {
            return pair[0].lerp(pair[1], left / piece);
        }
        left -= piece;
    }
    points[points.len() - 1]
}

fn start_heading(points: &[Vec2]) -> f64 {
    let first = points[0];
    let far = points.iter().find(|p| (**p - first).norm() > END_PIECE);
    (*far.unwrap_or(&points[points.len() - 1]) - first).angle()
}

fn end_heading(points: &[Vec2]) -> f64 {
    let last = points[points.len() - 1];
    let far = points
        .iter()
        .rev()
        .find(|p| (**p - last).norm() > END_PIECE);
    (last - *far.unwrap_or(&points[0])).angle()
}
