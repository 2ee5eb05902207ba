//! The measurements that the vehicle sends on the bus: five radars, a camera, chassis sensors.
//!
//! Every sensor draws its noise from its own generator, so that one sensor's detections do not
//! change another one's noise; all come from the run's seed.

mod camera;
mod chassis;
mod detect;
mod disturbance;
mod timing;

use chacha20::ChaCha8Rng;
use chacha20::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use tandem_board::SystemId;
use tandem_bus::{
    CameraLanes, EgoMotion, GearCode, ParkingBrakeCode, SensorId, SensorObject, TimeStateCode,
};

use crate::geometry::{Pose, Vec2};
use crate::road::{Frenet, LaneId, Road};
use crate::traffic::RoadUser;

pub(crate) use disturbance::Outbox;
pub use disturbance::{NoSensorFault, SensorFault};
pub use timing::{NoSensorTiming, SensorTiming, TimingError};

/// The first of the streams of random numbers for the sensors' delays.
const STREAMS_OF_TIMING: u64 = 24;

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

    /// Returns a number in 0 .. 1, each as likely as any other.
    fn uniform(&mut self) -> f64 {
        // 53 random bits.
        use chacha20::rand_core::Rng;
        (self.0.next_u64() >> 11) as f64 * (1.0 / (1_u64 << 53) as f64)
    }

    /// Returns true with this probability.
    fn chance(&mut self, probability: f64) -> bool {
        self.uniform() < probability
    }
}

/// All sensors of the vehicle.
pub struct Sensors {
    detectors: [detect::Detector; 6],
    lanes: camera::LaneCamera,
    chassis: chassis::Chassis,
    timings: [timing::Timing; 6],
}

/// When a sensor has measured, as it says in its frames, and how long it takes to send them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stamp {
    /// µs, wraps around.
    pub(crate) measured_at: u32,
    /// The clock of the stamp.
    pub(crate) time_state: TimeStateCode,
    /// ms
    pub(crate) delay_ms: u64,
}

impl Sensors {
    /// Creates sensors whose noise is determined by `seed`.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        Self {
            detectors: SensorId::ALL.map(|sensor| detect::Detector::new(sensor, seed)),
            lanes: camera::LaneCamera::new(seed),
            chassis: chassis::Chassis::new(seed),
            timings: SensorId::ALL.map(|sensor| timing::Timing::new(sensor, seed)),
        }
    }

    /// Sets how the sensors' times differ from the vehicle's. They begin without a difference.
    pub(crate) fn set_timing(&mut self, timing: &[SensorTiming]) {
        for SensorTiming { sensor, what } in timing {
            for one in SensorId::ALL {
                if sensor.is_none_or(|sensor| sensor == one) {
                    self.timings[one.index()].set(*what);
                }
            }
        }
    }

    /// Returns the time stamp of a measurement of `sensor` at `now_ns` on the vehicle's clock and
    /// this scenario time.
    pub(crate) fn stamp(&mut self, sensor: SensorId, now_ns: u64, time_s: f64) -> Stamp {
        self.timings[sensor.index()].stamp(now_ns, time_s)
    }

    /// Takes a frame of time that was on the bus at `at_ns` on the vehicle's clock, for all.
    pub(crate) fn on_time_sync(&mut self, from: SystemId, at_ns: u64, time_s: f64, data: &[u8]) {
        for timing in &mut self.timings {
            timing.on_time_sync(from, at_ns, time_s, data);
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
