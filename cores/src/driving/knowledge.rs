//! The knowledge that a driving system sends to a system that has just joined. T-CHIP-5
//!
//! It comes from another system, so it may only refine the data of this system's sensors (see
//! `docs/decisions/0021-state-for-a-system-that-joins.md`): it creates no object and no lane, and
//! it is used only in the first [`STARTING_CYCLES`] cycles.

use super::math::{clamp, max, min};
use super::types::{
    ClassCode, Ego, MAX_OBJECTS, Memory, Object, Scene, Trajectory, TrajectoryPoint,
};
use heapless::Vec;
use tandem_board::{Duration, Instant};

/// A core uses knowledge in its first cycles only, for 400 ms. Afterwards it computes from its own
/// sensors alone, well before the commands of both systems are compared.
pub const STARTING_CYCLES: u32 = 8;
/// Older knowledge is not used: the traffic has changed.
pub const KNOWLEDGE_MAX_AGE: Duration = Duration::from_ms(200);
/// Samples of a plan that its continuation needs: 0.3 s and one more sample.
pub const PLAN_POINTS: usize = 5;

/// The first part of a plan, and the memory of the behaviour decision.
#[derive(Clone, Debug, PartialEq)]
pub struct KnownPlan {
    /// The memory of the behaviour decision.
    pub memory: Memory,
    /// Samples every [`super::types::TRAJECTORY_STEP_S`].
    pub points: [TrajectoryPoint; PLAN_POINTS],
}

/// The centre line of the ego lane, as in [`super::types::Lanes`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KnownLine {
    /// Its polynomial.
    pub c: [f32; 4],
    /// The distance to which the polynomial holds, m.
    pub view_range: f32,
}

/// The data that one system sends to another. All in the vehicle frame at [`Knowledge::at`].
#[derive(Clone, Debug, PartialEq)]
pub struct Knowledge {
    /// The time of the scene, on the clock of the system that holds this.
    pub at: Instant,
    /// Motion of the ego vehicle at `at`.
    pub ego: Ego,
    /// The ego lane; `None` if none is seen.
    pub line: Option<KnownLine>,
    /// The plan for this scene; `None` while there is none.
    pub plan: Option<KnownPlan>,
    /// Confirmed tracks, nearest first.
    pub objects: Vec<KnownObject, MAX_OBJECTS>,
}

impl Knowledge {
    /// Creates the knowledge of a system that has this scene and this trajectory.
    #[must_use]
    pub fn of(scene: &Scene, trajectory: Option<&Trajectory>) -> Self {
        let plan = trajectory.filter(|trajectory| trajectory.cycle == scene.cycle);
        Self {
            at: scene.at,
            ego: scene.ego,
            line: scene.lanes.as_ref().map(|lanes| KnownLine {
                c: lanes.c,
                view_range: lanes.view_range,
            }),
            plan: plan.map(|trajectory| KnownPlan {
                memory: trajectory.memory,
                points: core::array::from_fn(|index| trajectory.points[index]),
            }),
            objects: scene.objects.iter().map(KnownObject::pack).collect(),
        }
    }

    /// Returns whether all values can occur on a road.
    #[must_use]
    pub fn is_plausible(&self) -> bool {
        let within = |value: f32, limit: f32| value.abs() <= limit;
        let ego = &self.ego;
        within(ego.speed, 100.0)
            && within(ego.yaw_rate, 2.0)
            && within(ego.acceleration, 20.0)
            && within(ego.steering_angle, 1.0)
            && within(ego.slip_angle, 0.5)
            && self.line.is_none_or(|KnownLine { c, view_range }| {
                let limits = [10.0, 0.5, 0.02, 2e-4];
                c.iter().zip(limits).all(|(c, limit)| within(*c, limit))
                    && (0.0..=300.0).contains(&view_range)
            })
            && self.plan.as_ref().is_none_or(|plan| {
                plan.points.iter().all(|point| {
                    within(point.x, 50.0)
                        && within(point.y, 10.0)
                        && within(point.heading, 1.0)
                        && within(point.curvature, 0.2)
                        && (0.0..=100.0).contains(&point.speed)
                        && within(point.acceleration, 12.0)
                })
            })
            && self.objects.iter().all(|object| object.unpack().is_some())
    }
}

/// A track in 16 bytes: cm, cm/s, cm/s²; length and width in dm. The range of the numbers
/// bounds what a peer can claim.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct KnownObject(pub [u32; Self::WORDS]);

/// A track of another system.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Known {
    pub(crate) class: ClassCode,
    /// Position (m), velocity (m/s) and acceleration (m/s²) along x.
    pub(crate) x: [f32; 3],
    /// The same along y.
    pub(crate) y: [f32; 3],
    pub(crate) length: f32,
    pub(crate) width: f32,
    pub(crate) approaching: u8,
}

impl KnownObject {
    /// Words of an object.
    pub const WORDS: usize = 4;

    fn pack(object: &Object) -> Self {
        let cm = |value: f32| clamp(value * 100.0, -32_767.0, 32_767.0) as i16 as u16;
        let pair = |low: f32, high: f32| u32::from(cm(low)) | u32::from(cm(high)) << 16;
        let dm = |value: f32| clamp(value * 10.0 + 0.5, 0.0, 255.0) as u8;
        Self([
            pair(object.x, object.y),
            pair(object.vx, object.vy),
            pair(object.ax, object.ay),
            u32::from_le_bytes([
                dm(object.length),
                dm(object.width),
                object.class as u8,
                object.approaching,
            ]),
        ])
    }

    /// Returns the track; `None` if no road user can have these values.
    pub(crate) fn unpack(self) -> Option<Known> {
        let m = |word: u32, shift: u32| f32::from((word >> shift) as u16 as i16) / 100.0;
        let [place, velocity, acceleration, rest] = self.0;
        let [length, width, class, approaching] = rest.to_le_bytes();
        let axis = |shift| [m(place, shift), m(velocity, shift), m(acceleration, shift)];
        let known = Known {
            class: *ClassCode::ALL.get(usize::from(class))?,
            x: axis(0),
            y: axis(16),
            length: f32::from(length) / 10.0,
            width: f32::from(width) / 10.0,
            approaching,
        };
        let within =
            |place: usize, limit: f32| max(known.x[place].abs(), known.y[place].abs()) <= limit;
        let is_one = within(1, 100.0) && within(2, 12.0) && min(known.length, known.width) > 0.0;
        is_one.then_some(known)
    }
}
