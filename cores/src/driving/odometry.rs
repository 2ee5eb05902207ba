//! Odometry: poses from the vehicle's own motion, and a short memory of them.

use tandem_board::Instant;

use super::math::{abs, clamp, cos, lerp, max, sin, wrap_angle};
use super::types::Ego;

/// A place and direction in the plane, as seen from a parent frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EgoPose {
    /// m
    pub x: f32,
    /// m
    pub y: f32,
    /// rad, counter-clockwise
    pub heading: f32,
}

impl EgoPose {
    /// The pose after `step`, which is given in the frame of `self`.
    #[must_use]
    pub fn then(self, step: Self) -> Self {
        let (x, y) = self.to_parent(step.x, step.y);
        Self {
            x,
            y,
            heading: wrap_angle(self.heading + step.heading),
        }
    }

    /// This pose as seen from `base`; both given in the same parent frame.
    #[must_use]
    pub fn seen_from(self, base: Self) -> Self {
        let (x, y) = base.to_local(self.x, self.y);
        Self {
            x,
            y,
            heading: wrap_angle(self.heading - base.heading),
        }
    }

    /// Returns a point of the parent frame in this pose's frame.
    #[must_use]
    pub fn to_local(self, x: f32, y: f32) -> (f32, f32) {
        self.axes().to_local(x, y)
    }

    /// Returns this pose prepared for the transformation of many points.
    pub(crate) fn axes(self) -> Axes {
        Axes {
            origin: (self.x, self.y),
            sine: sin(self.heading),
            cosine: cos(self.heading),
        }
    }

    /// Returns a point of this pose's frame in the parent frame.
    #[must_use]
    pub fn to_parent(self, x: f32, y: f32) -> (f32, f32) {
        let (sine, cosine) = (sin(self.heading), cos(self.heading));
        (
            self.x + cosine * x - sine * y,
            self.y + sine * x + cosine * y,
        )
    }
}

/// A pose whose direction is a vector.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Axes {
    origin: (f32, f32),
    sine: f32,
    cosine: f32,
}

impl Axes {
    /// Returns a point of the parent frame in this frame.
    pub(crate) fn to_local(self, x: f32, y: f32) -> (f32, f32) {
        self.turn(x - self.origin.0, y - self.origin.1)
    }

    /// Returns a vector of the parent frame in this frame.
    pub(crate) fn turn(self, x: f32, y: f32) -> (f32, f32) {
        let (sine, cosine) = (self.sine, self.cosine);
        (cosine * x + sine * y, cosine * y - sine * x)
    }
}

/// Returns the pose after `dt` seconds in which the motion changes linearly from `from` to `to`, in
/// the frame of the start.
#[must_use]
pub fn motion(from: &Ego, to: &Ego, dt: f32) -> EgoPose {
    let turn = 0.5 * (from.yaw_rate + to.yaw_rate) * dt;
    let course = 0.5 * turn + 0.5 * (from.slip_angle + to.slip_angle);
    let way = 0.5 * (from.speed + to.speed) * dt;
    EgoPose {
        x: way * cos(course),
        y: way * sin(course),
        heading: turn,
    }
}

/// How many poses are remembered: 640 ms at 100 Hz.
const MEMORY: usize = 64;
/// Motion is extrapolated no longer than this beyond the newest pose, s.
const MAX_EXTRAPOLATION_S: f32 = 0.5;
/// The frame is moved to the vehicle at this distance, m, before f32 becomes too coarse.
const REBASE_M: f32 = 500.0;

#[derive(Clone, Copy, Debug, Default)]
struct Mark {
    at: Instant,
    pose: EgoPose,
}

/// Dead reckoning from the chassis sensors, with a memory of 640 ms.
#[derive(Clone, Debug)]
pub struct Odometry {
    marks: [Mark; MEMORY],
    newest: usize,
    count: usize,
    ego: Ego,
}

impl Default for Odometry {
    fn default() -> Self {
        Self::new()
    }
}

impl Odometry {
    /// Odometry before the first motion.
    #[must_use]
    pub fn new() -> Self {
        Self {
            marks: [Mark::default(); MEMORY],
            newest: 0,
            count: 0,
            ego: Ego::default(),
        }
    }

    /// Takes the motion measured at `now`. A time before the last one is ignored.
    pub fn update(&mut self, now: Instant, ego: &Ego) {
        if self.count == 0 {
            self.marks[0] = Mark {
                at: now,
                pose: EgoPose::default(),
            };
            self.count = 1;
            self.ego = *ego;
            return;
        }
        let last = self.marks[self.newest];
        if now < last.at {
            return;
        }
        if now == last.at {
            // On the grid of arrivals: the newest counts.
            self.ego = *ego;
            return;
        }
        let dt = clamp(now.since(last.at).as_secs_f32(), 0.0, MAX_EXTRAPOLATION_S);
        let pose = last.pose.then(motion(&self.ego, ego, dt));
        self.newest = (self.newest + 1) % MEMORY;
        self.marks[self.newest] = Mark { at: now, pose };
        self.count = (self.count + 1).min(MEMORY);
        self.ego = *ego;
        if max(abs(pose.x), abs(pose.y)) > REBASE_M {
            self.rebase();
        }
    }

    /// Moves the frame to the newest pose: what is rounded in later poses no longer depends on how
    /// far the vehicle has driven since this memory began.
    pub(super) fn rebase(&mut self) {
        let base = self.marks[self.newest].pose;
        let axes = base.axes();
        for Mark { pose, .. } in &mut self.marks {
            (pose.x, pose.y) = axes.to_local(pose.x, pose.y);
            pose.heading = wrap_angle(pose.heading - base.heading);
        }
    }

    /// Moves all times by this many nanoseconds.
    pub(super) fn shift(&mut self, by_ns: i64) {
        for mark in &mut self.marks {
            mark.at = mark.at.moved(by_ns);
        }
    }

    /// Returns the newest motion.
    #[must_use]
    pub fn ego(&self) -> &Ego {
        &self.ego
    }

    /// Returns the pose at `to` as seen from the pose at `from`. Times before the memory count as
    /// its oldest time; times after the newest motion are extrapolated for up to 0.5 s. Before
    /// the first update all poses are equal.
    #[must_use]
    pub fn between(&self, from: Instant, to: Instant) -> EgoPose {
        self.pose_at(to).seen_from(self.pose_at(from))
    }

    fn pose_at(&self, at: Instant) -> EgoPose {
        let newest = self.marks[self.newest];
        if self.count == 0 {
            return EgoPose::default();
        }
        if at >= newest.at {
            let dt = clamp(at.since(newest.at).as_secs_f32(), 0.0, MAX_EXTRAPOLATION_S);
            return newest.pose.then(motion(&self.ego, &self.ego, dt));
        }
        let mut later = newest;
        for back in 1..self.count {
            let mark = self.marks[(self.newest + MEMORY - back) % MEMORY];
            if mark.at <= at {
                let span = later.at.since(mark.at).as_secs_f32();
                let share = clamp(at.since(mark.at).as_secs_f32() / max(span, 1e-6), 0.0, 1.0);
                let turn = wrap_angle(later.pose.heading - mark.pose.heading);
                return EgoPose {
                    x: lerp(mark.pose.x, later.pose.x, share),
                    y: lerp(mark.pose.y, later.pose.y, share),
                    heading: wrap_angle(mark.pose.heading + turn * share),
                };
            }
            later = mark;
        }
        later.pose
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_board::Duration;

    fn circling(speed: f32, yaw_rate: f32, seconds: u64) -> Odometry {
        let mut odometry = Odometry::new();
        let ego = Ego {
            speed,
            yaw_rate,
            ..Ego::default()
        };
        for step in 0..=seconds * 100 {
            odometry.update(Instant::ORIGIN + Duration::from_ms(step * 10), &ego);
        }
        odometry
    }

    #[test]
    fn straight_on_even_after_many_rebases() {
        let odometry = circling(40.0, 0.0, 60);
        let now = Instant::ORIGIN + Duration::from_ms(60_000);
        let from = Instant::ORIGIN + Duration::from_ms(59_700);
        let moved = odometry.between(from, now);
        assert!(
            (moved.x - 12.0).abs() < 1e-2 && moved.y.abs() < 1e-3,
            "{moved:?}"
        );
    }

    #[test]
    fn follows_a_circle() {
        let odometry = circling(10.0, 0.5, 10);
        let now = Instant::ORIGIN + Duration::from_ms(10_000);
        let moved = odometry.between(Instant::ORIGIN + Duration::from_ms(9_500), now);
        // Radius 20 m, turn of 0.25 rad.
        assert!((moved.heading - 0.25).abs() < 1e-3);
        assert!((moved.x - 20.0 * 0.25_f32.sin()).abs() < 1e-2, "{moved:?}");
        assert!(
            (moved.y - 20.0 * (1.0 - 0.25_f32.cos())).abs() < 1e-2,
            "{moved:?}"
        );
    }

    #[test]
    fn extrapolates_but_not_for_ever() {
        let odometry = circling(10.0, 0.0, 1);
        let now = Instant::ORIGIN + Duration::from_ms(1_000);
        let soon = odometry.between(now, now + Duration::from_ms(100));
        assert!((soon.x - 1.0).abs() < 1e-3);
        let late = odometry.between(now, now + Duration::from_ms(60_000));
        assert!((late.x - 5.0).abs() < 1e-2);
    }

    #[test]
    fn without_motion_nothing_moves() {
        let odometry = Odometry::new();
        assert_eq!(
            odometry.between(Instant::ORIGIN, Instant::NEVER),
            EgoPose::default()
        );
    }
}
