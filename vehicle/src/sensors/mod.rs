//! The measurements that the vehicle sends on the bus: five radars, a camera, chassis sensors.
//!
//! Every sensor draws its noise from its own generator, so that one sensor's detections do not
//! change another one's noise; all come from the run's seed.

mod camera;
mod chassis;
mod detect;
mod disturbance;

use chacha20::ChaCha8Rng;
use chacha20::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use tandem_bus::{CameraLanes, EgoMotion, GearCode, ParkingBrakeCode, SensorId, SensorObject};

use crate::geometry::{Pose, Vec2};
use crate::road::{Frenet, LaneId, Road};
use crate::traffic::RoadUser;

pub(crate) use disturbance::Faults;
pub use disturbance::{NoSensorFault, SensorFault};

/// Period of object lists and lanes: 50 ms. T-CHIP-3
pub const SENSOR_PERIOD_MS: u64 = 50;
/// When each sensor measures within the period, ms, in the order of [`SensorId::ALL`]: sensors are
/// not synchronised, and the bus could not carry all lists at once.
pub const SENSOR_PHASE_MS: [u64; 6] = [0, 3, 6, 9, 12, 15];
/// When the camera's lanes are measured within the period, ms: after its objects.
pub const LANES_PHASE_MS: u64 = 16;

/// True motion of the ego.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EgoTruth {
    /// Centre of gravity and heading.
    pub pose: Pose,
    /// Speed of the centre of gravity, m/s.
    pub speed: f64,
    /// rad/s
    pub yaw_rate: f64,
    /// rad
    pub slip_angle: f64,
    /// rad
    pub steering_angle: f64,
    /// m/s², forward
    pub long_acceleration: f64,
    /// m/s², left
    pub lat_acceleration: f64,
    /// The lane that the ego is in.
    pub lane: LaneId,
    /// The ego's place in that lane.
    pub place: Frenet,
    /// The gear that is engaged.
    pub gear: GearCode,
    /// State of the parking brake.
    pub parking_brake: ParkingBrakeCode,
}

impl EgoTruth {
    /// Returns the velocity over ground in world axes, m/s.
    #[must_use]
    pub fn velocity(&self) -> Vec2 {
        Vec2::from_angle(self.pose.yaw + self.slip_angle) * self.speed
    }
}

/// A source of normally distributed errors.
struct Noise(ChaCha8Rng);

impl Noise {
    /// The generator of one sensor: `stream` selects independent random numbers.
    fn new(seed: u64, stream: u64) -> Self {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        generator.set_stream(stream);
        Self(generator)
    }

    /// Returns an error with this standard deviation.
    fn normal(&mut self, deviation: f64) -> f64 {
        let unit: f64 = StandardNormal.sample(&mut self.0);
        unit * deviation
    }

    /// Returns true with this probability.
    fn chance(&mut self, probability: f64) -> bool {
        // 53 random bits: uniform in 0 .. 1.
        use chacha20::rand_core::Rng;
        let uniform = (self.0.next_u64() >> 11) as f64 * (1.0 / (1_u64 << 53) as f64);
        uniform < probability
    }
}

/// All sensors of the vehicle.
pub struct Sensors {
    detectors: [detect::Detector; 6],
    lanes: camera::LaneCamera,
    chassis: chassis::Chassis,
}

impl Sensors {
    /// Creates sensors whose noise is determined by `seed`.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        Self {
            detectors: SensorId::ALL.map(|sensor| detect::Detector::new(sensor, seed)),
            lanes: camera::LaneCamera::new(seed),
            chassis: chassis::Chassis::new(seed),
        }
    }

    /// Returns the object list of one sensor, nearest first.
    pub fn objects(
        &mut self,
        sensor: SensorId,
        ego: &EgoTruth,
        vehicles: &[RoadUser],
    ) -> &[SensorObject] {
        self.detectors[sensor.index()].measure(ego, vehicles)
    }

    /// Returns the camera's lanes.
    pub fn lanes(&mut self, ego: &EgoTruth, road: &Road) -> CameraLanes {
        self.lanes.measure(ego, road)
    }

    /// Returns the measurements of the chassis sensors.
    pub fn motion(&mut self, ego: &EgoTruth, world_running: bool) -> EgoMotion {
        EgoMotion {
            world_running,
            ..self.chassis.measure(ego)
        }
    }
}
