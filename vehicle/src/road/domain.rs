//! The operational design domain: the roads for which the driving functions are made.
//! `docs/domain.md` defines it in full.
//!
//! It is checked twice. Before the start, [`crate::Scenario::outside_domain`] says why a scenario
//! cannot start. While driving, the camera reports where the domain ends on a lane like the end of
//! that lane, so that the functions change lanes or stop before it.

use std::collections::HashMap;
use std::f64::consts::PI;
use std::fmt;

use super::{LaneId, Road, RoadLane, Section};
use crate::geometry::wrap_angle;

/// Width of a lane, m.
const WIDTH: std::ops::RangeInclusive<f64> = 2.3..=7.0;
/// Smallest radius of a bend, m.
const RADIUS_MIN: f64 = 20.0;
/// Where the smooth line, which the vehicle follows, is farther than this from the map's, m, the
/// bend of the map counts: the vehicle would leave the lane there.
pub(super) const MOVED_MAX: f64 = 1.5;
/// Where the ego starts: the largest angle to its lane, rad, and the highest speed, m/s.
const START_ANGLE: f64 = 0.7;
const START_SPEED_MAX: f64 = 60.0;
/// From the start, the ego must be able to stop before the end of the domain with this
/// deceleration, m/s², after this reaction time, s, and with this distance left, m.
const STOP_BRAKING: f64 = 3.0;
const STOP_DELAY_S: f64 = 0.7;
const STOP_MARGIN: f64 = 8.0;
/// Lateral acceleration in a bend that the ego must be able to slow down for, m/s²: twice what the
/// functions drive with.
const BEND_ACCELERATION: f64 = 4.4;
/// Lanes cross if their centre lines are nearer than this, m, at an angle in this range, rad.
const CROSSING_NEAR: f64 = 2.0;
const CROSSING_ANGLE: std::ops::Range<f64> = 0.35..PI - 0.35;
/// Opposite lanes that are nearer than this are one lane for both directions, m.
const SHARED_NEAR: f64 = 1.0;

/// The causes that end the domain on a lane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Exit {
    /// Another lane crosses this one, or turns off as at a junction.
    Crossing {
        /// Id of that lane's lanelet in the file.
        lanelet: i64,
        /// The angle between both lanes, rad.
        angle: f64,
    },
    /// The lane is used in both directions.
    Shared,
    /// The lane has this width, outside the limits, m.
    Width(f64),
    /// The bend has this radius, below the limit, m.
    Radius(f64),
    /// Cars must not drive on it: a sidewalk, or a lane for bicycles or buses.
    Refused,
}

impl fmt::Display for Exit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Crossing { lanelet, angle } => {
                let angle = angle.to_degrees();
                write!(
                    f,
                    "a junction (lanelet {lanelet} at {angle:.0}° to the lane)"
                )
            }
            Self::Shared => f.write_str("a lane for both directions"),
            Self::Width(width) => write!(f, "a lane {width:.1} m wide"),
            Self::Radius(radius) => write!(f, "a bend of {radius:.0} m radius"),
            Self::Refused => f.write_str("a lane that is not for cars"),
        }
    }
}

/// Returns the ends of the domain on each lane, by arc length.
pub(crate) fn exits(lanes: &[RoadLane]) -> Vec<Vec<(f64, Exit)>> {
    // Group sections by squares of the plane, so that only near ones are compared.
    let square = |x: f64| (x / CROSSING_NEAR).floor() as i64;
    let mut squares: HashMap<(i64, i64), Vec<(usize, f64)>> = HashMap::new();
    for (index, lane) in lanes.iter().enumerate() {
        // Who drives across a zebra stays in its lane.
        for (s, section) in lane.mapped().filter(|(_, it)| !it.is_crosswalk) {
            let key = (square(section.centre.x), square(section.centre.y));
            squares.entry(key).or_default().push((index, s));
        }
    }
    let crossed = |own: usize, s: f64| {
        let section = lanes[own].at(s);
        let (x, y) = (square(section.centre.x), square(section.centre.y));
        let around = (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| (x + dx, y + dy)));
        let near = around.filter_map(|key| squares.get(&key)).flatten();
        // No real road has more lanes at one place, so the first ones are enough.
        near.take(256)
            .filter(|(lane, _)| *lane != own)
            .find_map(|(lane, other)| {
                let other = lanes[*lane].at(*other);
                let apart = (other.centre - section.centre).norm();
                let angle = wrap_angle(other.heading - section.heading).abs();
                if apart < CROSSING_NEAR && CROSSING_ANGLE.contains(&angle) {
                    return Some(Exit::Crossing {
                        lanelet: other.lanelet,
                        angle,
                    });
                }
                (apart < SHARED_NEAR && angle >= CROSSING_ANGLE.end).then_some(Exit::Shared)
            })
    };
    let exit = |index: usize, s: f64, section: &Section| {
        let bend = section.curvature.abs().max(section.hidden_bend);
        if section.is_refused {
            return Some(Exit::Refused);
        }
        if !WIDTH.contains(&section.width) {
            return Some(Exit::Width(section.width));
        }
        if bend > 1.0 / RADIUS_MIN {
            return Some(Exit::Radius(1.0 / bend));
        }
        crossed(index, s)
    };
    lanes
        .iter()
        .enumerate()
        .map(|(index, lane)| {
            let mapped = lane.mapped();
            mapped
                .filter_map(|(s, section)| exit(index, s, section).map(|exit| (s, exit)))
                .collect()
        })
        .collect()
}

/// Returns why a drive that starts at this place is outside of the domain; `None` if it is inside.
pub(crate) fn refusal(
    road: &Road,
    lane: LaneId,
    s: f64,
    d: f64,
    yaw: f64,
    speed: f64,
) -> Option<String> {
    let section = road.lane(lane).at(s);
    let angle = wrap_angle(yaw - section.heading).abs();
    if angle > START_ANGLE {
        return Some(format!(
            "the vehicle starts at {:.0}° to its lane",
            angle.to_degrees()
        ));
    }
    if d.abs() > section.width / 2.0 || !road.lane(lane).exists_at(s) {
        return Some("the vehicle starts beside the road".to_owned());
    }
    if speed > START_SPEED_MAX {
        return Some(format!("the vehicle starts with {speed:.0} m/s"));
    }
    if let Some(reason) = too_fast(road.lane(lane), s, speed) {
        return Some(reason);
    }
    let (distance, exit) = road.domain_end(lane, s)?;
    let stop = speed * speed / (2.0 * STOP_BRAKING) + STOP_DELAY_S * speed + STOP_MARGIN;
    (distance < stop).then(|| format!("{exit} {distance:.0} m ahead of the start"))
}

/// Returns why the ego cannot slow down for a bend ahead of this start; `None` if it can.
fn too_fast(lane: &RoadLane, s: f64, speed: f64) -> Option<String> {
    let ahead = lane.mapped().filter(|(at, _)| *at > s);
    ahead
        .map(|(at, section)| (at - s, section.curvature.abs().max(1e-6)))
        .find_map(|(ahead, bend)| {
            let room = (ahead - STOP_DELAY_S * speed).max(0.0);
            let most = (BEND_ACCELERATION / bend + 2.0 * STOP_BRAKING * room).sqrt();
            (speed > most && bend < 1.0 / RADIUS_MIN).then(|| {
                let radius = 1.0 / bend;
                format!("with {speed:.0} m/s, a bend of {radius:.0} m radius {ahead:.0} m ahead")
            })
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::commonroad::Lanelet;
    use crate::geometry::Vec2;
    use crate::road::Frenet;

    /// Creates a lane of this width along these points.
    fn lanelet(id: i64, points: &[Vec2], width: f64) -> Lanelet {
        let aside = |from: Vec2, to: Vec2| {
            let along = to - from;
            along.left() * (width / 2.0 / along.norm())
        };
        let bound = |side: f64| -> Vec<Vec2> {
            let last = points.len() - 1;
            let at = |index: usize| {
                let from = index.min(last - 1);
                points[index] + aside(points[from], points[from + 1]) * side
            };
            (0..=last).map(at).collect()
        };
        Lanelet {
            id,
            left: bound(1.0),
            right: bound(-1.0),
            predecessors: vec![],
            successors: vec![],
            left_neighbour: None,
            right_neighbour: None,
            speed_limit: None,
            is_refused: false,
            is_crosswalk: false,
        }
    }

    fn line(from: (f64, f64), to: (f64, f64)) -> [Vec2; 2] {
        [Vec2::new(from.0, from.1), Vec2::new(to.0, to.1)]
    }

    /// Returns the end of the domain on the first lane, from 10 m after its start.
    fn end(lanelets: &[Lanelet]) -> Option<(f64, Exit)> {
        let road = Road::new(lanelets).unwrap();
        let start = road.lane(LaneId(0)).project(Vec2::new(10.0, 0.0)).s;
        road.domain_end(LaneId(0), start)
    }

    #[test]
    fn each_limit_of_the_domain_ends_it() {
        let straight = || lanelet(1, &line((0.0, 0.0), (300.0, 0.0)), 3.5);
        assert_eq!(end(&[straight()]), None);
        let beside = lanelet(2, &line((0.0, 3.5), (300.0, 3.5)), 3.5);
        let merging = lanelet(3, &line((0.0, -30.0), (300.0, 2.0)), 3.5);
        assert_eq!(
            end(&[straight(), beside, merging]),
            None,
            "lanes side by side, a merge"
        );
        let across = lanelet(2, &line((150.0, -50.0), (150.0, 50.0)), 3.5);
        let (distance, exit) = end(&[straight(), across]).unwrap();
        assert!((distance - 140.0).abs() < 4.0, "{distance} {exit}");
        assert_eq!(
            exit.to_string(),
            "a junction (lanelet 2 at 90° to the lane)"
        );
        let against = lanelet(2, &line((200.0, 0.3), (100.0, 0.3)), 3.5);
        let (distance, exit) = end(&[straight(), against]).unwrap();
        assert!(
            (distance - 90.0).abs() < 8.0 && exit == Exit::Shared,
            "{distance} {exit}"
        );
        let narrow = lanelet(1, &line((0.0, 0.0), (300.0, 0.0)), 2.0);
        assert!(matches!(end(&[narrow]), Some((_, Exit::Width(_)))));
        let circle = |radius: f64| -> Vec<Vec2> {
            let bend = (0..40).map(|i| Vec2::from_angle(f64::from(i) * 0.08 - 1.57) * radius);
            let start = (0..20).map(|i| Vec2::new(f64::from(i) * 5.0, 0.0));
            let bend = bend.map(|p| p + Vec2::new(100.0, radius));
            start.chain(bend).collect()
        };
        assert_eq!(end(&[lanelet(1, &circle(60.0), 3.5)]), None);
        let (distance, exit) = end(&[lanelet(1, &circle(15.0), 3.5)]).unwrap();
        assert!(
            matches!(exit, Exit::Radius(_)) && distance > 60.0,
            "{distance} {exit}"
        );
        // A turn at a junction: smoothing makes a wide bend of it, beside the lane.
        let turn = |radius: f64| -> Vec<Vec2> {
            let arc = (0..=10).map(|i| Vec2::from_angle(f64::from(i) * 0.12 - 1.57) * radius);
            let start = (0..20).map(|i| Vec2::new(f64::from(i) * 5.0, 0.0));
            let arc = arc.map(|p| p + Vec2::new(100.0, radius));
            let points: Vec<Vec2> = start.chain(arc).collect();
            let last = points[points.len() - 1];
            let on = (1..20).map(|i| last + Vec2::from_angle(1.2) * (f64::from(i) * 5.0));
            points.iter().copied().chain(on).collect()
        };
        let (distance, exit) = end(&[lanelet(1, &turn(8.0), 3.5)]).unwrap();
        assert!(
            matches!(exit, Exit::Radius(_)) && (60.0..100.0).contains(&distance),
            "{distance} {exit}"
        );
        assert_eq!(end(&[lanelet(1, &turn(30.0), 3.5)]), None);
    }

    /// A zebra is not a junction: the lane continues across it. No vehicle drives along a zebra. A
    /// lane that crosses at the same place is a junction.
    #[test]
    fn a_zebra_ends_no_lane() {
        let straight = lanelet(1, &line((0.0, 0.0), (300.0, 0.0)), 3.5);
        let across = |id, x: f64| lanelet(id, &line((x, 20.0), (x - 15.0, -20.0)), 3.0);
        let zebra = Lanelet {
            is_refused: true,
            is_crosswalk: true,
            ..across(2, 150.0)
        };
        let on_both = [straight.clone(), zebra.clone()];
        assert_eq!(end(&on_both), None);
        let road = Road::new(&on_both).unwrap();
        let middle = Vec2::new(142.5, 0.0);
        let along = road
            .lane(LaneId(1))
            .at(road.lane(LaneId(1)).project(middle).s)
            .heading;
        assert_eq!(road.locate_car(middle, along).0, LaneId(0));
        assert!(!road.is_oncoming(middle, along + std::f64::consts::PI));
        let sidewalk = Lanelet {
            is_refused: true,
            ..across(3, 150.0)
        };
        assert!(matches!(
            end(&[straight.clone(), sidewalk]),
            Some((_, Exit::Crossing { lanelet: 3, .. }))
        ));
        assert!(matches!(
            end(&[straight, zebra, across(4, 150.0)]),
            Some((_, Exit::Crossing { lanelet: 4, .. }))
        ));
    }

    #[test]
    fn a_start_outside_is_refused_by_name() {
        let across = lanelet(2, &line((150.0, -50.0), (150.0, 50.0)), 3.5);
        let road = Road::new(&[lanelet(1, &line((0.0, 0.0), (300.0, 0.0)), 3.5), across]).unwrap();
        let lane = road.lane(LaneId(0));
        let at = |x: f64, y: f64| lane.project(Vec2::new(x, y));
        let why = |Frenet { s, d }, yaw, speed| {
            refusal(&road, LaneId(0), s, d, yaw, speed).unwrap_or_default()
        };
        assert_eq!(why(at(10.0, 0.0), 0.0, 20.0), "");
        assert!(why(at(10.0, 0.0), 0.9, 20.0).contains("52° to its lane"));
        assert!(why(at(10.0, 2.0), 0.0, 20.0).contains("beside the road"));
        assert!(why(at(10.0, 0.0), 0.0, 70.0).contains("with 70 m/s"));
        assert!(why(at(100.0, 0.0), 0.0, 20.0).contains("a junction"));
    }
}
