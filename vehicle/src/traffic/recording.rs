//! A recorded trajectory, interpolated.

use crate::commonroad::TimedState;
use crate::geometry::{Pose, Vec2, lerp_angle};

/// Place and speed of a vehicle.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Motion {
    pub(crate) pose: Pose,
    /// m/s along the heading.
    pub(crate) speed: f64,
    /// m/s²
    pub(crate) acceleration: f64,
}

/// A recorded state, with values derived from the states around it.
#[derive(Clone, Copy, Debug)]
struct Knot {
    t: f64,
    position: Vec2,
    yaw: f64,
    /// The file's speed; without one, the distance between the neighbouring states divided by the
    /// time.
    speed: f64,
    /// Velocity from the states before and after.
    tangent: Vec2,
    /// The vehicle moves no faster than this until the next state, m/s.
    speed_max: f64,
}

/// The recording of one vehicle.
///
/// Positions are cubic between the states (Hermite, tangents from the neighbouring states), so that
/// they have no corners; speeds are linear between those of the file.
#[derive(Clone, Debug)]
pub(crate) struct Track {
    knots: Vec<Knot>,
    /// Average number of states in a second.
    rate: f64,
    /// The vehicle's position never moves faster than this, m/s.
    speed_max: f64,
}

impl Track {
    /// The recording with these states; at least one.
    pub(crate) fn new(states: &[TimedState]) -> Self {
        let knot = |(index, state): (usize, &TimedState)| {
            let tangent = tangent(states, index);
            Knot {
                t: state.t,
                position: state.position,
                yaw: state.yaw,
                speed: state
                    .speed
                    .unwrap_or_else(|| tangent.dot(Vec2::from_angle(state.yaw))),
                tangent,
                speed_max: 0.0,
            }
        };
        let mut knots: Vec<Knot> = states.iter().enumerate().map(knot).collect();
        let length = knots[knots.len() - 1].t - knots[0].t;
        for index in 1..knots.len() {
            let (from, to) = (&knots[index - 1], &knots[index]);
            // A cubic is nowhere faster than the fastest edge of its control polygon (Bézier).
            let ends = from.tangent.norm().max(to.tangent.norm());
            let way = (to.position - from.position) * (3.0 / (to.t - from.t));
            let middle = way - from.tangent - to.tangent;
            knots[index - 1].speed_max = ends.max(middle.norm());
        }
        Self {
            rate: if length > 0.0 {
                (knots.len() - 1) as f64 / length
            } else {
                0.0
            },
            speed_max: knots.iter().map(|it| it.speed_max).fold(0.0, f64::max),
            knots,
        }
    }

    /// Returns the span of time that the recording covers, s.
    pub(crate) fn span(&self) -> (f64, f64) {
        (self.knots[0].t, self.knots[self.knots.len() - 1].t)
    }

    /// Returns the largest speed of the recorded vehicle, m/s.
    pub(crate) const fn speed_max(&self) -> f64 {
        self.speed_max
    }

    /// Returns a point near the vehicle at time `t`, and the largest distance from it, m.
    pub(crate) fn around(&self, t: f64) -> (Vec2, f64) {
        let knot = &self.knots[self.count_until(t).saturating_sub(1)];
        (knot.position, knot.speed_max * (t - knot.t).max(0.0))
    }

    /// Returns how many states are at or before `t`.
    fn count_until(&self, t: f64) -> usize {
        let knots = &self.knots;
        // Nearly all recordings have states at equal intervals of time.
        let guess = (t - knots[0].t) * self.rate;
        let mut count = (guess.max(0.0) as u32 as usize).min(knots.len());
        while knots.get(count).is_some_and(|knot| knot.t <= t) {
            count += 1;
        }
        while count > 0 && knots[count - 1].t > t {
            count -= 1;
        }
        count
    }

    /// Returns the motion at time `t`, held before the first state and after the last.
    pub(crate) fn motion(&self, t: f64) -> Motion {
        let after = self.count_until(t);
        let (from, to) = (after.saturating_sub(1), after.min(self.knots.len() - 1));
        let (a, b) = (&self.knots[from], &self.knots[to]);
        if from == to {
            let pose = Pose {
                position: a.position,
                yaw: a.yaw,
            };
            return Motion {
                pose,
                speed: a.speed,
                acceleration: 0.0,
            };
        }
        let span = b.t - a.t;
        let share = (t - a.t) / span;
        Motion {
            pose: Pose {
                position: hermite(a, b, share, span),
                yaw: lerp_angle(a.yaw, b.yaw, share),
            },
            speed: a.speed + (b.speed - a.speed) * share,
            acceleration: (b.speed - a.speed) / span,
        }
    }
}

fn hermite(a: &Knot, b: &Knot, share: f64, span: f64) -> Vec2 {
    let (t, t2, t3) = (share, share * share, share * share * share);
    a.position * (2.0 * t3 - 3.0 * t2 + 1.0)
        + (a.tangent * span) * (t3 - 2.0 * t2 + t)
        + b.position * (3.0 * t2 - 2.0 * t3)
        + (b.tangent * span) * (t3 - t2)
}

/// The place of a recorded vehicle must move with its speed, within this difference, m/s, and this
/// part of it.
const MOVES_OTHERWISE: (f64, f64) = (5.0, 0.5);
/// No road user changes its speed faster than this, m/s².
const IMPOSSIBLE: f64 = 15.0;

/// Returns the first defect of a recording, in words: between two states the place does not move as
/// the speeds say, or the speed changes as no vehicle can. `None` if there is none, or if the
/// states have no speed.
pub(crate) fn defect(states: &[TimedState]) -> Option<String> {
    states.windows(2).find_map(|pair| {
        let [from, to] = pair else { return None };
        let span = to.t - from.t;
        let (before, after) = (from.speed?, to.speed?);
        if span <= 0.0 {
            return None;
        }
        let moved = (to.position - from.position).norm() / span;
        let said = (before.abs() + after.abs()) / 2.0;
        let apart = (moved - said).abs();
        let when = format!("from {:.2} s to {:.2} s", from.t, to.t);
        if apart > MOVES_OTHERWISE.0 && apart > MOVES_OTHERWISE.1 * said.max(moved) {
            let how = if moved < 0.1 { "stands" } else { "moves" };
            let moved = if moved < 0.1 {
                String::new()
            } else {
                format!(" {moved:.1} m/s")
            };
            return Some(format!(
                "its place {how}{moved} {when} at a speed of {said:.1} m/s"
            ));
        }
        let change = (after - before) / span;
        (change.abs() > IMPOSSIBLE).then(|| format!("its speed changes by {change:.0} m/s² {when}"))
    })
}

/// Returns the velocity from the states before and after.
fn tangent(states: &[TimedState], index: usize) -> Vec2 {
    let before = &states[index.saturating_sub(1)];
    let after = &states[(index + 1).min(states.len() - 1)];
    let span = after.t - before.t;
    if span > 0.0 {
        (after.position - before.position) * (1.0 / span)
    } else {
        Vec2::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_uniformly_accelerated_motion_is_interpolated_exactly_inside() {
        let at = |t: f64| TimedState {
            t,
            position: Vec2::new(10.0 * t + t * t, 0.0),
            yaw: 0.0,
            speed: Some(10.0 + 2.0 * t),
        };
        let states: Vec<TimedState> = (0..5).map(|i| at(f64::from(i) * 0.5)).collect();
        for t in [0.5, 0.6, 0.75, 1.2, 1.49] {
            let motion = Track::new(&states).motion(t);
            assert!((motion.pose.position - at(t).position).norm() < 1e-9, "{t}");
            assert!((motion.speed - 10.0 - 2.0 * t).abs() < 1e-9);
            assert!((motion.acceleration - 2.0).abs() < 1e-9);
        }
        assert_eq!(
            Track::new(&states).motion(9.0).pose.position,
            at(2.0).position
        );
        let unknown: Vec<_> = states
            .iter()
            .map(|s| TimedState { speed: None, ..*s })
            .collect();
        assert!((Track::new(&unknown).motion(1.0).speed - 12.0).abs() < 1e-9);
    }

    /// The place of a leader stands for one step of 0.2 s, although its speed is 21 m/s: the defect
    /// of a public file. A vehicle that brakes hard has none.
    #[test]
    fn a_recording_that_contradicts_itself_is_named() {
        let state = |t: f64, x: f64, speed: f64| TimedState {
            t,
            position: Vec2::new(x, 0.0),
            yaw: 0.0,
            speed: Some(speed),
        };
        let stands = [
            state(0.0, 9.0, 21.4),
            state(0.2, 9.0, 21.4),
            state(0.4, 13.3, 21.4),
        ];
        let said = defect(&stands).unwrap();
        assert_eq!(
            said,
            "its place stands from 0.00 s to 0.20 s at a speed of 21.4 m/s"
        );
        assert_eq!(defect(&stands[1..]), None);
        let jumps = [state(0.0, 0.0, 20.0), state(0.2, 3.4, 14.0)];
        assert_eq!(
            defect(&jumps).unwrap(),
            "its speed changes by -30 m/s² from 0.00 s to 0.20 s"
        );
        let brakes = [state(0.0, 0.0, 20.0), state(0.2, 3.84, 18.4)];
        assert_eq!(defect(&brakes), None);
    }

    /// With states at uneven times, the last state before a time is found, and the vehicle stays
    /// within the distance of the point that `around` returns.
    #[test]
    fn a_time_is_found_and_the_vehicle_is_near_there() {
        let times = [0.0, 0.1, 0.15, 0.9, 1.0, 1.1, 3.0];
        let states = times.map(|t: f64| TimedState {
            t,
            position: Vec2::new(20.0 * t, 5.0 * (3.0 * t).sin()),
            yaw: 0.0,
            speed: None,
        });
        let track = Track::new(&states);
        for step in -50..400 {
            let t = f64::from(step) * 0.01;
            let expected = states.partition_point(|state| state.t <= t);
            assert_eq!(track.count_until(t), expected, "{t}");
            let (near, by) = track.around(t);
            let apart = (track.motion(t).pose.position - near).norm();
            assert!(apart <= by + 1e-9, "{t}: {apart} {by}");
        }
    }
}
