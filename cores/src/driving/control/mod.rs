//! Motion control (core 0, every 10 ms): follows the trajectory. T-CHIP-3

mod lateral;
mod shaping;

pub(crate) use lateral::{PathError, SlipFilter, steer};
pub(crate) use shaping::{HARD_BRAKING, STANDSTILL_BRAKE, Shaper, Wish};

use tandem_board::{Duration, Instant};

use super::math::{abs, atan, bound, cos, lerp, max, min, sin, wrap_angle};
use super::odometry::{EgoPose, Odometry, motion};
use super::types::{
    Command, ControlStep, Ego, Maneuver, StepFunction, TRAJECTORY_SAMPLES, TRAJECTORY_STEP_S,
    Trajectory, TrajectoryPoint,
};

/// A trajectory is followed for this long: six cycles of cores 1 and 2. Afterwards the traffic may
/// have changed too much.
pub const TRAJECTORY_MAX_AGE: Duration = Duration::from_ms(300);

/// Steering and powertrain respond after this delay, s: their feed-forward looks this far ahead.
const STEERING_PREVIEW_S: f32 = 0.07;
const POWERTRAIN_PREVIEW_S: f32 = 0.14;
/// Feedback of the speed, 1/s.
const SPEED_GAIN: f32 = 0.8;
/// Feedback of the distance driven, 1/s².
const WAY_GAIN: f32 = 0.16;
/// Limit of the distance's error, m: after a long gap the feedback must not brake or accelerate
/// hard.
const MAX_WAY_ERROR_M: f32 = 3.0;

/// Why there is no command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ControlError {
    /// The trajectory is older than [`TRAJECTORY_MAX_AGE`]: degrade to functions that need none.
    TrajectoryTooOld,
    /// The trajectory has values that are not numbers.
    TrajectoryInvalid,
}

/// Follows a trajectory by lateral and longitudinal feedback around its own feed-forward.
///
/// Lateral: linear-quadratic feedback of offset and course, curvature feed-forward (see `steer`).
/// Longitudinal: the trajectory's acceleration plus feedback of speed and distance. Both are
/// limited in rate, so that the command never jumps, not even when it continues another system's
/// last command.
#[derive(Clone, Debug)]
pub struct MotionControl {
    odometry: Odometry,
    slip: SlipFilter,
    shaper: Shaper,
    wish: Wish,
    last_step: ControlStep,
}

impl Default for MotionControl {
    fn default() -> Self {
        Self::new()
    }
}

impl MotionControl {
    /// For a vehicle at rest, with straight wheels.
    #[must_use]
    pub fn new() -> Self {
        Self {
            odometry: Odometry::new(),
            slip: SlipFilter::default(),
            shaper: Shaper::new(),
            wish: Wish::default(),
            last_step: ControlStep::default(),
        }
    }

    /// Returns the last step that gave a command, with its inputs.
    #[must_use]
    pub fn last_step(&self) -> &ControlStep {
        &self.last_step
    }

    /// Returns the command of the last step without limits.
    #[must_use]
    pub(crate) fn wish(&self) -> Wish {
        self.wish
    }

    /// Returns how the vehicle has moved between these times, in the frame of the first.
    pub(crate) fn moved(&self, from: Instant, to: Instant) -> EgoPose {
        self.odometry.between(from, to)
    }

    /// Takes the motion measured at `now`; to be called with every such message (100 Hz).
    pub fn on_ego(&mut self, now: Instant, ego: &Ego) {
        self.odometry.update(now, ego);
    }

    /// Resumes from this command, which another function or the other system gave last. The next
    /// command differs from it by no more than the limits of one cycle.
    pub fn resume(&mut self, last: &Command) {
        self.shaper.resume(last);
    }

    /// Returns the command that [`MotionControl::step`] gave last, or the one to resume from.
    #[must_use]
    pub fn last(&self) -> Command {
        self.shaper.last()
    }

    /// Returns the command for `now`; to be called every 10 ms.
    ///
    /// # Errors
    /// [`ControlError`]; the last command then stays as it was.
    pub fn step(
        &mut self,
        now: Instant,
        ego: &Ego,
        trajectory: &Trajectory,
    ) -> Result<Command, ControlError> {
        let ego = &Ego {
            slip_angle: self.slip.filter(ego.slip_angle),
            ..*ego
        };
        let age = now.since(trajectory.at);
        if age > TRAJECTORY_MAX_AGE {
            return Err(ControlError::TrajectoryTooOld);
        }
        let pose = self.odometry.between(trajectory.at, now);
        let step = ControlStep {
            function: StepFunction::Trajectory,
            cycle: trajectory.cycle,
            age_s: age.as_secs_f32(),
            pose: [pose.x, pose.y, pose.heading],
            ego: *ego,
            last: self.shaper.last(),
            command: Command::default(),
        };
        let Some(wish) = wish(&step, trajectory) else {
            return Err(ControlError::TrajectoryInvalid);
        };
        self.wish = wish;
        let command = self.shaper.shape(&wish, ego);
        self.last_step = ControlStep { command, ..step };
        Ok(command)
    }
}

/// Largest differences that rounding causes: rad and m/s².
const STEERING_ROUNDING: f32 = 1e-5;
const ACCELERATION_ROUNDING: f32 = 1e-3;
/// Largest deviation from the pose extrapolated from the scene's motion, m, m, rad, and from that
/// motion, m/s, rad/s, rad: more than sensor errors and 150 ms of hard driving cause.
const PLAUSIBLE_POSE: [f32; 3] = [2.0, 0.6, 0.1];
const PLAUSIBLE_EGO: [f32; 3] = [3.0, 0.4, 0.06];

/// Returns whether this step of another core follows from its inputs, and its inputs fit the data
/// of this core: the trajectory, and the motion at its start. T-RED-9
#[must_use]
pub fn is_right(step: &ControlStep, trajectory: &Trajectory, ego: &Ego) -> bool {
    let wish = wish(step, trajectory);
    wish.is_some_and(|wish| fits(step, ego) && follows(step, &wish))
}

/// Returns whether the inputs of the step fit the motion at the start of its trajectory or scene.
fn fits(step: &ControlStep, ego: &Ego) -> bool {
    let expected = motion(ego, &step.ego, step.age_s);
    let pose = [expected.x, expected.y, expected.heading];
    let pairs = [
        (step.ego.speed, ego.speed),
        (step.ego.yaw_rate, ego.yaw_rate),
        (step.ego.slip_angle, ego.slip_angle),
    ];
    (0..3).all(|axis| {
        is_near(step.pose[axis], pose[axis], PLAUSIBLE_POSE[axis])
            && is_near(pairs[axis].0, pairs[axis].1, PLAUSIBLE_EGO[axis])
    })
}

/// Returns whether the command of the step is this wish within the limits of the actuators.
pub(crate) fn follows(step: &ControlStep, wish: &Wish) -> bool {
    let mut shaper = Shaper::new();
    shaper.resume(&step.last);
    let (given, due) = (step.command, shaper.shape(wish, &step.ego));
    is_near(given.steering_angle, due.steering_angle, STEERING_ROUNDING)
        && is_near(given.acceleration, due.acceleration, ACCELERATION_ROUNDING)
}

fn is_near(one: f32, other: f32, limit: f32) -> bool {
    abs(one - other) <= limit
}

/// The demand of the trajectory at the time when the actuators answer.
struct FeedForward {
    /// 1/m
    curvature: f32,
    /// m/s²
    acceleration: f32,
}

/// The command, before its limits, that keeps the vehicle at the step's pose on the trajectory.
fn wish(step: &ControlStep, trajectory: &Trajectory) -> Option<Wish> {
    let (age_s, ego, [x, y, heading]) = (step.age_s, &step.ego, step.pose);
    let pose = EgoPose { x, y, heading };
    let reference = sample(trajectory, age_s);
    let feed_forward = FeedForward {
        curvature: sample(trajectory, age_s + STEERING_PREVIEW_S).curvature,
        acceleration: sample(trajectory, age_s + POWERTRAIN_PREVIEW_S).acceleration,
    };
    let (sine, cosine) = (sin(reference.heading), cos(reference.heading));
    let (dx, dy) = (pose.x - reference.x, pose.y - reference.y);
    let error = PathError {
        offset: cosine * dy - sine * dx,
        course: wrap_angle(pose.heading + ego.slip_angle - reference.heading),
        curvature: feed_forward.curvature,
    };
    let way_error = bound(-(cosine * dx + sine * dy), MAX_WAY_ERROR_M);
    let stays = reference.speed < 0.05 && feed_forward.acceleration < 0.05;
    let acceleration = if stays && ego.speed < 0.5 {
        STANDSTILL_BRAKE
    } else {
        feed_forward.acceleration
            + SPEED_GAIN * (reference.speed - ego.speed)
            + WAY_GAIN * way_error
    };
    // Refuses values that are not finite before the limits apply, because the limits would hide
    // them.
    let sums = reference.x + reference.y + reference.heading + reference.speed;
    if !(sums + feed_forward.curvature + feed_forward.acceleration).is_finite() {
        return None;
    }
    let steering_angle = steer(&error, ego.speed, ego.acceleration);
    Some(Wish {
        command: Command {
            steering_angle,
            acceleration,
        },
        urgent: trajectory.maneuver == Maneuver::Brake,
    })
}

/// Returns the trajectory `t` seconds after its start, linear between samples.
pub(crate) fn sample(trajectory: &Trajectory, t: f32) -> TrajectoryPoint {
    let place = max(t, 0.0) / TRAJECTORY_STEP_S;
    let index = min(place, (TRAJECTORY_SAMPLES - 2) as f32) as usize;
    let share = min(place - index as f32, 1.0);
    let (a, b) = (&trajectory.points[index], &trajectory.points[index + 1]);
    TrajectoryPoint {
        x: lerp(a.x, b.x, share),
        y: lerp(a.y, b.y, share),
        heading: a.heading + share * wrap_angle(b.heading - a.heading),
        curvature: lerp(a.curvature, b.curvature, share),
        speed: lerp(a.speed, b.speed, share),
        acceleration: lerp(a.acceleration, b.acceleration, share),
    }
}

/// Returns the curvature of the path that the vehicle drives now, 1/m.
pub(crate) fn driven_curvature(ego: &Ego) -> f32 {
    if ego.speed > 3.0 {
        ego.yaw_rate / ego.speed
    } else {
        atan(ego.steering_angle) / super::vehicle::WHEELBASE_M
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::driving::types::Memory;

    const EGO: Ego = Ego {
        speed: 25.0,
        yaw_rate: 0.0,
        acceleration: 0.0,
        steering_angle: 0.0,
        slip_angle: 0.0,
    };

    /// Straight on at 24 m/s, half a metre to the left.
    fn trajectory() -> Trajectory {
        let mut points = [TrajectoryPoint::default(); TRAJECTORY_SAMPLES];
        for (index, point) in points.iter_mut().enumerate() {
            point.x = 24.0 * TRAJECTORY_STEP_S * index as f32;
            point.y = 0.5;
            point.speed = 24.0;
        }
        Trajectory {
            at: Instant::from_ns(1_000_000_000),
            measured: Instant::from_ns(1_000_000_000),
            cycle: 7,
            maneuver: Maneuver::Follow,
            memory: Memory::default(),
            points,
        }
    }

    /// T-RED-9: another core that has the trajectory accepts a right step, and rejects one with any
    /// wrong part: a stuck command, a wrong place, a wrong motion.
    #[test]
    fn a_step_is_computed_again_and_every_fault_in_it_is_found() {
        let (trajectory, at) = (trajectory(), trajectory().at);
        let mut control = MotionControl::new();
        for cycle in 0..15 {
            let now = at + Duration::from_ms(10 * cycle);
            control.on_ego(now, &EGO);
            control.step(now, &EGO, &trajectory).unwrap();
            assert!(is_right(control.last_step(), &trajectory, &EGO), "{cycle}");
        }
        let good = *control.last_step();
        let faults: [fn(&mut ControlStep); 10] = [
            |step| step.command.steering_angle += 1e-4,
            |step| step.command.acceleration += 0.01,
            |step| step.command = step.last,
            |step| step.pose[0] += 3.0,
            |step| step.pose[1] += 1.0,
            |step| step.pose[2] += 0.2,
            |step| step.ego.speed -= 4.0,
            |step| step.ego.yaw_rate += 0.5,
            |step| step.ego.slip_angle -= 0.1,
            |step| step.command.steering_angle = f32::NAN,
        ];
        for (index, fault) in faults.iter().enumerate() {
            let mut step = good;
            fault(&mut step);
            assert!(!is_right(&step, &trajectory, &EGO), "fault {index}");
        }
        let mut other = trajectory.clone();
        other.points.iter_mut().for_each(|point| point.y = -0.5);
        assert!(!is_right(&good, &other, &EGO));
    }
}
