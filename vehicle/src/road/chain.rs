//! Which lanelets make up a lane, and the raw centre line along them.

use std::collections::HashMap;

use crate::commonroad::Lanelet;
use crate::geometry::{Vec2, wrap_angle};

use super::{ROAD_MAX, RUN_OUT};

/// A successor that begins farther than this from the end of its lanelet is ignored, m.
const JOINT_MAX: f64 = 10.0;
/// A lanelet that is shorter than this and has no successor is a dead end, m: it is chosen at a
/// fork only if there is no other. A longer one may be cut by the edge of the map.
const DEAD_END: f64 = 50.0;
/// Largest number of lanes side by side.
const BESIDE_MAX: usize = 64;
/// Length over which the direction of a lane's end is measured, m: single pieces are noisy.
const END_PIECE: f64 = 40.0;

/// A lane as indices into the lanelets of a file.
pub(super) struct Chain {
    pub(super) pieces: Vec<usize>,
    /// Whether it begins beside or from an existing lane: at a fork, or as an added lane.
    pub(super) opens: bool,
    /// Whether it ends while a neighbour continues.
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

/// A lanelet's centre line with the values that other functions need.
pub(super) struct Piece {
    points: Vec<(Vec2, f64)>,
    start_heading: f64,
    end_heading: f64,
    length: f64,
}

impl Piece {
    pub(super) fn new(lanelet: &Lanelet) -> Self {
        let points = centre_points(lanelet);
        let line: Vec<Vec2> = points.iter().map(|(point, _)| *point).collect();
        Self {
            start_heading: start_heading(&line),
            end_heading: end_heading(&line),
            length: line.windows(2).map(|w| (w[1] - w[0]).norm()).sum(),
            points,
        }
    }

    fn first(&self) -> Vec2 {
        self.points[0].0
    }

    fn last(&self) -> Vec2 {
        self.points[self.points.len() - 1].0
    }
}

/// Every lanelet is in at least one chain; after a merge several chains share lanelets.
///
/// # Errors
/// If all chains with their run-outs exceed [`ROAD_MAX`] in total: their length so far, m.
pub(super) fn chains(lanelets: &[Lanelet], pieces: &[Piece]) -> Result<Vec<Chain>, f64> {
    let places: HashMap<i64, usize> = lanelets
        .iter()
        .enumerate()
        .rev()
        .map(|(index, lanelet)| (lanelet.id, index))
        .collect();
    // A successor that begins elsewhere is ignored: the road would cross a gap.
    let joined =
        |from: usize, to: usize| (pieces[to].first() - pieces[from].last()).norm() < JOINT_MAX;
    let those = |ids: &[i64], is_joined: &dyn Fn(usize) -> bool| -> Vec<usize> {
        let known = ids.iter().filter_map(|id| places.get(id).copied());
        known.filter(|index| is_joined(*index)).collect()
    };
    let all = lanelets.iter().enumerate();
    let after = |(from, it): (_, &Lanelet)| those(&it.successors, &|to| joined(from, to));
    let before = |(to, it): (_, &Lanelet)| those(&it.predecessors, &|from| joined(from, to));
    let successors: Vec<Vec<usize>> = all.clone().map(after).collect();
    let predecessors: Vec<Vec<usize>> = all.map(before).collect();
    let is_dead_end =
        |index: usize| successors[index].is_empty() && pieces[index].length < DEAD_END;
    let next: Vec<Option<usize>> = (0..lanelets.len())
        .map(|index| {
            let all = successors[index].iter().copied();
            let open = all.clone().filter(|to| !is_dead_end(*to));
            straightest(pieces, index, open).or_else(|| straightest(pieces, index, all))
        })
        .collect();
    let has_neighbour_that = |index: usize, test: &dyn Fn(usize) -> bool| {
        neighbours(lanelets, &places, index).into_iter().any(test)
    };
    // The last chain that each lanelet is in.
    let mut in_chain = vec![None; lanelets.len()];
    let mut length = 0.0;
    let mut follow = |start: usize, number: usize, in_chain: &mut [Option<usize>]| {
        let mut chain = vec![start];
        let mut last = start;
        in_chain[start] = Some(number);
        length += 2.0 * RUN_OUT + pieces[start].length;
        while let Some(successor) = next[last] {
            if in_chain[successor] == Some(number) {
                break;
            }
            in_chain[successor] = Some(number);
            length += pieces[successor].length;
            chain.push(successor);
            last = successor;
        }
        if length > ROAD_MAX {
            return Err(length);
        }
        let opens = !predecessors[start].is_empty()
            || has_neighbour_that(start, &|index| !predecessors[index].is_empty());
        let drops = successors[last].is_empty()
            && has_neighbour_that(last, &|index| !successors[index].is_empty());
        Ok(Chain {
            pieces: chain,
            opens,
            drops,
        })
    };
    let mut chains = Vec::new();
    let mut is_continued = vec![false; lanelets.len()];
    for successor in next.iter().flatten() {
        is_continued[*successor] = true;
    }
    let begins = (0..lanelets.len()).filter(|index| !is_continued[*index]);
    // The remaining lanelets form rings, which may begin anywhere.
    for start in begins.chain(0..lanelets.len()) {
        if in_chain[start].is_none() {
            chains.push(follow(start, chains.len(), &mut in_chain)?);
        }
    }
    Ok(chains)
}

/// Returns the successor whose centre line bends least from the lanelet's.
fn straightest(
    pieces: &[Piece],
    from: usize,
    candidates: impl Iterator<Item = usize>,
) -> Option<usize> {
    let heading = pieces[from].end_heading;
    let bend = |index: usize| wrap_angle(pieces[index].start_heading - heading).abs();
    candidates.min_by(|a, b| bend(*a).total_cmp(&bend(*b)))
}

/// Returns the lanelets beside this one, over up to [`BESIDE_MAX`] lanes, in the same direction.
fn neighbours(lanelets: &[Lanelet], places: &HashMap<i64, usize>, start: usize) -> Vec<usize> {
    let mut found = Vec::new();
    let mut open = vec![start];
    while let Some(index) = open.pop() {
        let lanelet = &lanelets[index];
        for id in [lanelet.left_neighbour, lanelet.right_neighbour]
            .into_iter()
            .flatten()
        {
            let index = places.get(&id).copied();
            if let Some(index) = index.filter(|index| !found.contains(index)) {
                found.push(index);
                open.push(index);
            }
        }
        if found.len() > BESIDE_MAX {
            break;
        }
    }
    found
}

/// Returns the first lane that contains each lanelet, by the lanelet's id.
pub(super) fn lanes_by_id(lanelets: &[Lanelet], chains: &[Chain]) -> HashMap<i64, usize> {
    let mut lanes = HashMap::new();
    for (lane, chain) in chains.iter().enumerate() {
        for piece in &chain.pieces {
            lanes.entry(lanelets[*piece].id).or_insert(lane);
        }
    }
    lanes
}

/// Returns the direction in which each lane continues beyond the map: the mean over all lanes that
/// end side by side, so that they stay side by side.
pub(super) fn run_out_headings(lines: &[CentreLine]) -> Vec<f64> {
    let ends: Vec<(Vec2, f64)> = lines
        .iter()
        .map(|line| (line.points[line.points.len() - 1], line.last_heading()))
        .collect();
    (0..lines.len())
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

/// Returns the lanes whose ends are side by side with this one's, directly or through other lanes.
fn side_by_side(ends: &[(Vec2, f64)], start: usize) -> Vec<usize> {
    let mut group = vec![start];
    let mut next = 0;
    while next < group.len() && group.len() < BESIDE_MAX {
        let (point, heading) = ends[group[next]];
        for (index, (other, other_heading)) in ends.iter().enumerate() {
            let near = (other.x - point.x).abs() < 8.0 && (*other - point).norm() < 8.0;
            let parallel = wrap_angle(other_heading - heading).abs() < 0.2;
            if near && parallel && group.len() < BESIDE_MAX && !group.contains(&index) {
                group.push(index);
            }
        }
        next += 1;
    }
    group
}

/// Returns the centre line through all pieces of a chain.
pub(super) fn centre_line(pieces: &[Piece], chain: &Chain) -> CentreLine {
    let mut line = CentreLine {
        points: Vec::new(),
        stations: Vec::new(),
        widths: Vec::new(),
        ends: Vec::new(),
    };
    for piece in &chain.pieces {
        for &(point, width) in &pieces[*piece].points {
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

    /// Returns the lanelet at this station.
    pub(super) fn piece_at(&self, station: f64) -> usize {
        let found = self.ends.partition_point(|(end, _)| *end <= station);
        self.ends[found.min(self.ends.len() - 1)].1
    }

    pub(super) fn width_at(&self, station: f64) -> f64 {
        let after = self.stations.partition_point(|s| *s <= station);
        let after = after.clamp(1, self.stations.len() - 1);
        let (from, to) = (self.stations[after - 1], self.stations[after]);
        let t = ((station - from) / (to - from)).clamp(0.0, 1.0);
        self.widths[after - 1] + (self.widths[after] - self.widths[after - 1]) * t
    }
}

/// Returns points halfway between the bounds, with the distance between the bounds.
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
    let (left, right) = (spread(&lanelet.left, count), spread(&lanelet.right, count));
    left.into_iter().zip(right).map(middle).collect()
}

/// `count + 1` points at equal distances along the polyline.
fn spread(points: &[Vec2], count: usize) -> Vec<Vec2> {
    let length: f64 = points.windows(2).map(|w| (w[1] - w[0]).norm()).sum();
    let (mut index, mut before) = (0, 0.0);
    let mut piece = (points[1] - points[0]).norm();
    (0..=count)
        .map(|sample| {
            let wanted = sample as f64 / count as f64 * length;
            while before + piece < wanted && index + 2 < points.len() {
                before += piece;
                index += 1;
                piece = (points[index + 1] - points[index]).norm();
            }
            points[index].lerp(points[index + 1], ((wanted - before) / piece).min(1.0))
        })
        .collect()
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
