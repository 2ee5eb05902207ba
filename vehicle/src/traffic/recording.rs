//! A recorded trajectory, interpolated.

use crate::commonroad::TimedState;
use crate::geometry::{Pose, Vec2, lerp_angle};

/// Where a vehicle is and how fast.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Motion {
    pub(crate) pose: Pose,
    /// m/s along the heading.
    pub(crate) speed: f64,
    /// m/s²
    pub(crate) acceleration: f64,
}

/// The times that a recording covers, s.
pub(crate) fn span(states: &[TimedState]) -> (f64, f64) {
    (states[0].t, states[states.len() - 1].t)
}

/// The motion at time `t`, held before the first state and after the last.
///
/// Positions are cubic between the states (Hermite, tangents from the neighbouring states), so that
/// they have no corners; speeds are linear between those of the file.
pub(crate) fn motion(states: &[TimedState], t: f64) -> Motion {
    let after = states.partition_point(|state| state.t <= t);
    let (from, to) = (after.saturating_sub(1), after.min(states.len() - 1));
    let (a, b) = (&states[from], &states[to]);
    if from == to {
        let pose = Pose {
            position: a.position,
            yaw: a.yaw,
        };
        return Motion {
            pose,
            speed: speed(states, from),
            acceleration: 0.0,
        };
    }
    let span = b.t - a.t;
    let share = (t - a.t) / span;
    let (speed_a, speed_b) = (speed(states, from), speed(states, to));
    Motion {
        pose: Pose {
            position: hermite(states, from, share, span),
            yaw: lerp_angle(a.yaw, b.yaw, share),
        },
        speed: speed_a + (speed_b - speed_a) * share,
        acceleration: (speed_b - speed_a) / span,
    }
}

/// The file's speed; where there is none, the distance to the neighbouring states by time.
fn speed(states: &[TimedState], index: usize) -> f64 {
    let state = &states[index];
    state
        .speed
        .unwrap_or_else(|| tangent(states, index).dot(Vec2::from_angle(state.yaw)))
}

fn hermite(states: &[TimedState], from: usize, share: f64, span: f64) -> Vec2 {
    let (a, b) = (states[from].position, states[from + 1].position);
    let (rate_a, rate_b) = (
        tangent(states, from) * span,
        tangent(states, from + 1) * span,
    );
    let (t, t2, t3) = (share, share * share, share * share * share);
    a * (2.0 * t3 - 3.0 * t2 + 1.0)
        + rate_a * (t3 - 2.0 * t2 + t)
        + b * (3.0 * t2 - 2.0 * t3)
        + rate_b * (t3 - t2)
}

/// Velocity from the states before and after.
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
            let motion = motion(&states, t);
            assert!((motion.pose.position - at(t).position).norm() < 1e-9, "{t}");
            assert!((motion.speed - 10.0 - 2.0 * t).abs() < 1e-9);
            assert!((motion.acceleration - 2.0).abs() < 1e-9);
        }
        assert_eq!(motion(&states, 9.0).pose.position, at(2.0).position);
        let unknown: Vec<_> = states
            .iter()
            .map(|s| TimedState { speed: None, ..*s })
            .collect();
        assert!((motion(&unknown, 1.0).speed - 12.0).abs() < 1e-9);
    }
}
