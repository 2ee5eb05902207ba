//! Lanes with smooth centre lines: arc length and offset, neighbours, ends.
//!
//! Lanelets are chained into lanes: each lanelet continues with the successor that bends least and
//! is not a dead end. Centre lines are smoothed, because maps have corners where roads have curves
//! (US-101 has noisy points every few metres; A9 has corners of 0.02 rad every hundred metres).
//!
//! **Beyond the map.** A lane that ends because the map ends is continued straight without end,
//! parallel to its neighbours. If a lane ends while a neighbour continues, the end is real: a lane
//! drop.

use std::collections::HashSet;

use crate::commonroad::Lanelet;
use crate::geometry::{Vec2, wrap_angle};
use crate::road::chain::{CentreLine, Chain, Piece};

mod chain;
pub(crate) mod domain;
mod line;
mod smooth;

pub use domain::Exit;
use line::Line;
pub(crate) use line::{Foot, Point, Rough};

/// Distance between two samples of a centre line, m.
const STEP: f64 = 2.0;
/// Length of the straight pieces before and after the mapped lane, smoothed with it, m.
const RUN_OUT: f64 = 120.0;
/// Largest total length of all lanes, m: each metre takes 90 bytes and adds a few nanoseconds to
/// each search of the whole road.
pub const ROAD_MAX: f64 = 1e6;
/// An end of the domain is passed when it is farther than this behind the vehicle's centre, m.
const EXIT_PASSED: f64 = 4.0;
/// Weight of a difference of direction when the start lane is chosen, m/rad.
const HEADING_WEIGHT: f64 = 8.0;

/// Identifies a lane of a road.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct LaneId(pub usize);

/// Place in the coordinates of a lane.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Frenet {
    /// Arc length along the centre line, m.
    pub s: f64,
    /// Distance to the centre line, m, left positive.
    pub d: f64,
}

/// A lane at one arc length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Section {
    /// Point of the centre line.
    pub centre: Vec2,
    /// Direction of the centre line, rad.
    pub heading: f64,
    /// 1/m, left positive.
    pub curvature: f64,
    /// m
    pub width: f64,
    /// Neighbour to the left in the same direction.
    pub left: Option<LaneId>,
    /// Neighbour to the right in the same direction.
    pub right: Option<LaneId>,
    /// m/s; infinite if there is none.
    pub speed_limit: f64,
    /// Cars must not drive here.
    pub is_refused: bool,
    /// Persons cross other lanes here: for these it is no lane.
    pub(crate) is_crosswalk: bool,
    /// Id of its lanelet in the file.
    pub(crate) lanelet: i64,
    /// The bend of the map that smoothing hides here, 1/m; 0 if it hides none.
    pub(crate) hidden_bend: f64,
}

/// A lane: a smooth centre line, its width and its neighbours.
#[derive(Clone, Debug)]
pub struct RoadLane {
    /// Ids of its lanelets in the file, in driving direction.
    pub lanelets: Vec<i64>,
    /// Where it begins, if other lanes begin earlier.
    pub begin: Option<f64>,
    /// Where it ends, if other lanes continue.
    pub end: Option<f64>,
    /// One every [`STEP`] metres; beyond them the lane continues straight.
    sections: Vec<Section>,
    /// The centre line.
    pub(crate) line: Line,
    /// The largest width, m.
    pub(crate) width_max: f64,
    /// Where the operational design domain ends on it, by arc length.
    exits: Vec<(f64, Exit)>,
}

impl RoadLane {
    /// Returns the lane at arc length `s`; extrapolated straight outside of the map.
    #[must_use]
    pub fn at(&self, s: f64) -> Section {
        let (a, b, t, beyond) = self.around(s);
        let Point { centre, heading } = self.line.at(s);
        Section {
            centre,
            heading,
            curvature: curvature(a, b, t, beyond),
            width: width(a, b, t),
            ..*nearer(a, b, t)
        }
    }

    /// Returns the neighbours to the left and to the right at `s`, as in [`RoadLane::at`].
    pub(crate) fn beside(&self, s: f64) -> [Option<LaneId>; 2] {
        let (a, b, t, _) = self.around(s);
        let section = nearer(a, b, t);
        [section.left, section.right]
    }

    /// Returns the samples before and after `s`, the fraction of the way between them, and the
    /// distance beyond all samples, m.
    fn around(&self, s: f64) -> (&Section, &Section, f64, f64) {
        let (index, t, beyond) = self.line.around(s);
        let next = (index + 1).min(self.sections.len() - 1);
        (&self.sections[index], &self.sections[next], t, beyond)
    }

    /// Returns the width at `s`, as in [`RoadLane::at`], m.
    pub(crate) fn width_at(&self, s: f64) -> f64 {
        let (a, b, t, _) = self.around(s);
        width(a, b, t)
    }

    /// Returns the curvature at `s`, as in [`RoadLane::at`], 1/m.
    pub(crate) fn curvature_at(&self, s: f64) -> f64 {
        let (a, b, t, beyond) = self.around(s);
        curvature(a, b, t, beyond)
    }

    /// Returns the sections inside of the map, with their arc lengths.
    pub(crate) fn mapped(&self) -> impl Iterator<Item = (f64, &Section)> {
        let run_out = (RUN_OUT / STEP) as usize + 1;
        let sections = self.sections.iter().enumerate().skip(run_out);
        let count = self.sections.len().saturating_sub(2 * run_out);
        sections
            .take(count)
            .map(|(index, section)| (index as f64 * STEP, section))
    }

    /// Returns how far `s` is beyond the mapped part of the lane, m; 0 within it. There the road is
    /// invented: it goes straight on.
    #[must_use]
    pub fn beyond_map(&self, s: f64) -> f64 {
        let last = (self.sections.len() - 1) as f64 * STEP;
        (RUN_OUT - s).max(s - (last - RUN_OUT)).max(0.0)
    }

    /// Returns whether the lane exists at arc length `s`, and cars may drive on it there.
    #[must_use]
    pub fn is_for_cars(&self, s: f64) -> bool {
        let (a, b, t, _) = self.around(s);
        self.exists_at(s) && !nearer(a, b, t).is_refused
    }

    /// Returns whether the lane exists at arc length `s`.
    #[must_use]
    pub fn exists_at(&self, s: f64) -> bool {
        self.begin.is_none_or(|begin| s >= begin) && self.end.is_none_or(|end| s <= end)
    }

    /// Returns the foot of the perpendicular from `point`, by a descent that starts at `near`: on
    /// curved roads `near` should be within a few tens of metres of the foot.
    #[must_use]
    pub fn project_near(&self, point: Vec2, near: f64) -> Frenet {
        let sample = self.line.sample_near(point, self.line.sample_at(near));
        self.line.foot(point, sample).place
    }

    /// Returns the foot of the perpendicular from `point`, searched over the whole lane.
    #[must_use]
    pub fn project(&self, point: Vec2) -> Frenet {
        self.foot_of(point).place
    }

    fn foot_of(&self, point: Vec2) -> Foot {
        self.line.foot(point, self.line.sample(point))
    }

    /// Returns the point with these coordinates.
    #[must_use]
    pub fn point(&self, place: Frenet) -> Vec2 {
        self.line.at(place.s).beside(place.d)
    }
}

/// All lanes; at least one.
#[derive(Clone, Debug)]
pub struct Road {
    lanes: Vec<RoadLane>,
}

impl Road {
    /// Chains lanelets into lanes. References to missing lanelets are ignored: excerpts of maps
    /// have them at their edges.
    ///
    /// # Errors
    /// If the lanes together are longer than [`ROAD_MAX`]: their length so far, m.
    ///
    /// # Panics
    /// If `lanelets` is empty or a bound has fewer than two points; the parser refuses both.
    pub fn new(lanelets: &[Lanelet]) -> Result<Self, f64> {
        let pieces: Vec<Piece> = lanelets.iter().map(Piece::new).collect();
        let chains = chain::chains(lanelets, &pieces)?;
        let lines: Vec<CentreLine> = chains
            .iter()
            .map(|chain| chain::centre_line(&pieces, chain))
            .collect();
        let headings = chain::run_out_headings(&lines);
        let by_id = chain::lanes_by_id(lanelets, &chains);
        let refused = lanelets.iter().filter(|it| it.is_refused);
        let refused: HashSet<i64> = refused.map(|it| it.id).collect();
        let lane_of = |id: Option<i64>| {
            let id = id.filter(|id| !refused.contains(id))?;
            by_id.get(&id).map(|lane| LaneId(*lane))
        };
        let mut lanes: Vec<RoadLane> = chains
            .iter()
            .zip(&lines)
            .zip(&headings)
            .map(|((chain, line), heading)| lane(lanelets, chain, line, *heading, &lane_of))
            .collect();
        join_beyond_the_map(&mut lanes);
        let exits = domain::exits(&lanes);
        for (lane, exits) in lanes.iter_mut().zip(exits) {
            lane.exits = exits;
        }
        Ok(Self { lanes })
    }

    /// Returns all lanes, in the order of their ids.
    #[must_use]
    pub fn lanes(&self) -> &[RoadLane] {
        &self.lanes
    }

    /// Returns the lane with this id.
    ///
    /// # Panics
    /// If the id belongs to another road.
    #[must_use]
    pub fn lane(&self, id: LaneId) -> &RoadLane {
        &self.lanes[id.0]
    }

    /// Returns the lane whose centre line is nearest among those that exist there and run roughly
    /// along `yaw`; without such a lane, the nearest of all.
    #[must_use]
    pub fn locate(&self, point: Vec2, yaw: f64) -> (LaneId, Frenet) {
        self.nearest(point, yaw, RoadLane::exists_at)
    }

    /// Returns the lane of [`Road::locate`] among those for cars.
    #[must_use]
    pub fn locate_car(&self, point: Vec2, yaw: f64) -> (LaneId, Frenet) {
        self.nearest(point, yaw, RoadLane::is_for_cars)
    }

    /// Returns the nearest lane of which this part is `usable`; without one, the nearest of all.
    fn nearest(
        &self,
        point: Vec2,
        yaw: f64,
        usable: fn(&RoadLane, f64) -> bool,
    ) -> (LaneId, Frenet) {
        let mut best = (LaneId(0), Frenet::default());
        let mut best_cost = f64::INFINITY;
        for (index, lane) in self.lanes.iter().enumerate() {
            if lane.line.is_farther(point, best_cost) {
                continue;
            }
            let Foot { place, point: at } = lane.foot_of(point);
            let wrong_way = wrap_angle(at.heading - yaw).abs() > 1.0;
            let penalty = if wrong_way || !usable(lane, place.s) {
                1e6
            } else {
                0.0
            };
            let cost = (point - at.centre).norm() + penalty;
            if cost < best_cost - 1e-6 {
                (best, best_cost) = ((LaneId(index), place), cost);
            }
        }
        best
    }

    /// Returns whether the point is on a lane that runs against `yaw`.
    #[must_use]
    pub fn is_oncoming(&self, point: Vec2, yaw: f64) -> bool {
        self.lanes.iter().any(|lane| {
            if lane.line.is_farther(point, lane.width_max) {
                return false;
            }
            let Foot { place, point: at } = lane.foot_of(point);
            let width = lane.width_at(place.s);
            place.d.abs() < width / 2.0
                && (point - at.centre).norm() < width
                && lane.exists_at(place.s)
                && wrap_angle(at.heading - yaw).abs() > 2.0
                && !lane.at(place.s).is_crosswalk
        })
    }

    /// Returns the metres to the end of the operational design domain on this lane from arc length
    /// `s`, and its cause; `None` if there is no end.
    #[must_use]
    pub fn domain_end(&self, lane: LaneId, s: f64) -> Option<(f64, Exit)> {
        let exits = &self.lane(lane).exits;
        // An exit that was just passed is still under the vehicle.
        let next = exits.partition_point(|(at, _)| *at < s - EXIT_PASSED);
        let (at, exit) = exits.get(next)?;
        Some(((at - s).max(0.0), *exit))
    }

    /// Returns the metres from arc length `s` to where the lane or the domain on it ends; infinite
    /// if it continues.
    #[must_use]
    pub fn drivable(&self, lane: LaneId, s: f64) -> f64 {
        let end = self.distance_to_end(lane, s);
        self.domain_end(lane, s)
            .map_or(end, |(exit, _)| end.min(exit))
    }

    /// Returns the lane in which a drive starts: the result of [`Road::locate`], except that the
    /// lane along `yaw` is chosen where lanes overlap, as after a fork.
    #[must_use]
    pub fn locate_start(&self, point: Vec2, yaw: f64) -> (LaneId, Frenet) {
        let (nearest, place) = self.locate_car(point, yaw);
        let cost = |lane: &RoadLane, place: Frenet| {
            let turn = wrap_angle(lane.at(place.s).heading - yaw).abs();
            place.d.abs() + HEADING_WEIGHT * turn
        };
        let mut best = (nearest, place);
        let mut least = cost(self.lane(nearest), place) - 1e-6;
        for (index, lane) in self.lanes.iter().enumerate() {
            let place = lane.project(point);
            let section = lane.at(place.s);
            let is_on = (point - section.centre).norm() < section.width / 2.0;
            let cost = cost(lane, place);
            if is_on && lane.is_for_cars(place.s) && cost < least {
                (best, least) = ((LaneId(index), place), cost);
            }
        }
        best
    }

    /// Returns the metres to the lane's end from arc length `s`; infinite if it continues.
    #[must_use]
    pub fn distance_to_end(&self, lane: LaneId, s: f64) -> f64 {
        self.lane(lane)
            .end
            .map_or(f64::INFINITY, |end| (end - s).max(0.0))
    }
}

/// Returns the nearer of two samples at fraction `t` between them.
fn nearer<'a>(a: &'a Section, b: &'a Section, t: f64) -> &'a Section {
    if t < 0.5 { a } else { b }
}

/// Returns the width at fraction `t` between two samples, m.
fn width(a: &Section, b: &Section, t: f64) -> f64 {
    a.width + (b.width - a.width) * t
}

/// Returns the curvature at fraction `t` between two samples, 1/m; 0 `beyond` all samples.
fn curvature(a: &Section, b: &Section, t: f64, beyond: f64) -> f64 {
    if beyond == 0.0 {
        a.curvature + (b.curvature - a.curvature) * t
    } else {
        0.0
    }
}

/// Builds one lane with a run-out before and after it, the latter in the direction `run_out`.
fn lane(
    lanelets: &[Lanelet],
    chain: &Chain,
    raw: &CentreLine,
    run_out: f64,
    lane_of: &impl Fn(Option<i64>) -> Option<LaneId>,
) -> RoadLane {
    let mut points = Vec::with_capacity(raw.points.len() + 2);
    let first = raw.points[0];
    points.push(first - Vec2::from_angle(raw.first_heading()) * RUN_OUT);
    points.extend_from_slice(&raw.points);
    let heading = if chain.drops {
        raw.last_heading()
    } else {
        run_out
    };
    points.push(raw.points[raw.points.len() - 1] + Vec2::from_angle(heading) * RUN_OUT);
    let map = smooth::resampled(&points, STEP);
    let smooth = smooth::smoothed(&map, STEP);
    let centres = smooth::resampled(&smooth, STEP);
    // Both lines have the same ends, and nearly the same length.
    let hidden_bend = |index: usize| {
        let at = index * (map.len() - 1) / (centres.len() - 1);
        let is_hidden = (map[at] - smooth[at]).norm() > domain::MOVED_MAX;
        if is_hidden {
            smooth::bend(&map, at, STEP)
        } else {
            0.0
        }
    };

    let headings = smooth::headings(&centres);
    let mapped = raw.stations[raw.stations.len() - 1];
    let sections: Vec<Section> = (0..centres.len())
        .map(|index| {
            let before = headings[index.saturating_sub(1)];
            let after = headings[(index + 1).min(headings.len() - 1)];
            // Smoothing shortens curves a little; the mapped attributes need no more precision.
            let station = (index as f64 * STEP - RUN_OUT).clamp(0.0, mapped);
            let piece = raw.piece_at(station);
            let lanelet = &lanelets[piece];
            Section {
                centre: centres[index],
                heading: headings[index],
                curvature: wrap_angle(after - before) / (2.0 * STEP),
                width: raw.width_at(station),
                left: lane_of(lanelet.left_neighbour),
                right: lane_of(lanelet.right_neighbour),
                speed_limit: lanelet.speed_limit.unwrap_or(f64::INFINITY),
                is_refused: lanelet.is_refused,
                is_crosswalk: lanelet.is_crosswalk,
                lanelet: lanelet.id,
                hidden_bend: hidden_bend(index),
            }
        })
        .collect();
    let start = nearest_station(&centres, first);
    let end = nearest_station(&centres, raw.points[raw.points.len() - 1]);
    RoadLane {
        lanelets: chain
            .pieces
            .iter()
            .map(|piece| lanelets[*piece].id)
            .collect(),
        begin: chain.opens.then_some(start),
        end: chain.drops.then_some(end),
        width_max: sections.iter().map(|it| it.width).fold(0.0, f64::max),
        line: Line::new(&centres, &headings),
        sections,
        exits: Vec::new(),
    }
}

fn nearest_station(centres: &[Vec2], point: Vec2) -> f64 {
    let nearest = centres
        .iter()
        .enumerate()
        .min_by(|(_, a), (_, b)| (**a - point).norm().total_cmp(&(**b - point).norm()));
    nearest.map_or(0.0, |(index, _)| index as f64 * STEP)
}

/// Finds neighbours beyond the map by distance: files often have none at the map's edge.
fn join_beyond_the_map(lanes: &mut [RoadLane]) {
    let last: Vec<(Section, bool)> = lanes
        .iter()
        .map(|l| {
            let last = l.sections[l.sections.len() - 1];
            (last, l.end.is_none() && !last.is_refused)
        })
        .collect();
    for (index, lane) in lanes.iter_mut().enumerate() {
        let (own, goes_on) = last[index];
        if !goes_on {
            continue;
        }
        let beside = |side: f64| {
            last.iter().position(|(other, goes_on)| {
                let offset = Vec2::from_angle(own.heading).cross(other.centre - own.centre) * side;
                let pitch = (own.width + other.width) / 2.0;
                let along = Vec2::from_angle(own.heading).dot(other.centre - own.centre);
                *goes_on
                    && wrap_angle(other.heading - own.heading).abs() < 0.05
                    && (offset - pitch).abs() < 0.4 * pitch
                    && along.abs() < 60.0
            })
        };
        let (left, right) = (beside(1.0).map(LaneId), beside(-1.0).map(LaneId));
        let beyond = lane.sections.len() - (RUN_OUT / STEP) as usize;
        for section in &mut lane.sections[beyond..] {
            (section.left, section.right) = (left, right);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Scenario;

    #[test]
    fn frenet_coordinates_lead_there_and_back() {
        let scenario = Scenario::load("free-lane").unwrap();
        for lane in scenario.road().lanes() {
            for step in 0..400 {
                let place = Frenet {
                    s: f64::from(step) * 10.0 - 200.0,
                    d: f64::from(step % 11) - 5.0,
                };
                let point = lane.point(place);
                for found in [
                    lane.project(point),
                    lane.project_near(point, place.s + 30.0),
                ] {
                    assert!((found.s - place.s).abs() < 0.05, "{place:?} {found:?}");
                    assert!((found.d - place.d).abs() < 0.01, "{place:?} {found:?}");
                }
            }
        }
    }

    /// A lane ends if its neighbours continue; all other lanes have no end and stay side by side.
    #[test]
    fn a_lane_drop_ends_and_the_map_does_not() {
        let scenario = Scenario::load("lane-drop").unwrap();
        let road = scenario.road();
        let [drop, middle, left] = road.lanes() else {
            panic!("three lanes, one of them ends")
        };
        let end = drop.end.unwrap();
        assert!((end - RUN_OUT - 1_050.0).abs() < 3.0, "{end}");
        assert_eq!((middle.end, left.end), (None, None));
        assert_eq!(middle.at(end - 10.0).right, Some(LaneId(0)));
        assert_eq!(middle.at(end + 10.0).right, None);
        for s in [100.0, 1_000.0, 2_600.0, 4_000.0, 9_000.0] {
            let beside = left.project(middle.at(s).centre);
            assert!((beside.d + 3.5).abs() < 0.05, "{s} {beside:?}");
            assert_eq!(middle.at(s).left, Some(LaneId(2)));
            assert_eq!(left.at(s).right, Some(LaneId(1)));
        }
    }

    #[test]
    fn a_place_belongs_to_the_nearest_lane_that_exists_there() {
        let scenario = Scenario::load("lane-drop").unwrap();
        let road = scenario.road();
        let drop = road.lane(LaneId(0));
        let end = drop.end.unwrap();
        for (s, d, expected) in [
            (end - 20.0, 1.6, 0),
            (end - 20.0, 1.9, 1),
            (end + 20.0, 0.0, 1),
        ] {
            let point = drop.point(Frenet { s, d });
            let (lane, place) = road.locate(point, drop.at(s).heading);
            assert_eq!(lane, LaneId(expected), "{s} {d} {place:?}");
        }
    }

    fn lanelet(
        id: i64,
        points: [(f64, f64); 2],
        successors: &[i64],
        predecessors: &[i64],
    ) -> Lanelet {
        let bound = |side: f64| points.map(|(x, y)| Vec2::new(x, y + side)).to_vec();
        Lanelet {
            id,
            left: bound(1.75),
            right: bound(-1.75),
            predecessors: predecessors.to_vec(),
            successors: successors.to_vec(),
            left_neighbour: None,
            right_neighbour: None,
            speed_limit: None,
            is_refused: false,
            is_crosswalk: false,
        }
    }

    fn lanelets_of(road: &Road) -> Vec<Vec<i64>> {
        let lanes = road.lanes().iter();
        lanes.map(|lane| lane.lanelets.clone()).collect()
    }

    /// At a fork a lane continues straight; the branch begins there and is a separate lane.
    #[test]
    fn a_fork_makes_two_lanes() {
        let road = Road::new(&[
            lanelet(1, [(0.0, 0.0), (200.0, 0.0)], &[2, 3], &[]),
            lanelet(2, [(200.0, 0.0), (400.0, -60.0)], &[], &[1]),
            lanelet(3, [(200.0, 0.0), (400.0, 2.0)], &[], &[1]),
        ])
        .unwrap();
        assert_eq!(lanelets_of(&road), [vec![1, 3], vec![2]]);
        assert!(road.lane(LaneId(0)).begin.is_none() && road.lane(LaneId(1)).begin.is_some());
        assert!(road.lanes().iter().all(|lane| lane.end.is_none()));
        let (lane, _) = road.locate(Vec2::new(150.0, 0.0), 0.0);
        assert_eq!(lane, LaneId(0));
    }

    /// At a fork a lane does not continue into a branch that ends soon, even if it is the
    /// straighter one, unless both end or the branch is long.
    #[test]
    fn a_dead_end_is_not_chosen_at_a_fork() {
        let fork = |straight: f64, further: &[i64]| {
            lanelets_of(
                &Road::new(&[
                    lanelet(1, [(0.0, 0.0), (200.0, 0.0)], &[2, 3], &[]),
                    lanelet(2, [(200.0, 0.0), (200.0 + straight, 0.0)], &[], &[1]),
                    lanelet(3, [(200.0, 0.0), (230.0, 6.0)], further, &[1]),
                    lanelet(4, [(230.0, 6.0), (600.0, 80.0)], &[], &[3]),
                ])
                .unwrap(),
            )
        };
        assert_eq!(fork(30.0, &[4])[0], [1, 3, 4]);
        assert_eq!(fork(30.0, &[])[0], [1, 2]);
        assert_eq!(fork(300.0, &[4])[0], [1, 2]);
    }

    /// A lane that is not for cars is no neighbour and no place for the ego, and ends the domain of
    /// a lane that becomes one. Other road users are still on it.
    #[test]
    fn a_refused_lane_is_no_lane_for_the_ego() {
        let mut own = lanelet(1, [(0.0, 0.0), (200.0, 0.0)], &[2], &[]);
        let mut next = lanelet(2, [(200.0, 0.0), (400.0, 0.0)], &[], &[1]);
        let mut beside = lanelet(3, [(0.0, 3.5), (400.0, 3.5)], &[], &[]);
        own.left_neighbour = Some(3);
        let on_it = Vec2::new(100.0, 3.4);
        for refused in [false, true] {
            (next.is_refused, beside.is_refused) = (refused, refused);
            let road = Road::new(&[own.clone(), next.clone(), beside.clone()]).unwrap();
            let (lane, place) = road.locate_car(Vec2::new(100.0, 0.1), 0.0);
            assert_eq!(lane, LaneId(0));
            let left = road.lane(lane).at(place.s).left;
            assert_eq!(left, (!refused).then_some(LaneId(1)));
            assert_eq!(road.domain_end(lane, place.s).is_some(), refused);
            assert_eq!(road.locate(on_it, 0.0).0, LaneId(1));
            assert_eq!(road.locate_car(on_it, 0.0).0, LaneId(usize::from(!refused)));
        }
    }

    /// Where two lanes overlap, the drive starts in the one along the vehicle's heading, even if
    /// the other one's centre is a little nearer.
    #[test]
    fn heading_decides_the_lane_at_the_start() {
        let road = Road::new(&[
            lanelet(1, [(0.0, 0.0), (200.0, 0.0)], &[2, 3], &[]),
            lanelet(2, [(200.0, 0.0), (500.0, 100.0)], &[], &[1]),
            lanelet(3, [(200.0, 0.0), (500.0, 0.0)], &[], &[1]),
        ])
        .unwrap();
        assert_eq!(lanelets_of(&road), [vec![1, 3], vec![2]]);
        let branch = road.lane(LaneId(1));
        let s = branch.begin.unwrap() + 6.0;
        let point = branch.point(Frenet { s, d: -1.2 });
        let heading = branch.at(s).heading;
        assert_eq!(road.locate(point, heading).0, LaneId(0), "it is nearer");
        assert_eq!(road.locate_start(point, heading).0, LaneId(1));
        assert_eq!(road.locate_start(point, 0.0).0, LaneId(0));
    }
}
