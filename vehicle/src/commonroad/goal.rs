//! The goal of a planning problem: a place, a time, a speed, a direction.

use std::f64::consts::TAU;

use crate::geometry::Vec2;

/// Tolerance for rounding of the times of a goal, s; the world checks a goal every 5 ms.
const TIME_TOLERANCE: f64 = 2.6e-3;

/// A part of the plane.
#[derive(Clone, Debug, PartialEq)]
pub enum Area {
    /// A disc.
    Circle {
        /// m
        centre: Vec2,
        /// m
        radius: f64,
    },
    /// The area inside these corners, which are in clockwise or counter-clockwise order.
    Polygon(Vec<Vec2>),
}

impl Area {
    /// Returns the centre of the disc, or of the box around the corners.
    #[must_use]
    pub fn centre(&self) -> Vec2 {
        match self {
            Self::Circle { centre, .. } => *centre,
            Self::Polygon(corners) => {
                let (low, high) = super::bounds(corners);
                low.lerp(high, 0.5)
            }
        }
    }

    /// Returns the distance from the point to the area, m; 0 inside.
    #[must_use]
    pub fn distance(&self, point: Vec2) -> f64 {
        if self.contains(point) {
            return 0.0;
        }
        match self {
            Self::Circle { centre, radius } => (point - *centre).norm() - radius,
            Self::Polygon(corners) => {
                let edges = corners.iter().zip(corners.iter().cycle().skip(1));
                let to_edge = |(a, b): (&Vec2, &Vec2)| {
                    let along = *b - *a;
                    let share = (point - *a).dot(along) / along.dot(along).max(1e-9);
                    (point - a.lerp(*b, share.clamp(0.0, 1.0))).norm()
                };
                edges.map(to_edge).fold(f64::INFINITY, f64::min)
            }
        }
    }

    /// Returns whether the point lies inside.
    #[must_use]
    pub fn contains(&self, point: Vec2) -> bool {
        match self {
            Self::Circle { centre, radius } => (point - *centre).norm() <= *radius,
            Self::Polygon(corners) => {
                // A ray to the right crosses the border an odd number of times.
                let edges = corners.iter().zip(corners.iter().cycle().skip(1));
                let crossed = edges.filter(|(a, b)| {
                    let spans = (a.y > point.y) != (b.y > point.y);
                    spans && point.x < a.x + (point.y - a.y) / (b.y - a.y) * (b.x - a.x)
                });
                crossed.count() % 2 == 1
            }
        }
    }
}

/// The nearest approach of the ego to a goal's place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Nearest {
    /// m
    pub distance_m: f64,
    /// s
    pub at_s: f64,
    /// m/s
    pub speed: f64,
}

/// The conditions of one `<goalState>`. Quantities that it does not name are not limited.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Goal {
    /// The ego's centre must be in one of these; if empty, it may be anywhere.
    pub areas: Vec<Area>,
    /// Points on the way through these areas: a small area's centre, three points of a lanelet.
    pub places: Vec<Vec2>,
    /// Earliest and latest time, s since the ego's start.
    pub time: Option<(f64, f64)>,
    /// First and last direction, rad, counter-clockwise.
    pub yaw: Option<(f64, f64)>,
    /// Lowest and highest speed, m/s.
    pub speed: Option<(f64, f64)>,
}

impl Goal {
    /// Returns whether this state of the ego at time `t`, s, meets all conditions of the goal.
    #[must_use]
    pub fn is_reached(&self, t: f64, position: Vec2, yaw: f64, speed: f64) -> bool {
        let within = |range: Option<(f64, f64)>, value: f64, tolerance: f64| {
            range.is_none_or(|(from, to)| (from - tolerance..=to + tolerance).contains(&value))
        };
        let turned = self
            .yaw
            .is_none_or(|(from, to)| (yaw - from).rem_euclid(TAU) <= to - from);
        within(self.time, t, TIME_TOLERANCE)
            && within(self.speed, speed, 0.0)
            && turned
            && (self.areas.is_empty() || self.areas.iter().any(|area| area.contains(position)))
    }

    /// Returns the nearest approach so far: `before`, or the present one if it is nearer and within
    /// the goal's time.
    #[must_use]
    pub fn nearer(
        &self,
        before: Option<Nearest>,
        t: f64,
        position: Vec2,
        speed: f64,
    ) -> Option<Nearest> {
        let in_time =
            |(from, to): (f64, f64)| (from - TIME_TOLERANCE..=to + TIME_TOLERANCE).contains(&t);
        if !self.time.is_none_or(in_time) {
            return before;
        }
        let distances = self.areas.iter().map(|area| area.distance(position));
        let distance_m = distances.fold(f64::INFINITY, f64::min);
        let is_nearer = distance_m < before.map_or(f64::INFINITY, |it| it.distance_m);
        let at_s = t;
        let here = || Nearest {
            distance_m,
            at_s,
            speed,
        };
        is_nearer.then(here).or(before)
    }

    /// Returns the time from which the goal can no longer be reached, s since the ego's start.
    #[must_use]
    pub fn deadline(&self) -> Option<f64> {
        self.time.map(|(_, to)| to)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_goal_is_a_place_a_time_a_speed_and_a_direction() {
        let square = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)];
        let goal = Goal {
            areas: vec![Area::Polygon(square.map(|(x, y)| Vec2::new(x, y)).into())],
            places: vec![],
            time: Some((1.0, 2.0)),
            yaw: Some((3.0, 3.4)),
            speed: Some((5.0, 9.0)),
        };
        let inside = Vec2::new(1.0, 3.0);
        // The same direction after one more full turn.
        for yaw in [3.1, 3.1 - TAU] {
            assert!(goal.is_reached(1.5, inside, yaw, 6.0));
        }
        for (t, position, yaw, speed) in [
            (0.9, inside, 3.1, 6.0),
            (1.5, Vec2::new(5.0, 3.0), 3.1, 6.0),
            (1.5, inside, 2.9, 6.0),
            (1.5, inside, 3.1, 9.1),
        ] {
            assert!(
                !goal.is_reached(t, position, yaw, speed),
                "{t} {yaw} {speed}"
            );
        }
        assert!(Goal::default().is_reached(9.0, inside, 0.0, 0.0));
        let [area] = &goal.areas[..] else {
            panic!("one area")
        };
        assert_eq!(area.centre(), Vec2::new(2.0, 2.0));
        for (x, y, distance) in [(1.0, 3.0, 0.0), (7.0, 2.0, 3.0), (7.0, 8.0, 5.0)] {
            assert_eq!(area.distance(Vec2::new(x, y)), distance, "{x} {y}");
        }
    }
}
