//! The values that the driving functions pass to each other: scene (core 1 to 2), trajectory (core
//! 2 to 0), command (core 0 to the vehicle).
//!
//! Vehicle frame (ISO 8855): origin at the centre of gravity of the ego vehicle, x forward, y left,
//! angles counter-clockwise. SI units throughout.

use heapless::Vec;
use tandem_board::Instant;
use tandem_bus::CameraLanes;
pub use tandem_bus::{ClassCode, RouteCode};

/// Largest number of objects in a scene; the nearest ones are kept.
pub const MAX_OBJECTS: usize = 24;
/// Samples of a trajectory.
pub const TRAJECTORY_SAMPLES: usize = 41;
/// Time between two samples of a trajectory, in seconds: the horizon is 4 s.
pub const TRAJECTORY_STEP_S: f32 = 0.1;

/// Motion of the ego vehicle.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Ego {
    /// Speed over ground along the ego's x axis, m/s.
    pub speed: f32,
    /// rad/s, left positive.
    pub yaw_rate: f32,
    /// Longitudinal acceleration, m/s².
    pub acceleration: f32,
    /// Measured road wheel angle, rad, left positive.
    pub steering_angle: f32,
    /// Side slip angle at the centre of gravity, rad.
    pub slip_angle: f32,
}

/// The lanes around the ego vehicle. The ego lane's centre line is
/// `y(x) = c[0] + c[1] x + c[2] x² + c[3] x³` in the vehicle frame; its neighbours run parallel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lanes {
    /// Polynomial of the ego lane's centre line.
    pub c: [f32; 4],
    /// The polynomial holds for 0 ≤ x ≤ this, m.
    pub view_range: f32,
    /// Width of the ego lane, m.
    pub width: f32,
    /// Width of the lane to the left, m, if there is one in the same direction.
    pub left: Option<f32>,
    /// Width of the lane to the right, m, if there is one in the same direction.
    pub right: Option<f32>,
    /// Distance to the end of the ego lane, m; `f32::INFINITY` if no end is in sight.
    pub own_end: f32,
    /// The ego lane continues beyond that end, but outside the operational design domain. Nothing
    /// is decided by it: both ends are treated alike.
    pub ends_domain: bool,
    /// The same distance for the lane to the left.
    pub left_end: f32,
    /// The same for the lane to the right.
    pub right_end: f32,
    /// Signed speed limit, m/s; `f32::INFINITY` if none.
    pub speed_limit: f32,
}

impl Lanes {
    /// A straight lane of this `width` in m, seen for `view_range` m, with neither a neighbour nor
    /// an end nor a speed limit.
    #[must_use]
    pub const fn alone(width: f32, view_range: f32) -> Self {
        Self {
            c: [0.0; 4],
            view_range,
            width,
            left: None,
            right: None,
            own_end: f32::INFINITY,
            ends_domain: false,
            left_end: f32::INFINITY,
            right_end: f32::INFINITY,
            speed_limit: f32::INFINITY,
        }
    }
}

/// A line of the camera as it was received, without a filter.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CameraLine {
    /// When its frame arrived, on this system's clock.
    pub at: Instant,
    /// Its coefficients, as in [`Lanes::c`].
    pub c: [f32; 4],
}

impl CameraLine {
    /// Returns the line of a frame that arrived at `at`; `None` if the camera saw none.
    pub(crate) fn of(at: Instant, lanes: &CameraLanes) -> Option<Self> {
        let c = [lanes.c0, lanes.c1, lanes.c2, lanes.c3];
        lanes.valid.then_some(Self { at, c })
    }
}

/// One confirmed track.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Object {
    /// Stays the same as long as the object is tracked.
    pub id: u32,
    /// Kind of object.
    pub class: ClassCode,
    /// Centre, m.
    pub x: f32,
    /// Centre, m.
    pub y: f32,
    /// Velocity over ground in the vehicle frame's axes, m/s.
    pub vx: f32,
    /// Velocity over ground in the vehicle frame's axes, m/s.
    pub vy: f32,
    /// Acceleration along x over ground, m/s².
    pub ax: f32,
    /// Acceleration along y over ground, m/s²: for a system that joins.
    pub ay: f32,
    /// m
    pub length: f32,
    /// m
    pub width: f32,
    /// Lane relative to the ego lane by scene analysis: 0 the same, 1 left, -1 right, others ±2.
    pub lane: i8,
    /// It moves towards the ego lane and will be in it soon.
    pub cuts_in: bool,
    /// Approximate number of cycles for which it has been cutting in: for a system that joins.
    pub approaching: u8,
}

/// The state of the world that core 1 perceives at one time: the object list of T-CHIP-3.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The time to which the scene is predicted, on this system's clock.
    pub at: Instant,
    /// The same in the vehicle's time, the same number in both systems; `None` without that time.
    pub moment: Option<Instant>,
    /// The time at which the oldest measurement for this cycle was on the bus. If none arrived, the
    /// value of the previous cycle.
    pub measured: Instant,
    /// Counts the cycles of core 1, wraps around.
    pub cycle: u32,
    /// The sensors that are lost or late, one bit for each by
    /// [`SensorId::index`](tandem_bus::SensorId::index).
    pub missing: u8,
    /// Motion of the ego vehicle at `at`.
    pub ego: Ego,
    /// Lanes; `None` while the camera sees none.
    pub lanes: Option<Lanes>,
    /// The newest line of the camera that the scene uses: another core that hears the same frames
    /// must have received the same line.
    pub camera: CameraLine,
    /// Speed that the driver has set, m/s; `None` if automated driving is not asked for.
    pub set_speed: Option<f32>,
    /// Where the driver's route leads.
    pub route: RouteCode,
    /// The driver asks for the shorter of the two distances to the vehicle ahead.
    pub near_gap: bool,
    /// The place in the lane that the driver requests, m from its centre, left positive.
    pub lane_offset: f32,
    /// Confirmed tracks, nearest first.
    pub objects: Vec<Object, MAX_OBJECTS>,
}

/// The decision.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Maneuver {
    /// Keep the lane and the distance.
    Follow,
    /// Change to the lane on the left.
    ChangeLeft,
    /// Change to the lane on the right.
    ChangeRight,
    /// Brake as hard as needed to avoid a collision or to stop before the lane ends.
    Brake,
}

/// The memory of the behaviour decision between cycles, in 30 bits: for a system that joins.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Memory(pub(super) u32);

impl Memory {
    /// The memory with these bits; `None` if there are more than 30.
    #[must_use]
    pub const fn from_bits(bits: u32) -> Option<Self> {
        if bits >> 30 == 0 {
            Some(Self(bits))
        } else {
            None
        }
    }

    /// Returns its bits.
    #[must_use]
    pub const fn bits(self) -> u32 {
        self.0
    }
}

/// One sample of a trajectory, in the vehicle frame at [`Trajectory::at`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TrajectoryPoint {
    /// m
    pub x: f32,
    /// m
    pub y: f32,
    /// rad
    pub heading: f32,
    /// 1/m
    pub curvature: f32,
    /// m/s
    pub speed: f32,
    /// m/s²
    pub acceleration: f32,
}

/// The motion that core 2 plans for the vehicle: samples every [`TRAJECTORY_STEP_S`] from `at` on.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    /// Time of the first sample, and of the vehicle frame of all samples: the scene's `at`.
    pub at: Instant,
    /// The scene's `measured`.
    pub measured: Instant,
    /// The scene's cycle.
    pub cycle: u32,
    /// The decision that it carries out.
    pub maneuver: Maneuver,
    /// The memory of the behaviour decision.
    pub memory: Memory,
    /// The samples.
    pub points: [TrajectoryPoint; TRAJECTORY_SAMPLES],
}

/// The command of core 0 to the actuators.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Command {
    /// Road wheel angle, rad, left positive.
    pub steering_angle: f32,
    /// Longitudinal acceleration, m/s².
    pub acceleration: f32,
}

/// The function that computed a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum StepFunction {
    /// It follows the trajectory.
    #[default]
    Trajectory,
    /// It keeps lane and distance by the scene.
    Keep,
    /// It stops in the lane by the scene.
    Stop,
    /// It stops without a scene.
    Blind,
    /// It parks as the SoC asks.
    Parking,
}

impl StepFunction {
    /// All functions, in the order of their numbers.
    pub(crate) const ALL: [Self; 5] = [
        Self::Trajectory,
        Self::Keep,
        Self::Stop,
        Self::Blind,
        Self::Parking,
    ];
}

/// One step of the control with its inputs (core 0 to 2): a core that has the trajectory and the
/// scene can compute it again.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ControlStep {
    /// The function that computed it.
    pub function: StepFunction,
    /// The cycle of the trajectory, or of the scene.
    pub cycle: u32,
    /// Age of the trajectory or of the scene at the step, s.
    pub age_s: f32,
    /// The vehicle in their frame: x and y in m, heading in rad. Of a step that parks, what the SoC
    /// asks for: road wheel angle in rad, speed in m/s, and the acceleration with which to reach
    /// that, in m/s²; if it is negative, braking as hard as this.
    pub pose: [f32; 3],
    /// Motion of the ego vehicle, its slip angle without noise.
    pub ego: Ego,
    /// The previous command.
    pub last: Command,
    /// The command that was computed.
    pub command: Command,
}
