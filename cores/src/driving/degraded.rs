//! Degraded mode (core 0): L2 lane keeping and distance keeping directly from the scene, and safe
//! stop.
//!
//! Needs no trajectory, so it still works without core 2 or the other system. It never changes
//! lanes, drives no faster than a cap, and stops before its lane ends.

use tandem_board::{Duration, Instant};

use super::control::{
    HARD_BRAKING, PathError, STANDSTILL_BRAKE, Shaper, SlipFilter, Wish, driven_curvature, follows,
    steer,
};
use super::idm::{self, Driver, Leader};
use super::math::{abs, max, min, sqrt, wrap_angle};
use super::odometry::{EgoPose, motion};
use super::road::CentreLine;
use super::types::{Command, ControlStep, Ego, Lanes, Object, Scene, StepFunction};
use super::vehicle::{LENGTH_M, WIDTH_M};

/// A scene is used for this long. After that the functions have only the chassis sensors.
pub const SCENE_MAX_AGE: Duration = Duration::from_ms(500);

/// Degraded mode drives no faster than this, m/s (90 km/h).
const SPEED_CAP: f32 = 25.0;
/// Distance kept to the end of the lane, m. A vehicle that is nearer, or is there in this time,
/// brakes as in a safe stop, or so hard that it stands at the last distance, s and m.
const END_MARGIN_M: f32 = 8.0;
const END_NEAR_S: f32 = 3.0;
const END_LEAST_M: f32 = 1.0;
/// Lateral acceleration in curves, m/s².
const CURVE_ACCELERATION: f32 = 2.5;
/// Deceleration of a safe stop, m/s².
const SAFE_STOP_BRAKING: f32 = 2.5;
/// Braking for an object that is not in the lane yet, m/s².
const SOON_BRAKING: f32 = 3.0;
/// Deceleration without lanes, m/s².
const BLIND_BRAKING: f32 = 1.5;
/// Steering responds after this delay, s: its feed-forward looks this far ahead.
const PREVIEW_S: f32 = 0.07;

/// How degraded mode drives: with a larger gap than a system that has its full functions.
const DRIVER: Driver = Driver {
    desired_speed: SPEED_CAP,
    time_gap: 1.8,
    standstill_gap: 4.0,
    max_acceleration: 1.2,
    comfortable_braking: 2.0,
};

/// Lane keeping and distance keeping that one core can compute in its 10 ms.
#[derive(Clone, Debug)]
pub struct DegradedControl {
    slip: SlipFilter,
    shaper: Shaper,
    wish: Wish,
    last_step: ControlStep,
}

impl Default for DegradedControl {
    fn default() -> Self {
        Self::new()
    }
}

impl DegradedControl {
    /// For a vehicle at rest, with straight wheels.
    #[must_use]
    pub fn new() -> Self {
        Self {
            slip: SlipFilter::default(),
            shaper: Shaper::new(),
            wish: Wish::default(),
            last_step: ControlStep::default(),
        }
    }

    /// Returns the command of the last step without limits.
    #[must_use]
    pub(crate) fn wish(&self) -> Wish {
        self.wish
    }

    /// Resumes from this command, which another function or the other system gave last.
    pub fn resume(&mut self, last: &Command) {
        self.shaper.resume(last);
    }

    /// Returns the command that was given last, or the one to resume from.
    #[must_use]
    pub fn last(&self) -> Command {
        self.shaper.last()
    }

    /// Returns the last step, with its inputs.
    pub(crate) fn last_step(&self) -> &ControlStep {
        &self.last_step
    }

    /// Returns the command for `now`; to be called every 10 ms. A scene older than
    /// [`SCENE_MAX_AGE`] leads to [`DegradedControl::safe_stop`].
    pub fn step(&mut self, now: Instant, ego: &Ego, scene: &Scene) -> Command {
        self.drive(now, ego, scene, StepFunction::Keep)
    }

    /// As [`Self::step`], but brakes to standstill in the lane: a minimal-risk stop with the scene.
    pub fn stop(&mut self, now: Instant, ego: &Ego, scene: &Scene) -> Command {
        self.drive(now, ego, scene, StepFunction::Stop)
    }

    fn drive(&mut self, now: Instant, ego: &Ego, scene: &Scene, function: StepFunction) -> Command {
        let ego = &Ego {
            slip_angle: self.slip.filter(ego.slip_angle),
            ..*ego
        };
        let age = now.since(scene.at);
        if age > SCENE_MAX_AGE {
            return self.safe_stop(ego);
        }
        let pose = motion(&scene.ego, ego, age.as_secs_f32());
        let step = ControlStep {
            function,
            cycle: scene.cycle,
            age_s: age.as_secs_f32(),
            pose: [pose.x, pose.y, pose.heading],
            ego: *ego,
            last: self.shaper.last(),
            command: Command::default(),
        };
        self.finish(step, Some(scene))
    }

    /// Stops with the chassis sensors alone: brakes moderately and slowly straightens the wheels.
    pub fn safe_stop(&mut self, ego: &Ego) -> Command {
        let step = ControlStep {
            function: StepFunction::Blind,
            ego: *ego,
            last: self.shaper.last(),
            ..ControlStep::default()
        };
        self.finish(step, None)
    }

    fn finish(&mut self, step: ControlStep, scene: Option<&Scene>) -> Command {
        self.wish = wish(&step, scene);
        let command = self.shaper.shape(&self.wish, &step.ego);
        self.last_step = ControlStep { command, ..step };
        command
    }
}

/// Returns whether a step without a trajectory follows from its inputs and the scene of this core.
/// The inputs themselves are compared with the scene on core 0. T-RED-9
#[must_use]
pub fn is_right_by_scene(step: &ControlStep, scene: &Scene) -> bool {
    follows(step, &wish(step, Some(scene)))
}

/// The command of this step before its limits. Without a scene, the vehicle stops by the chassis
/// sensors.
fn wish(step: &ControlStep, scene: Option<&Scene>) -> Wish {
    let seen = scene.filter(|_| step.function != StepFunction::Blind);
    let mut command = match seen.map(|scene| (scene, &scene.lanes)) {
        Some((scene, Some(lanes))) => within_lanes(step, scene, lanes),
        Some((scene, None)) => without_lanes(step, scene),
        // The steering angle decays within a few seconds: better than driving straight at once or
        // circling for ever.
        None => Command {
            steering_angle: 0.995 * step.last.steering_angle,
            acceleration: -SAFE_STOP_BRAKING,
        },
    };
    if step.ego.speed < 0.3 && command.acceleration < 0.2 {
        command.acceleration = STANDSTILL_BRAKE;
    }
    // Without a plan, hard braking is an emergency.
    let urgent = command.acceleration < HARD_BRAKING;
    Wish { command, urgent }
}

fn pose_of(step: &ControlStep) -> EgoPose {
    let [x, y, heading] = step.pose;
    EgoPose { x, y, heading }
}

/// Keeps lane and distance; a stop brakes as well.
fn within_lanes(step: &ControlStep, scene: &Scene, lanes: &Lanes) -> Command {
    let (ego, pose) = (&step.ego, pose_of(step));
    let line = CentreLine::new(lanes);
    let steering_angle = keep(&line, &pose, ego);

    let signed = min(lanes.speed_limit, scene.set_speed.unwrap_or(SPEED_CAP));
    let desired = min(min(signed, SPEED_CAP), curve_speed(&line, ego.speed));
    let driver = Driver {
        desired_speed: max(desired, 0.1),
        ..DRIVER
    };
    let limit = match step.function {
        StepFunction::Stop => -SAFE_STOP_BRAKING,
        _ => DRIVER.max_acceleration,
    };
    let mut acceleration = min(limit, idm::acceleration(&driver, ego.speed, None));
    let now_at = (step.age_s, &pose);
    acceleration = min(
        acceleration,
        keep_distance(&driver, ego, scene, &line, lanes.width, now_at),
    );
    if lanes.own_end.is_finite() {
        let room = lanes.own_end - pose.x - 0.5 * LENGTH_M;
        let end = Leader {
            gap: room - END_MARGIN_M + driver.standstill_gap,
            speed: 0.0,
        };
        let mut braking = idm::acceleration(&driver, ego.speed, Some(end));
        if room < END_MARGIN_M + END_NEAR_S * ego.speed {
            let left = max(room - END_LEAST_M - 0.3 * ego.speed, 0.1);
            let needed = 0.5 * ego.speed * ego.speed / left;
            braking = max(braking, -max(SAFE_STOP_BRAKING, needed));
        }
        acceleration = min(acceleration, braking);
    }
    Command {
        steering_angle,
        acceleration,
    }
}

/// No lane is seen: continues the present curve, keeps the distance, and slows down to a stop.
fn without_lanes(step: &ControlStep, scene: &Scene) -> Command {
    let line = CentreLine::of_curvature(driven_curvature(&scene.ego));
    let now_at = (step.age_s, &pose_of(step));
    let distance = keep_distance(&DRIVER, &step.ego, scene, &line, WIDTH_M + 1.0, now_at);
    Command {
        steering_angle: 0.998 * step.last.steering_angle,
        acceleration: min(-BLIND_BRAKING, distance),
    }
}

/// Road wheel angle that keeps the vehicle, now at `pose`, on the line.
fn keep(line: &CentreLine, pose: &EgoPose, ego: &Ego) -> f32 {
    let (foot, offset) = line.project(pose.x, pose.y);
    let error = PathError {
        offset,
        course: wrap_angle(pose.heading + ego.slip_angle - line.heading(foot)),
        curvature: line.curvature(foot + PREVIEW_S * ego.speed),
    };
    steer(&error, ego.speed, ego.acceleration)
}

/// Returns the speed at which the curves ahead stay comfortable, m/s.
fn curve_speed(line: &CentreLine, speed: f32) -> f32 {
    let mut slowest = f32::INFINITY;
    let mut x = 0.0;
    while x < 10.0 + 3.0 * speed {
        let curvature = max(abs(line.curvature(x)), 1e-5);
        slowest = min(slowest, sqrt(CURVE_ACCELERATION / curvature));
        x += 10.0;
    }
    slowest
}

/// An object in relation to the ego lane.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Concern {
    /// Not ahead, or in another lane.
    None,
    /// It will enter the lane soon.
    Soon,
    /// It is ahead and in the lane, or reaches into it.
    Now,
}

fn concern(object: &Object, line: &CentreLine, lane_width: f32) -> Concern {
    let (_, offset) = line.project(object.x, object.y);
    let reach = 0.5 * max(lane_width, WIDTH_M) + 0.5 * object.width - 0.4;
    if object.x <= 0.0 {
        Concern::None
    } else if abs(offset) < reach {
        Concern::Now
    } else if object.cuts_in {
        Concern::Soon
    } else {
        Concern::None
    }
}

/// Acceleration that all objects on the line allow, with the scene `age_s` old and the vehicle now
/// at `pose`.
fn keep_distance(
    driver: &Driver,
    ego: &Ego,
    scene: &Scene,
    line: &CentreLine,
    lane_width: f32,
    (age_s, pose): (f32, &EgoPose),
) -> f32 {
    let mut acceleration = driver.max_acceleration;
    for object in &scene.objects {
        let limit = match concern(object, line, lane_width) {
            Concern::None => continue,
            Concern::Soon => -SOON_BRAKING,
            Concern::Now => -idm::MAX_BRAKING,
        };
        let x = object.x + object.vx * age_s;
        let gap = x - pose.x - 0.5 * (LENGTH_M + max(object.length, 3.0));
        let leader = Leader {
            gap,
            speed: max(object.vx, 0.0),
        };
        // Do not brake because of noise in the estimated acceleration.
        let braking = min(object.ax + 0.7, 0.0);
        acceleration = min(
            acceleration,
            max(idm::adaptive(driver, ego.speed, leader, braking), limit),
        );
    }
    acceleration
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::driving::perception::Perception;

    /// A vehicle that rolls to the end of its lane, nearer than the distance that is kept or nearly
    /// there, does not brake hard when this function takes over. It does where it must.
    #[test]
    fn rolling_to_the_end_of_the_lane_is_not_braked_hard() {
        for (speed, end, braking) in [
            (0.5, 7.0, 2.5..2.6),
            (4.0, 11.3, 2.4..2.6),
            (4.0, 10.0, 2.4..2.6),
            (10.0, 27.0, 2.4..2.6),
            (6.0, 9.0, 4.5..9.0),
        ] {
            let ego = Ego {
                speed,
                ..Ego::default()
            };
            let scene = Scene {
                ego,
                lanes: Some(Lanes {
                    own_end: end,
                    ..Lanes::alone(3.5, 80.0)
                }),
                ..Perception::new().scene().clone()
            };
            let mut control = DegradedControl::new();
            control.stop(scene.at, &ego, &scene);
            let wished = -control.wish().command.acceleration;
            assert!(braking.contains(&wished), "{speed} {end}: {wished}");
        }
    }

    /// T-RED-9: another core that has the scene accepts a right step of the functions without a
    /// trajectory, and rejects one with any wrong part.
    #[test]
    fn a_step_without_a_trajectory_is_computed_again() {
        let ego = Ego {
            speed: 25.0,
            ..Ego::default()
        };
        let at = Instant::from_ns(1_000_000_000);
        let scene = Scene {
            at,
            moment: None,
            cycle: 7,
            ego,
            lanes: Some(Lanes {
                c: [0.4, 0.002, 1e-4, 0.0],
                ..Lanes::alone(3.5, 80.0)
            }),
            ..Perception::new().scene().clone()
        };
        let blind = Scene {
            lanes: None,
            ..scene.clone()
        };
        let functions: [fn(&mut DegradedControl, Instant, &Ego, &Scene); 3] = [
            |control, now, ego, scene| _ = control.step(now, ego, scene),
            |control, now, ego, scene| _ = control.stop(now, ego, scene),
            |control, _, ego, _| _ = control.safe_stop(ego),
        ];
        for (scene, function) in [&scene, &blind].into_iter().flat_map(|it| {
            let of = move |function| (it, function);
            functions.map(of)
        }) {
            let mut control = DegradedControl::new();
            control.resume(&Command {
                steering_angle: 0.01,
                acceleration: -1.0,
            });
            for cycle in 0..15 {
                function(
                    &mut control,
                    at + Duration::from_ms(10 * cycle),
                    &ego,
                    scene,
                );
                assert!(is_right_by_scene(control.last_step(), scene), "{cycle}");
            }
            let good = *control.last_step();
            let faults: [fn(&mut ControlStep); 4] = [
                |step| step.command.steering_angle += 1e-4,
                |step| step.command.acceleration += 0.01,
                |step| step.command.steering_angle = f32::NAN,
                |step| step.last.steering_angle += 0.01,
            ];
            for (index, fault) in faults.iter().enumerate() {
                let mut step = good;
                fault(&mut step);
                assert!(!is_right_by_scene(&step, scene), "fault {index}");
            }
        }
    }
}
