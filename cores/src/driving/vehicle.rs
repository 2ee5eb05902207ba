//! The vehicle that is driven: CommonRoad vehicle 2 (BMW 320i) as a single-track model.
//!
//! Source: M. Althoff, G. Würsching, "CommonRoad: Vehicle Models", TU München, 2020, table of the
//! parameters and section "Single-Track Model".

use super::math::{bound, max};

/// m
pub(crate) const LENGTH_M: f32 = 4.508;
/// m
pub(crate) const WIDTH_M: f32 = 1.610;
/// Centre of gravity to front axle, m.
const FRONT_AXLE_M: f32 = 1.156_195_7;
/// Centre of gravity to rear axle, m.
const REAR_AXLE_M: f32 = 1.422_717_1;
/// Axle to axle, m.
pub(crate) const WHEELBASE_M: f32 = FRONT_AXLE_M + REAR_AXLE_M;
/// kg
pub(crate) const MASS_KG: f32 = 1_093.3;
/// m
pub(crate) const WHEEL_RADIUS_M: f32 = 0.344;
/// Height of the centre of gravity, m.
const GRAVITY_CENTRE_HEIGHT_M: f32 = 0.613_73;
/// Friction coefficient of the tyres.
const FRICTION: f32 = 1.0489;
/// Cornering stiffness per load of front and rear tyres, 1/rad.
const CORNERING_STIFFNESS: f32 = 20.898_08;
/// m/s²
const GRAVITY: f32 = 9.81;
/// Largest road wheel angle, rad; the CAN signal ends at 0.655.
pub(crate) const MAX_STEERING_RAD: f32 = 0.6;
/// Fastest turn of the road wheels, rad/s.
pub(crate) const MAX_STEERING_RATE: f32 = 0.4;

/// Loads of front and rear axle per mass, times the wheelbase, m²/s². They shift with the
/// longitudinal acceleration, m/s².
fn loads(acceleration: f32) -> (f32, f32) {
    let shift = bound(acceleration, 8.0) * GRAVITY_CENTRE_HEIGHT_M;
    (
        GRAVITY * REAR_AXLE_M - shift,
        GRAVITY * FRONT_AXLE_M + shift,
    )
}

/// Road wheel angle in rad for each 1/m of curvature in a steady turn.
///
/// The single-track model understeers by `K(a) = m (l_r / C_f - l_f / C_r) / L`; the axle loads,
/// and with them the stiffnesses, shift with the longitudinal acceleration. At constant speed the
/// vehicle is neutral, as both axles have the same stiffness per load.
fn steering_gain(speed: f32, acceleration: f32) -> f32 {
    let (front, rear) = loads(acceleration);
    let grip = FRICTION * CORNERING_STIFFNESS;
    let understeer = (REAR_AXLE_M / front - FRONT_AXLE_M / rear) / grip;
    WHEELBASE_M + understeer * speed * speed
}

/// Road wheel angle in rad that holds this curvature (1/m) in a steady turn.
pub(crate) fn steering_for(curvature: f32, speed: f32, acceleration: f32) -> f32 {
    bound(
        curvature * steering_gain(speed, acceleration),
        MAX_STEERING_RAD,
    )
}

/// Yaw rate in rad/s of a steady turn with this road wheel angle (rad).
pub(crate) fn yaw_rate_for(steering_angle: f32, speed: f32, acceleration: f32) -> f32 {
    // A gain near 0 would be a vehicle that oversteers until it spins.
    speed * steering_angle / max(steering_gain(speed, acceleration), 0.5 * WHEELBASE_M)
}

/// Side slip angle in rad at the centre of gravity in a steady turn with this yaw rate (rad/s).
/// `speed`: above 0.
pub(crate) fn slip_for(yaw_rate: f32, speed: f32, acceleration: f32) -> f32 {
    let (_, rear) = loads(acceleration);
    let grip = FRICTION * CORNERING_STIFFNESS;
    yaw_rate * (REAR_AXLE_M / speed - speed * FRONT_AXLE_M / (grip * rear))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neutral_at_constant_speed() {
        let slow = steering_for(0.01, 5.0, 0.0);
        let fast = steering_for(0.01, 35.0, 0.0);
        assert!((slow - 0.01 * WHEELBASE_M).abs() < 1e-6);
        assert!((fast - slow).abs() < 1e-4, "{fast} {slow}");
    }

    #[test]
    fn loaded_front_axle_needs_less_steering() {
        assert!(steering_for(0.005, 25.0, -4.0) < steering_for(0.005, 25.0, 0.0));
        assert!(steering_for(0.005, 25.0, 2.0) > steering_for(0.005, 25.0, 0.0));
    }
}
