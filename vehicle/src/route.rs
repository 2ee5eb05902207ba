//! The route to the goal of a scenario, as a navigation system gives it to a driver: a lane, and a
//! speed that reaches the goal in time.

use std::sync::Arc;

use tandem_bus::RouteCode;

use crate::commonroad::Goal;
use crate::geometry::Vec2;
use crate::road::{Frenet, LaneId, Road};

/// A goal is in a lane if its distance to the lane's centre is at most this fraction of the width.
const IN_LANE: f64 = 0.55;
/// Number of lanes searched on each side, and how far ahead, m: new lanes begin on the way.
const LANES_ASIDE: usize = 6;
const AHEAD: [f64; 4] = [0.0, 50.0, 100.0, 150.0];
/// The speed for the goal is at most the driver's speed times this factor.
const HURRY: f64 = 1.3;
/// The ego should reach a spot when this fraction of the goal's time has passed.
const EARLY: f64 = 0.2;
/// If the ego may stand at a spot, it drives there at once and waits. Time constant of this
/// approach, s.
const STOPS_S: f64 = 2.0;
/// The speed is no longer corrected when less than this time is left, s.
const NEAR_S: f64 = 0.5;
/// Margin to the limits of the goal's range of speeds, m/s.
const SPEED_MARGIN: f64 = 0.7;
/// Time before the goal at which the ego enters the goal's range of speeds from below, and from
/// above, s: slowing down takes less time.
const SPEED_BEFORE_S: (f64, f64) = (4.0, 1.5);
/// A goal that is farther than this behind the ego counts as passed, m.
const PASSED: f64 = 2.0;

/// The driver's request on the way to the goal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Advice {
    pub(crate) route: RouteCode,
    /// m/s
    pub(crate) set_speed: f64,
    /// Whether the shorter distance to the vehicle ahead is chosen, to reach the goal in time.
    pub(crate) near_gap: bool,
    /// The requested place in the lane, m from its centre, left positive.
    pub(crate) lane_offset: f64,
}

/// The place of the ego.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Here {
    pub(crate) time_s: f64,
    pub(crate) lane: LaneId,
    pub(crate) place: Frenet,
    pub(crate) position: Vec2,
}

/// The first goal that names a place, until it is reached or its time is over.
#[derive(Clone, Debug)]
pub(crate) struct Navigation {
    goals: Arc<[Goal]>,
    set_speed: f64,
}

impl Navigation {
    /// `set_speed`: the speed that the driver requests without a goal, m/s.
    pub(crate) fn new(goals: Arc<[Goal]>, set_speed: f64) -> Self {
        Self { goals, set_speed }
    }

    /// Returns the driver's request here. `reached`: a goal has been reached.
    pub(crate) fn advice(&self, road: &Road, here: &Here, reached: bool) -> Advice {
        let free = Advice {
            route: RouteCode::Free,
            set_speed: self.set_speed,
            near_gap: false,
            lane_offset: 0.0,
        };
        let open = |goal: &&Goal| goal.deadline().is_none_or(|end| here.time_s <= end);
        let goal = self.goals.iter().find(|goal| !goal.places.is_empty());
        let Some(goal) = goal.filter(open).filter(|_| !reached) else {
            return free;
        };
        let beside = AHEAD
            .into_iter()
            .flat_map(|ahead| lanes_beside(road, here, ahead));
        let found = { beside }.find_map(|(route, lane, own_s)| {
            let places = goal.places.iter().filter_map(|place| {
                let at = road.lane(lane).project(*place);
                let section = road.lane(lane).at(at.s);
                let is_in = (*place - section.centre).norm() < IN_LANE * section.width;
                is_in.then_some((at.s - own_s, at.d))
            });
            let none = (f64::INFINITY, f64::NEG_INFINITY, 0.0);
            let (from, to, offset) =
                places.fold(none, |(from, to, _), (s, d)| (from.min(s), to.max(s), d));
            (to > -PASSED).then_some((route, from, to, offset))
        });
        found.map_or(free, |(route, from, to, offset)| Advice {
            route,
            set_speed: self.speed(goal, here.time_s, from, to, route == RouteCode::Keep),
            near_gap: goal.time.is_some(),
            lane_offset: if route == RouteCode::Keep {
                offset
            } else {
                0.0
            },
        })
    }

    /// Returns the speed that brings the ego to a place `from` to `to` metres ahead within the
    /// goal's time. `in_lane`: the goal is ahead in the ego's lane.
    fn speed(&self, goal: &Goal, time_s: f64, from: f64, to: f64, in_lane: bool) -> f64 {
        let (opens, ends) = goal.time.unwrap_or((0.0, f64::INFINITY));
        let (opens, ends) = ((opens - time_s).max(0.0), (ends - time_s).max(NEAR_S));
        // The ego must arrive before the goal's time ends, and pass the goal after it begins.
        let slowest = from.max(0.0) / ends;
        let fastest = to.max(0.0) / opens.max(1e-3);
        let wanted = if to - from < 5.0 && ends.is_finite() && opens > 0.0 {
            // For a spot, arrive early in its time, because traffic may delay the ego. For a goal
            // in another lane, arrive when the time begins.
            let aim = if goal.speed.is_some_and(|(low, _)| low <= 0.0) {
                STOPS_S
            } else if in_lane {
                opens + EARLY * (ends - opens)
            } else {
                opens
            };
            to.max(0.0) / aim.max(NEAR_S)
        } else {
            self.set_speed.clamp(slowest, fastest.max(slowest))
        };
        let wanted = match goal.speed {
            Some((low, high)) => {
                let margin = SPEED_MARGIN.min((high - low) / 2.0);
                let from = |time: f64, limit: f64, free: f64| {
                    if opens < time { limit } else { free }
                };
                let low = from(SPEED_BEFORE_S.0, low + margin, 0.0);
                let high = from(SPEED_BEFORE_S.1, high - margin, f64::INFINITY);
                wanted.clamp(low, high)
            }
            None => wanted,
        };
        wanted.clamp(0.0, HURRY * self.set_speed)
    }
}

/// Returns the ego's lane and those beside it at `ahead`, m, each with the route to it and the
/// ego's arc length in it.
fn lanes_beside<'a>(
    road: &'a Road,
    here: &Here,
    ahead: f64,
) -> impl Iterator<Item = (RouteCode, LaneId, f64)> + use<'a> {
    let Here {
        lane,
        place,
        position,
        ..
    } = *here;
    let position = if ahead > 0.0 {
        road.lane(lane).at(place.s + ahead).centre
    } else {
        position
    };
    let aside = move |route: RouteCode| {
        let mut at = (lane, place.s + ahead);
        (0..LANES_ASIDE).map_while(move |_| {
            let section = road.lane(at.0).at(at.1);
            let next = match route {
                RouteCode::Left => section.left,
                _ => section.right,
            }?;
            at = (next, road.lane(next).project(position).s);
            Some((route, at.0, at.1 - ahead))
        })
    };
    std::iter::once((RouteCode::Keep, lane, place.s))
        .chain(aside(RouteCode::Left))
        .chain(aside(RouteCode::Right))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Scenario;
    use crate::commonroad::Lanelet;

    /// A spot in each of the three lanes, 200 m ahead in 8 to 12 s.
    #[test]
    fn the_route_leads_to_the_lane_and_the_time_of_the_goal() {
        let scenario = Scenario::load("free-lane").unwrap();
        let road = scenario.road();
        let (lane, place) = road.locate(scenario.start.position, scenario.start.yaw);
        let here = |time_s| Here {
            time_s,
            lane,
            place,
            position: scenario.start.position,
        };
        let goal = |s: f64, d: f64, time| Goal {
            places: vec![road.lane(lane).point(Frenet { s: place.s + s, d })],
            time,
            ..Goal::default()
        };
        let advice = |goal, time_s, reached| {
            Navigation::new(Arc::new([goal]), 30.0).advice(road, &here(time_s), reached)
        };
        let time = Some((8.0, 12.0));
        let [left, right] = [1.0, -1.0].map(|side| {
            let beside = road.lane(lane).at(place.s);
            let there = if side > 0.0 {
                beside.left
            } else {
                beside.right
            };
            (there.is_some(), 3.5 * side)
        });
        for (exists, d, route) in [
            (true, 0.4, RouteCode::Keep),
            (left.0, left.1, RouteCode::Left),
            (right.0, right.1, RouteCode::Right),
        ] {
            if exists {
                let there = advice(goal(200.0, d, time), 0.0, false);
                assert_eq!(there.route, route, "{d}");
                let expected = if route == RouteCode::Keep { 22.7 } else { 25.0 };
                assert!((there.set_speed - expected).abs() < 0.2, "{there:?}");
                let aside = if route == RouteCode::Keep { d } else { 0.0 };
                assert!((there.lane_offset - aside).abs() < 0.01, "{there:?}");
                assert!(there.near_gap, "there is a time to keep");
            }
        }
        assert!(left.0 || right.0, "the scenario has lanes beside");
        let free = Advice {
            route: RouteCode::Free,
            set_speed: 30.0,
            near_gap: false,
            lane_offset: 0.0,
        };
        for (what, given) in [
            (
                "beside the road",
                advice(goal(200.0, 30.0, time), 0.0, false),
            ),
            ("behind", advice(goal(-50.0, 0.0, time), 0.0, false)),
            ("too late", advice(goal(200.0, 0.0, time), 12.1, false)),
            ("reached", advice(goal(200.0, 0.0, time), 9.0, true)),
        ] {
            assert_eq!(given, free, "{what}");
        }
        // The ego arrives in time at the driver's own speed.
        let early = advice(goal(200.0, 0.0, Some((0.0, 12.0))), 0.0, false);
        assert_eq!((early.route, early.set_speed), (RouteCode::Keep, 30.0));
    }

    /// The driver notices a lane that opens on the way and enters a range of speeds in time: from
    /// below earlier than from above.
    #[test]
    fn the_route_looks_ahead() {
        let lanelet = |id, y: f64, from: f64, to: f64, joins: [&[i64]; 2], left| Lanelet {
            id,
            left: [from, to].map(|x| Vec2::new(x, y + 1.75)).to_vec(),
            right: [from, to].map(|x| Vec2::new(x, y - 1.75)).to_vec(),
            predecessors: joins[0].to_vec(),
            successors: joins[1].to_vec(),
            left_neighbour: left,
            right_neighbour: None,
            speed_limit: None,
            is_refused: false,
            is_crosswalk: false,
        };
        let mut lanelets = vec![
            lanelet(1, 0.0, 0.0, 200.0, [&[], &[2]], None),
            lanelet(2, 0.0, 200.0, 600.0, [&[1], &[]], None),
            lanelet(3, -3.5, 200.0, 600.0, [&[], &[]], Some(2)),
        ];
        lanelets[1].right_neighbour = Some(3);
        let road = Road::new(&lanelets).unwrap();
        let advice = |x: f64, y: f64, speed, opens_s: f64| {
            let position = Vec2::new(150.0, 0.0);
            let (lane, place) = road.locate(position, 0.0);
            let here = Here {
                time_s: 0.0,
                lane,
                place,
                position,
            };
            let goal = Goal {
                places: vec![Vec2::new(x, y)],
                time: Some((opens_s, opens_s + 1.0)),
                speed,
                ..Goal::default()
            };
            Navigation::new(Arc::new([goal]), 20.0).advice(&road, &here, false)
        };
        let right = advice(330.0, -3.5, None, 10.0);
        assert_eq!(right.route, RouteCode::Right);
        assert!((right.set_speed - 18.0).abs() < 0.5, "{right:?}");
        let slow = Some((0.0, 3.0));
        for (opens_s, range, expected) in [
            (3.0, slow, 20.0),
            (1.0, slow, 2.3),
            (3.0, Some((1.0, 3.0)), 12.5),
            (1.0, Some((1.0, 3.0)), 2.3),
            (3.0, Some((18.0, 20.0)), 18.7),
            (5.0, Some((18.0, 20.0)), 7.7),
        ] {
            let given = advice(190.0, 0.0, range, opens_s).set_speed;
            assert!(
                (given - expected).abs() < 0.2,
                "{opens_s} {range:?}: {given}"
            );
        }
    }
}
