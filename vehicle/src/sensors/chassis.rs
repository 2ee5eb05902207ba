//! Wheel speed, inertial and steering sensors.

use tandem_bus::EgoMotion;

use super::{EgoTruth, Noise};

/// Standard deviations of the noise.
const SPEED: f64 = 0.03;
const YAW_RATE: f64 = 0.001_5;
const ACCELERATION: f64 = 0.04;
const STEERING: f64 = 0.000_3;
const SLIP: f64 = 0.001;
/// Standard deviation of the offsets, which stay the same for a whole run: rad/s and m/s².
const YAW_RATE_OFFSET: f64 = 0.000_5;
const ACCELERATION_OFFSET: f64 = 0.03;

pub(super) struct Chassis {
    noise: Noise,
    yaw_rate_offset: f64,
    acceleration_offset: f64,
}

impl Chassis {
    pub(super) fn new(seed: u64) -> Self {
        let mut noise = Noise::new(seed, 17);
        let yaw_rate_offset = noise.normal(YAW_RATE_OFFSET);
        let acceleration_offset = noise.normal(ACCELERATION_OFFSET);
        Self {
            noise,
            yaw_rate_offset,
            acceleration_offset,
        }
    }

    pub(super) fn measure(&mut self, ego: &EgoTruth) -> EgoMotion {
        // Wheel sensors of a standing vehicle give no pulses, so there is no noise.
        let moves = ego.speed > 0.05;
        let mut noisy = |value: f64, deviation: f64| value + self.noise.normal(deviation);
        let speed = noisy(ego.speed * ego.slip_angle.cos(), SPEED);
        EgoMotion {
            world_running: false,
            gear: ego.gear,
            parking_brake: ego.parking_brake,
            speed: if moves { speed as f32 } else { 0.0 },
            yaw_rate: noisy(ego.yaw_rate + self.yaw_rate_offset, YAW_RATE) as f32,
            long_acceleration: noisy(
                ego.long_acceleration + self.acceleration_offset,
                ACCELERATION,
            ) as f32,
            lat_acceleration: noisy(ego.lat_acceleration, ACCELERATION) as f32,
            steering_angle: noisy(ego.steering_angle, STEERING) as f32,
            slip_angle: noisy(ego.slip_angle, SLIP) as f32,
        }
    }
}
