//! Steering and powertrain between a request and the plant: delay, first-order lag, limits.

use crate::plant::{Parameters, PlantInput, PlantState};

/// Time constants of an actuator.
struct Response {
    /// Dead time, in steps of 1 ms.
    delay_ms: usize,
    /// First-order lag, s.
    lag_s: f64,
}

/// Electric power steering: position control over a fast motor.
const STEERING: Response = Response {
    delay_ms: 10,
    lag_s: 0.05,
};
/// Engine and brake through ESC: hydraulic pressure builds up within about 0.2 s.
const POWERTRAIN: Response = Response {
    delay_ms: 20,
    lag_s: 0.12,
};
/// Largest acceleration of the powertrain in automated driving, m/s².
const ACCELERATION_MAX: f64 = 4.0;
/// Largest deceleration by the brake, m/s², on a dry road.
const DECELERATION_MAX: f64 = 9.5;

/// Time without an accepted control frame, ns, after which the steering holds its angle and the
/// brake slows the vehicle down gently.
pub const FALLBACK_AFTER_NS: u64 = 100_000_000;
/// Deceleration without a controller, m/s²: gentle enough for the follower.
pub const FALLBACK_DECELERATION: f64 = 2.0;

/// The request of the controller.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Request {
    /// Road wheel angle, rad, left positive.
    pub steering_angle: f64,
    /// m/s²
    pub acceleration: f64,
}

/// The state of both actuators.
#[derive(Debug)]
pub struct Actuators {
    /// Ring of the requests of the last milliseconds, newest at `next`.
    past: [Request; Self::RING],
    next: usize,
    /// Acceleration before the plant's limits apply, m/s².
    acceleration: f64,
}

impl Actuators {
    const RING: usize = 32;

    /// Actuators in the steady state of `request`.
    #[must_use]
    pub fn settled(request: Request) -> Self {
        Self {
            past: [request; Self::RING],
            next: 0,
            acceleration: request.acceleration,
        }
    }

    /// Returns the plant's input for the next millisecond.
    #[must_use]
    pub fn step(&mut self, request: Request, state: &PlantState, p: &Parameters) -> PlantInput {
        self.next = (self.next + 1) % Self::RING;
        self.past[self.next] = Request {
            steering_angle: request
                .steering_angle
                .clamp(-p.steering_max, p.steering_max),
            acceleration: request
                .acceleration
                .clamp(-DECELERATION_MAX, ACCELERATION_MAX),
        };
        let delayed = |ms: usize| self.past[(self.next + Self::RING - ms) % Self::RING];
        let steering = delayed(STEERING.delay_ms).steering_angle;
        let wanted = delayed(POWERTRAIN.delay_ms).acceleration;
        self.acceleration += (wanted - self.acceleration) * (1e-3 / POWERTRAIN.lag_s);
        let steering_rate = (steering - state.steering_angle) / STEERING.lag_s;
        // The brake holds a standing vehicle; there is no reverse gear.
        let holds = state.speed <= 0.0 && self.acceleration <= 0.0;
        let acceleration = if holds { 0.0 } else { self.acceleration };
        PlantInput {
            steering_rate,
            acceleration,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plant::BMW_320I;

    #[test]
    fn a_request_takes_effect_after_delay_and_lag() {
        let mut actuators = Actuators::settled(Request::default());
        let mut state = PlantState {
            speed: 20.0,
            ..PlantState::default()
        };
        let request = Request {
            steering_angle: 0.01,
            acceleration: -3.0,
        };
        for ms in 1..=500 {
            let input = actuators.step(request, &state, &BMW_320I);
            state = state.stepped(input, 1e-3, &BMW_320I);
            match ms {
                10 => assert_eq!(input.steering_rate, 0.0),
                11 => assert!(input.steering_rate > 0.1),
                20 => assert_eq!(input.acceleration, 0.0),
                // One time constant after the delay: 63 percent.
                140 => assert!((input.acceleration + 3.0 * 0.632).abs() < 0.02),
                _ => {}
            }
        }
        assert!((state.steering_angle - 0.01).abs() < 1e-5);
    }
}
