//! Steering by path errors: linear-quadratic feedback with feed-forward of the curvature.
//!
//! Kinematics by distance instead of time, e″ = κ - κ_ref for the offset e, as in J. M. Snider,
//! "Automatic Steering Methods for Autonomous Automobile Path Tracking", CMU-RI-TR-09-08, 2009. For
//! this double integrator the quadratic cost ∫ e²/ℓ⁴ + 2 e′²/ℓ² + κ² ds is minimal with κ = -e/ℓ² -
//! 2 e′/ℓ (the Riccati equation solved by hand): both poles at -1/ℓ, no overshoot. ℓ grows with the
//! speed, so that the reaction stays slower than the yaw dynamics.

use crate::driving::math::{bound, max, sin};
use crate::driving::vehicle::steering_for;

/// Time constant of the return to the path, s. The yaw dynamics at 30 m/s take 0.14 s.
const TIME_CONSTANT_S: f32 = 0.75;
/// ℓ at low speed, m: three wheelbases, so that the camera's noise does not shake the wheels.
const MIN_LENGTH_M: f32 = 8.0;
/// Larger offsets are limited to this, m, so that the return to a distant path is not abrupt.
const MAX_OFFSET_M: f32 = 1.5;
/// Lateral acceleration that feedback may ask for on top of the path's, m/s².
const MAX_FEEDBACK: f32 = 2.5;
/// Limit of the total lateral acceleration, m/s².
const MAX_LATERAL: f32 = 5.5;

/// The position and course of the vehicle relative to its path.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PathError {
    /// Offset of the centre of gravity from the path, m, left positive.
    pub(crate) offset: f32,
    /// Direction of motion less direction of the path, rad.
    pub(crate) course: f32,
    /// Curvature of the path, 1/m.
    pub(crate) curvature: f32,
}

/// The side slip angle without the noise of its measurement, which would shake the wheels.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct SlipFilter {
    /// `None` before the first measurement.
    angle: Option<f32>,
}

/// Share of the newest measurement in each step of 10 ms: a time constant of 0.1 s.
const SLIP_SHARE: f32 = 0.1;

impl SlipFilter {
    /// Takes a measurement, rad. Returns the filtered angle.
    pub(crate) fn filter(&mut self, measured: f32) -> f32 {
        let last = self.angle.unwrap_or(measured);
        let angle = last + SLIP_SHARE * (measured - last);
        self.angle = angle.is_finite().then_some(angle);
        self.angle.unwrap_or(0.0)
    }
}

/// Road wheel angle in rad for a vehicle that moves with `speed` (m/s) and `acceleration` (m/s²).
pub(crate) fn steer(error: &PathError, speed: f32, acceleration: f32) -> f32 {
    let length = max(speed * TIME_CONSTANT_S, MIN_LENGTH_M);
    let offset = bound(error.offset, MAX_OFFSET_M);
    let feedback = -(offset / length + 2.0 * sin(error.course)) / length;
    let square = max(speed * speed, 25.0);
    let curvature = error.curvature + bound(feedback, MAX_FEEDBACK / square);
    steering_for(bound(curvature, MAX_LATERAL / square), speed, acceleration)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::driving::vehicle::WHEELBASE_M;

    /// Kinematic vehicle on a circle of the given curvature, starting off the path.
    fn settle(speed: f32, curvature: f32, offset: f32) -> (f32, f32) {
        let (mut offset, mut course, mut greatest) = (offset, 0.0_f32, 0.0_f32);
        for _ in 0..3_000 {
            let angle = steer(
                &PathError {
                    offset,
                    course,
                    curvature,
                },
                speed,
                0.0,
            );
            course += speed * 0.01 * (angle / WHEELBASE_M - curvature);
            offset += speed * 0.01 * course.sin();
            greatest = greatest.max(-offset);
        }
        (offset, greatest)
    }

    #[test]
    fn returns_to_the_path_without_overshoot() {
        for speed in [3.0, 10.0, 20.0, 35.0] {
            let (offset, overshoot) = settle(speed, 0.5 / (speed * speed), 1.0);
            assert!(offset.abs() < 0.01, "{speed}: {offset}");
            assert!(overshoot < 0.05, "{speed}: {overshoot}");
        }
    }

    #[test]
    fn limits_lateral_acceleration() {
        let error = PathError {
            offset: -50.0,
            course: -1.0,
            curvature: 0.1,
        };
        let angle = steer(&error, 30.0, 0.0);
        assert!(angle / WHEELBASE_M * 900.0 < MAX_LATERAL + 0.1, "{angle}");
    }
}
