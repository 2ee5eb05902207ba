//! The camera's lanes: a cubic polynomial through the ego lane's centre line, neighbours, ends.
//!
//! The cubic is valid only as far as it follows the lane: [`RANGES`] are tried from the longest. An
//! end of a lane, or of the operational design domain on it, is read from the map.

use tandem_bus::CameraLanes;

use super::{EgoTruth, Noise};
use crate::geometry::Vec2;
use crate::road::{LaneId, Road, RoadLane};

/// Longest reach of the polynomial, m: over a longer distance, a cubic deviates from curves of
/// motorway junctions by decimetres.
const VIEW_RANGE: f64 = 80.0;
/// Ranges that are tried, m.
const RANGES: [f64; 10] = [
    VIEW_RANGE, 64.0, 50.0, 40.0, 32.0, 25.0, 20.0, 16.0, 12.0, 8.0,
];
/// The cubic follows the lane if its distance to the lane never exceeds this, m.
const RESIDUAL: f64 = 0.15;
/// Distance from which an end of a lane is seen, m: signs and markings announce it.
const END_IN_SIGHT: f64 = 300.0;
/// From a longer range than the first, m, the cubic has the lane's curvature at the vehicle, with
/// an error below the second, 1/m: a bend that begins far ahead does not bend the line here.
const RANGE_OF_BENDS: f64 = 20.0;
const RESIDUAL_BEND: f64 = 8e-4;
/// That is so where the lane bends more than this within the view, 1/m.
const BENDS: f64 = 0.003;
/// A bend has a sign with the speed of this lateral acceleration, m/s², to which a vehicle slows
/// down with this braking, m/s², until this distance before it, m, or this time before it, s. A
/// driver who follows a speed that falls is late by that time.
const BEND_ACCELERATION: f64 = 2.2;
const BEND_BRAKING: f64 = 1.3;
const BEND_MARGIN: f64 = 15.0;
const BEND_AHEAD_S: f64 = 2.7;
/// Distance between two places at which bends are looked for, m.
const BEND_STEP: f64 = 5.0;
/// No bend has a sign with a higher speed than this, m/s: that of the domain.
const SPEED_WITHOUT_SIGN: f64 = 60.0;
/// Largest third coefficient that the frame can carry, 1/m².
const C3_MAX: f64 = 3.2e-4;
/// How many points are fitted.
const POINTS: usize = 20;
/// Standard deviations of the coefficients' errors: each causes 8 cm at 60 m, and 8 cm at the same
/// fraction of a shorter range.
const NOISE: [f64; 4] = [0.02, 0.001_2, 2e-5, 3e-7];
/// Standard deviations of width (m) and of the distance to an end (fraction of the distance).
const WIDTH_NOISE: f64 = 0.05;
const END_NOISE: f64 = 0.01;
/// If the ego is farther than this from its lane's centre, m, it is off the road, and the camera
/// sees no ego lane.
const OFF_ROAD: f64 = 4.0;

pub(super) struct LaneCamera {
    noise: Noise,
}

impl LaneCamera {
    pub(super) fn new(seed: u64) -> Self {
        Self {
            noise: Noise::new(seed, 16),
        }
    }

    pub(super) fn measure(&mut self, ego: &EgoTruth, road: &Road) -> CameraLanes {
        let lane = road.lane(ego.lane);
        let here = lane.at(ego.place.s);
        let wrong_way = crate::geometry::wrap_angle(here.heading - ego.pose.yaw).abs() > 0.8;
        if ego.place.d.abs() > OFF_ROAD || wrong_way {
            return CameraLanes::default();
        }
        let (fitted, range) = farthest_fit(ego, road);
        let mut c = [0.0; 4];
        for (index, c) in c.iter_mut().enumerate() {
            let deviation = NOISE[index] * (VIEW_RANGE / range).powi(index as i32);
            *c = (fitted[index] + self.noise.normal(deviation)) as f32;
        }
        let (left, right) = (here.left, here.right);
        let lane_end = road.distance_to_end(ego.lane, ego.place.s);
        let domain_end = road.domain_end(ego.lane, ego.place.s);
        let domain_end = domain_end.map_or(f64::INFINITY, |(distance, _)| distance);
        CameraLanes {
            valid: true,
            left_exists: left.is_some(),
            right_exists: right.is_some(),
            c0: c[0],
            c1: c[1],
            c2: c[2],
            c3: c[3],
            view_range: range as u8,
            width: self.width(here.width),
            left_width: self.neighbour_width(road, ego, left),
            right_width: self.neighbour_width(road, ego, right),
            own_end: self.end(lane_end.min(domain_end)),
            ends_domain: domain_end < lane_end && domain_end <= END_IN_SIGHT,
            left_end: self.neighbour_end(road, ego, left),
            right_end: self.neighbour_end(road, ego, right),
            speed_limit: signed_speed(lane, ego, here.speed_limit),
            ..CameraLanes::default()
        }
    }

    fn width(&mut self, width: f64) -> f32 {
        (width + self.noise.normal(WIDTH_NOISE)).max(0.0) as f32
    }

    fn neighbour_width(&mut self, road: &Road, ego: &EgoTruth, lane: Option<LaneId>) -> f32 {
        lane.map_or(0.0, |lane| {
            let lane = road.lane(lane);
            self.width(lane.at(lane.project(ego.pose.position).s).width)
        })
    }

    fn end(&mut self, distance: f64) -> f32 {
        if distance > END_IN_SIGHT {
            return CameraLanes::NO_END;
        }
        (distance * (1.0 + self.noise.normal(END_NOISE))).max(0.0) as f32
    }

    fn neighbour_end(&mut self, road: &Road, ego: &EgoTruth, lane: Option<LaneId>) -> f32 {
        lane.map_or(CameraLanes::NO_END, |lane| {
            let s = road.lane(lane).project(ego.pose.position).s;
            self.end(road.drivable(lane, s))
        })
    }
}

/// Returns the speed that signs allow here, m/s: the limit, and before a bend the speed from which
/// [`BEND_BRAKING`] leads to the bend's own. The map has both, as it has the ends of lanes.
fn signed_speed(lane: &RoadLane, ego: &EgoTruth, limit: f64) -> f32 {
    let margin = BEND_MARGIN.max(BEND_AHEAD_S * ego.speed);
    let steps = (0..=(END_IN_SIGHT / BEND_STEP) as usize).map(|step| step as f64 * BEND_STEP);
    let bend = steps.map(|ahead| {
        let bend = lane.curvature_at(ego.place.s + ahead).abs().max(1e-6);
        let room = (ahead - margin).max(0.0);
        (BEND_ACCELERATION / bend + 2.0 * BEND_BRAKING * room).sqrt()
    });
    let bend = bend.fold(f64::INFINITY, f64::min);
    let speed = if bend < SPEED_WITHOUT_SIGN {
        bend.min(limit)
    } else {
        limit
    };
    if speed.is_finite() {
        speed as f32
    } else {
        CameraLanes::NO_SPEED_LIMIT
    }
}

/// Returns the cubic over the longest range in which it follows the lane, and that range, m.
fn farthest_fit(ego: &EgoTruth, road: &Road) -> ([f64; 4], f64) {
    let last = RANGES[RANGES.len() - 1];
    let lane = road.lane(ego.lane);
    let bend = lane.curvature_at(ego.place.s);
    let steps = (0..=(VIEW_RANGE / BEND_STEP) as usize).map(|step| step as f64 * BEND_STEP);
    let bends = steps.map(|ahead| lane.curvature_at(ego.place.s + ahead).abs());
    let is_straight = bends.fold(0.0, f64::max) < BENDS;
    let follows = |range: f64| {
        let (c, residual) = fit(ego, road, range);
        let is_near = (2.0 * c[2] - bend).abs() < RESIDUAL_BEND;
        let is_near = is_near || is_straight || range <= RANGE_OF_BENDS;
        (residual < RESIDUAL && is_near || range <= last).then_some((c, range))
    };
    RANGES.into_iter().find_map(follows).unwrap_or_default()
}

/// Returns the least squares fit of y(x) to the centre line over `range` metres of it in the
/// vehicle frame, and the largest distance between the two, m.
fn fit(ego: &EgoTruth, road: &Road, range: f64) -> ([f64; 4], f64) {
    let lane = road.lane(ego.lane);
    let step = range / POINTS as f64;
    let frame = ego.pose.frame();
    // Normal equations in x / range, which keeps them well conditioned.
    let mut matrix = [[0.0; 5]; 4];
    let mut points = [Vec2::default(); POINTS + 1];
    for (sample, kept) in points.iter_mut().enumerate() {
        let section = lane.at(ego.place.s + sample as f64 * step);
        let point = frame.to_local(section.centre);
        *kept = point;
        let x = point.x / range;
        // Near points matter more to the control, and a camera sees them better.
        let weight = 1.0 / (1.0 + 2.0 * x.max(0.0));
        let powers = [1.0, x, x * x, x * x * x];
        for (row, left) in matrix.iter_mut().zip(powers) {
            for (cell, right) in row.iter_mut().zip(powers) {
                *cell += weight * left * right;
            }
            row[4] += weight * left * point.y;
        }
    }
    let mut scaled = solve(matrix);
    let most = C3_MAX * range.powi(3);
    if scaled[3].abs() > most {
        // The best line that the frame can carry.
        matrix[3] = [0.0, 0.0, 0.0, 1.0, scaled[3].clamp(-most, most)];
        scaled = solve(matrix);
    }
    let residual = |point: &Vec2| {
        let x = point.x / range;
        let y = scaled[0] + x * (scaled[1] + x * (scaled[2] + x * scaled[3]));
        (y - point.y).abs()
    };
    let largest = points.iter().map(residual).fold(0.0, f64::max);
    let c = [0, 1, 2, 3].map(|power| scaled[power] / range.powi(power as i32));
    (c, largest)
}

/// Solves four linear equations, the right-hand side in the last column, by elimination with
/// pivots.
fn solve(mut matrix: [[f64; 5]; 4]) -> [f64; 4] {
    for column in 0..4 {
        let largest = |row: &usize| matrix[*row][column].abs();
        let pivot = (column..4)
            .max_by(|a, b| largest(a).total_cmp(&largest(b)))
            .unwrap_or(column);
        matrix.swap(column, pivot);
        let head = matrix[column];
        for row in matrix.iter_mut().skip(column + 1) {
            let factor = row[column] / head[column];
            for (cell, above) in row.iter_mut().zip(head) {
                *cell -= factor * above;
            }
        }
    }
    let mut solution = [0.0; 4];
    for row in (0..4).rev() {
        let known: f64 = (row + 1..4)
            .map(|column| matrix[row][column] * solution[column])
            .sum();
        solution[row] = (matrix[row][4] - known) / matrix[row][row];
    }
    solution
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Scenario;
    use crate::geometry::Pose;
    use crate::road::Frenet;

    /// Before a bend, a fast vehicle reads a lower speed than a slow one at the same place.
    #[test]
    fn the_speed_before_a_bend_is_signed_early() {
        let mut compared = 0;
        for name in Scenario::names() {
            let scenario = Scenario::load(name).unwrap();
            let lane = scenario.road().lane(LaneId(0));
            let signed = |s: f64, speed: f64| {
                let place = Frenet { s, d: 0.0 };
                let ego = EgoTruth {
                    place,
                    speed,
                    ..EgoTruth::default()
                };
                signed_speed(lane, &ego, f64::INFINITY)
            };
            for s in (0..2_500).step_by(5).map(f64::from) {
                let (fast, slow) = (signed(s, 30.0), signed(s, 0.0));
                assert!(fast <= slow, "{name} {s}: {fast} {slow}");
                compared += usize::from(fast < slow);
            }
        }
        assert!(compared > 10, "{compared}");
    }

    /// The cubic stays within 10 cm of the centre line on all embedded roads.
    #[test]
    fn the_polynomial_follows_the_road() {
        for name in Scenario::names() {
            let scenario = Scenario::load(name).unwrap();
            let road = scenario.road();
            for index in 0..road.lanes().len() {
                let lane = road.lane(LaneId(index));
                for station in (0..2_800).step_by(20).map(f64::from) {
                    let place = Frenet { s: station, d: 0.4 };
                    let section = lane.at(station);
                    let yaw = section.heading + 0.02;
                    let pose = Pose {
                        position: lane.point(place),
                        yaw,
                    };
                    let ego = EgoTruth {
                        pose,
                        lane: LaneId(index),
                        place,
                        ..EgoTruth::default()
                    };
                    let (c, range) = farthest_fit(&ego, road);
                    assert_eq!(range, VIEW_RANGE);
                    for ahead in [0.0, 20.0, 40.0, 60.0, 78.0] {
                        let point = pose.to_local(lane.at(station + ahead).centre);
                        let x = point.x;
                        let y = c[0] + c[1] * x + c[2] * x * x + c[3] * x * x * x;
                        assert!(
                            (y - point.y).abs() < 0.1,
                            "{name} {station} {ahead}: {y} {point:?}"
                        );
                    }
                }
            }
        }
    }
}
