//! Candidates for the path across the road: quintics over the arc length, towards a lane's centre.

use super::polynomial::{Jet, Quintic};
use crate::driving::math::{abs, atan, cos, max, min, tan};
use crate::driving::road::Reference;
use crate::driving::types::TrajectoryPoint;

/// Greatest curvature of a path, 1/m: the turning circle with a margin.
const MAX_CURVATURE: f32 = 0.17;
/// Cost of a path that leaves the lane, for each metre and point of it.
const WEIGHT_OUTSIDE: f32 = 100.0;

/// A path relative to the reference: offset over arc length, from the start.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Path {
    shape: Quintic,
    pub(crate) goal: f32,
    start_s: f32,
}

/// A state in the Frenet frame: arc length, and the offset with its derivatives by arc length.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Station {
    pub(crate) s: f32,
    pub(crate) offset: Jet,
}

impl Path {
    /// From the station to an offset, over `length` m.
    pub(crate) fn new(from: &Station, goal: f32, length: f32) -> Self {
        let goal_jet = Jet {
            value: goal,
            ..Jet::default()
        };
        let shape = Quintic::new(&from.offset, &goal_jet, max(length, 1.0));
        Self {
            shape,
            goal,
            start_s: from.s,
        }
    }

    /// Offset and derivatives at arc length `s`.
    pub(crate) fn at(&self, s: f32) -> Jet {
        self.shape.at(max(s - self.start_s, 0.0))
    }
}

/// Returns the Frenet state of a Cartesian one (Werling et al., appendix).
pub(crate) fn to_frenet(point: &TrajectoryPoint, s: f32, d: f32, road: &Reference) -> Station {
    let turn = crate::driving::math::bound(point.heading - road.heading, 1.0);
    let stretch = max(1.0 - road.curvature * d, 0.2);
    let slope = stretch * tan(turn);
    let bend = stretch / (cos(turn) * cos(turn))
        * (point.curvature * stretch / cos(turn) - road.curvature)
        - (road.sharpness * d + road.curvature * slope) * tan(turn);
    Station {
        s,
        offset: Jet {
            value: d,
            first: slope,
            second: bend,
            third: 0.0,
        },
    }
}

/// The Cartesian state at an offset from the reference, moving along the road with `motion`.
pub(crate) fn to_cartesian(road: &Reference, offset: &Jet, motion: &Jet) -> TrajectoryPoint {
    let stretch = max(1.0 - road.curvature * offset.value, 0.2);
    let slope = offset.first / stretch;
    let turn = atan(slope);
    let (along, bent) = (
        cos(turn),
        road.sharpness * offset.value + road.curvature * offset.first,
    );
    let curvature = ((offset.second + bent * slope) * along * along / stretch + road.curvature)
        * along
        / stretch;
    let scale = stretch / along;
    TrajectoryPoint {
        x: road.x - offset.value * road.sine,
        y: road.y + offset.value * road.cosine,
        heading: road.heading + turn,
        curvature: max(min(curvature, MAX_CURVATURE), -MAX_CURVATURE),
        speed: max(motion.first * scale, 0.0),
        acceleration: motion.second * scale,
    }
}

/// Returns the cost of a path at this speed: weighs comfort against the time off the centre. Aside
/// of the reference, the lane has this much room, m: a path that leaves it costs more than comfort,
/// but not one that comes back.
pub(crate) fn cost(path: &Path, speed: f32, room: f32) -> f32 {
    let room = max(room, abs(path.at(path.start_s).value));
    let mut cost = 0.0;
    for step in 0..16 {
        let s = path.start_s + step as f32 * 0.25 * max(speed, 2.0);
        let offset = path.at(s);
        let aside = offset.value - path.goal;
        let acceleration = offset.second * speed * speed;
        let jerk = offset.third * speed * speed * speed;
        cost += aside * aside + 0.6 * acceleration * acceleration + 0.1 * jerk * jerk;
        cost += WEIGHT_OUTSIDE * max(abs(offset.value) - room, 0.0);
        if abs(offset.second) > MAX_CURVATURE {
            cost += 100.0;
        }
    }
    cost
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cartesian_and_back() {
        let heading = 0.1;
        let road = Reference {
            x: 3.0,
            y: 1.0,
            heading,
            sine: crate::driving::math::sin(heading),
            cosine: cos(heading),
            curvature: 0.004,
            sharpness: 1e-5,
        };
        let offset = Jet {
            value: 1.2,
            first: 0.05,
            second: 0.003,
            third: 0.0,
        };
        let motion = Jet {
            value: 0.0,
            first: 20.0,
            second: 0.5,
            third: 0.0,
        };
        let point = to_cartesian(&road, &offset, &motion);
        let back = to_frenet(&point, 0.0, 1.2, &road).offset;
        assert!((back.first - offset.first).abs() < 1e-5, "{back:?}");
        assert!((back.second - offset.second).abs() < 1e-5, "{back:?}");
    }

    /// The wheels are straight at the beginning of a bend of 250 m.
    #[test]
    fn a_path_out_of_the_lane_costs_more_than_comfort() {
        let speed = 25.0;
        let from = Station {
            s: 0.0,
            offset: Jet {
                second: -1.0 / 250.0,
                ..Jet::default()
            },
        };
        let costs = |room| {
            [2.0, 3.0, 4.5].map(|time| cost(&Path::new(&from, 0.0, time * speed), speed, room))
        };
        let ([_, free, slow], [_, inside, leaves]) = (costs(f32::INFINITY), costs(0.65));
        assert_eq!(free, inside, "it stays in the lane");
        assert!(leaves > 3.0 * slow, "{leaves} {slow}");
        // Who is already outside loses nothing by coming back slowly.
        let aside = Station {
            offset: Jet {
                value: 1.0,
                ..Jet::default()
            },
            ..from
        };
        let back = Path::new(&aside, 0.0, 4.5 * speed);
        assert_eq!(cost(&back, speed, 0.65), cost(&back, speed, f32::INFINITY));
    }
}
