//! Motion control (core 0, every 10 ms): follows the trajectory. T-CHIP-3

mod lateral;
mod shaping;

pub(crate) use lateral::{PathError, SlipFilter, steer};
pub(crate) use shaping::{STANDSTILL_BRAKE, Shaper};

use tandem_board::{Duration, Instant};

use super::math::{atan, bound, cos, lerp, max, min, sin, wrap_angle};
use super::odometry::{Odometry, Pose};
use super::types::{
    Command, Ego, Maneuver, TRAJECTORY_SAMPLES, TRAJECTORY_STEP_S, Trajectory, TrajectoryPoint,
};

/// A trajectory is followed for this long: six cycles of core 1 and 2, after which the traffic may
/// have changed too much.
pub const TRAJECTORY_MAX_AGE: Duration = Duration::from_ms(300);

/// Steering and powertrain answer this late, s: their feed-forward looks so far ahead.
const STEERING_PREVIEW_S: f32 = 0.07;
const POWERTRAIN_PREVIEW_S: f32 = 0.14;
/// Feedback of the speed, 1/s.
const SPEED_GAIN: f32 = 0.8;
/// Feedback of the way, 1/s².
const WAY_GAIN: f32 = 0.16;
/// The way's error counts up to this, m: after a long gap it must not brake or push hard.
const MAX_WAY_ERROR_M: f32 = 3.0;

/// Why there is no command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ControlError {
    /// The trajectory is older than [`TRAJECTORY_MAX_AGE`]: degrade to functions that need none.
    TrajectoryTooOld,
    /// The trajectory has values that are no numbers.
    TrajectoryInvalid,
}

/// Follows a trajectory by lateral and longitudinal feedback around its own feed-forward.
///
/// Lateral: linear-quadratic feedback of offset and course, curvature feed-forward (see `steer`).
/// Longitudinal: the trajectory's acceleration plus feedback of speed and way. Both are limited in
/// rate, so that the command never jumps, not even when another system's last command was taken
/// over.
#[derive(Clone, Debug)]
pub struct MotionControl {
    odometry: Odometry,
    slip: SlipFilter,
    shaper: Shaper,
}

impl Default for MotionControl {
    fn default() -> Self {
        Self::new()
    }
}

impl MotionControl {
    /// At rest, wheels straight.
    #[must_use]
    pub fn new() -> Self {
        Self {
            odometry: Odometry::new(),
            slip: SlipFilter::default(),
            shaper: Shaper::new(),
        }
    }

    /// Takes the motion measured at `now`; to be called with every such message (100 Hz).
    pub fn on_ego(&mut self, now: Instant, ego: &Ego) {
        self.odometry.update(now, ego);
    }

    /// Goes on from this command, which another function or the other system gave last: the next
    /// command differs from it by no more than one cycle's limits.
    pub fn resume(&mut self, last: &Command) {
        self.shaper.resume(last);
    }

    /// The command that [`MotionControl::step`] gave last, or the one to resume from.
    #[must_use]
    pub fn last(&self) -> Command {
        self.shaper.last()
    }

    /// The command for `now`; to be called every 10 ms.
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
        let age_s = age.as_secs_f32();
        let pose = self.odometry.between(trajectory.at, now);
        let reference = sample(trajectory, age_s);
        let feed_forward = FeedForward {
            curvature: sample(trajectory, age_s + STEERING_PREVIEW_S).curvature,
            acceleration: sample(trajectory, age_s + POWERTRAIN_PREVIEW_S).acceleration,
        };
        let Some(wish) = wish(&pose, ego, &reference, &feed_forward) else {
            return Err(ControlError::TrajectoryInvalid);
        };
        let urgent = trajectory.maneuver == Maneuver::Brake;
        Ok(self.shaper.shape(&wish, ego, urgent))
    }
}

/// What the trajectory demands by the time the actuators answer.
struct FeedForward {
    /// 1/m
    curvature: f32,
    /// m/s²
    acceleration: f32,
}

/// The unlimited command that holds the vehicle, now at `pose`, on the reference.
fn wish(
    pose: &Pose,
    ego: &Ego,
    reference: &TrajectoryPoint,
    feed_forward: &FeedForward,
) -> Option<Command> {
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
    // Limits would hide what is no number, so it is looked for before they apply.
    let sums = reference.x + reference.y + reference.heading + reference.speed;
    if !(sums + feed_forward.curvature + feed_forward.acceleration).is_finite() {
        return None;
    }
    let steering_angle = steer(&error, ego.speed, ego.acceleration);
    Some(Command {
        steering_angle,
        acceleration,
    })
}

/// The trajectory `t` seconds after its begin, linear between samples.
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

/// Curvature of the path that the vehicle drives now, 1/m.
pub(crate) fn driven_curvature(ego: &Ego) -> f32 {
    if ego.speed > 3.0 {
        ego.yaw_rate / ego.speed
    } else {
        atan(ego.steering_angle) / super::vehicle::WHEELBASE_M
    }
}
