//! Prediction of the other road users, in the Frenet frame of the ego lane.

use crate::driving::math::{abs, clamp, exp, max, min};
use crate::driving::road::{FrenetFrame, Reference};
use crate::driving::types::Object;

/// Slower than this across the road counts as keeping the lane, m/s.
const WANDERING: f32 = 0.3;
/// A road user that comes towards the vehicle faster than this, m/s, keeps to its lane …
const ONCOMING: f32 = 1.0;
/// … unless it moves across faster than this, m/s. The same holds for one that crosses the road at
/// an angle with a larger tangent than this.
const CROSSING: f32 = 1.5;
const CROSSING_SLOPE: f32 = 0.35;
/// The same for one that changes lanes: it moves along from at most this far aside, m, and at low
/// speed its tangent reaches 0.45.
const CROSSING_SLOPE_ALONG: f32 = 0.6;
const NEXT_LANE_M: f32 = 5.0;
/// A speed below this against the ego's direction, m/s, is noise: the road user has just stopped.
const ROLLS_BACK: f32 = 0.5;
/// Time constant with which a movement across the road ends, s.
const SWERVE_S: f32 = 1.2;
/// Gentle braking is expected to last this long …
const BRAKING_S: f32 = 1.0;
/// … and harder braking longer, s for each m/s².
const BRAKING_S_PER_STRENGTH: f32 = 0.8;

/// One object and its expected motion.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Predicted {
    /// Along the road, m; 0 is the ego vehicle.
    pub(crate) s: f32,
    /// Across the road from the centre of the ego lane, m, left positive.
    pub(crate) d: f32,
    /// Along the road, m/s.
    pub(crate) speed: f32,
    across: f32,
    acceleration: f32,
    pub(crate) half_length: f32,
    pub(crate) half_width: f32,
    sideways: Sideways,
}

/// How an object continues across the road.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Sideways {
    /// It ends its movement: a swerve.
    Swerves,
    /// Into the middle of the ego lane.
    CutsIn,
    /// Straight on, to the other side.
    Crosses,
}

impl Predicted {
    pub(crate) fn new(object: &Object, frame: &FrenetFrame) -> Self {
        let (s, d) = frame.project(object.x, object.y);
        let Reference { sine, cosine, .. } = frame.reference(s);
        let across = object.vy * cosine - object.vx * sine;
        let speed = object.vx * cosine + object.vy * sine;
        let (is_oncoming, turns) = (speed < -ONCOMING, abs(across) > CROSSING);
        let slope = if speed > 0.0 && abs(d) < NEXT_LANE_M {
            CROSSING_SLOPE_ALONG
        } else {
            CROSSING_SLOPE
        };
        let sideways = if turns && abs(across) > slope * abs(speed) {
            Sideways::Crosses
        } else if object.cuts_in && !is_oncoming {
            Sideways::CutsIn
        } else {
            Sideways::Swerves
        };
        let keeps_lane = match sideways {
            Sideways::Swerves if is_oncoming => !turns,
            Sideways::Swerves => abs(across) < WANDERING,
            Sideways::CutsIn | Sideways::Crosses => false,
        };
        Self {
            s,
            d,
            speed: if abs(speed) < ROLLS_BACK {
                max(speed, 0.0)
            } else {
                speed
            },
            across: if keeps_lane { 0.0 } else { across },
            acceleration: clamp(object.ax, -9.0, 0.0),
            half_length: 0.5 * max(object.length, 1.0),
            half_width: 0.5 * max(object.width, 0.5),
            sideways,
        }
    }

    /// Returns place and speed along the road in `t` seconds. Harder braking is expected to last
    /// longer; acceleration is not extrapolated.
    pub(crate) fn along(&self, t: f32) -> (f32, f32) {
        if self.speed <= 0.0 {
            return (self.s + self.speed * t, self.speed);
        }
        let mut lasting = BRAKING_S - BRAKING_S_PER_STRENGTH * self.acceleration;
        if self.acceleration < 0.0 {
            lasting = min(lasting, -self.speed / self.acceleration);
        }
        let braking = min(t, lasting);
        let speed = max(0.0, self.speed + self.acceleration * braking);
        let way = 0.5 * (self.speed + speed) * braking + speed * (t - braking);
        (self.s + way, speed)
    }

    /// Returns whether it comes towards the vehicle.
    pub(crate) fn is_oncoming(&self) -> bool {
        self.speed < -ONCOMING
    }

    /// Returns whether it crosses the road.
    pub(crate) fn crosses(&self) -> bool {
        self.sideways == Sideways::Crosses
    }

    /// Returns whether it crosses the road or comes towards the vehicle: the two then pass.
    pub(crate) fn passes(&self) -> bool {
        self.is_oncoming() || self.crosses()
    }

    /// Returns the place across the road in `t` seconds: a cut-in ends in the middle of the ego
    /// lane, a swerve fades, and a road user that crosses continues.
    pub(crate) fn across(&self, t: f32) -> f32 {
        match self.sideways {
            Sideways::Swerves if self.across == 0.0 => self.d,
            Sideways::Swerves => self.d + self.across * SWERVE_S * (1.0 - exp(-t / SWERVE_S)),
            Sideways::Crosses => self.d + self.across * t,
            Sideways::CutsIn => {
                let way = max(abs(self.across), 0.5) * t;
                if self.d > 0.0 {
                    max(self.d - way, 0.0)
                } else {
                    min(self.d + way, 0.0)
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn predicted(speed: f32, acceleration: f32) -> Predicted {
        Predicted {
            s: 30.0,
            d: 3.5,
            speed,
            across: -1.0,
            acceleration,
            half_length: 2.2,
            half_width: 0.9,
            sideways: Sideways::Swerves,
        }
    }

    #[test]
    fn hard_braking_goes_on_to_standstill() {
        let (s, speed) = predicted(20.0, -8.0).along(8.0);
        assert!((s - 30.0 - 25.0).abs() < 0.1 && speed == 0.0, "{s} {speed}");
        let (_, speed) = predicted(20.0, -1.0).along(8.0);
        assert!((speed - 18.2).abs() < 0.01, "{speed}");
    }

    /// The track of a vehicle that brakes to a stop may overshoot to a small backward speed. The
    /// prediction does not extrapolate that speed.
    #[test]
    fn a_leader_that_has_just_stopped_does_not_roll_back() {
        let line = crate::driving::road::CentreLine::of_curvature(0.0);
        let place_in_8_s = |vx: f32| {
            let object = Object {
                x: 7.7,
                y: 0.0,
                vx,
                vy: 0.0,
                cuts_in: false,
                ..Object::truck()
            };
            Predicted::new(&object, &FrenetFrame::new(line))
                .along(8.0)
                .0
        };
        assert!((place_in_8_s(-0.3) - 7.7).abs() < 0.01);
        assert!(place_in_8_s(-1.5) < 0.0, "it comes towards the vehicle");
    }

    /// At low speed a fast change of lanes points far aside. It ends in the own lane; a bicycle
    /// from the side goes on.
    #[test]
    fn a_fast_change_of_lanes_is_no_crossing() {
        let line = crate::driving::road::CentreLine::of_curvature(0.0);
        let moving = |y: f32, vx: f32, vy: f32| {
            let object = Object {
                x: 12.0,
                y,
                vx,
                vy,
                cuts_in: true,
                ..Object::truck()
            };
            Predicted::new(&object, &FrenetFrame::new(line))
        };
        let changes = moving(2.5, 7.2, -2.8);
        assert!(!changes.crosses());
        assert_eq!(changes.across(8.0), 0.0);
        for (y, vx, vy) in [
            (2.5, 0.0, -2.0),
            (2.5, 3.0, -3.0),
            (2.5, -6.0, -2.8),
            (10.0, 3.5, -2.0),
        ] {
            assert!(moving(y, vx, vy).crosses(), "{y} {vx} {vy}");
        }
    }

    #[test]
    fn a_cut_in_ends_in_the_own_lane_and_a_swerve_fades() {
        let swerving = predicted(20.0, 0.0);
        assert!((swerving.across(60.0) - 2.3).abs() < 0.01);
        let cutting_in = Predicted {
            sideways: Sideways::CutsIn,
            ..swerving
        };
        assert_eq!(cutting_in.across(60.0), 0.0);
        assert!((cutting_in.across(1.0) - 2.5).abs() < 1e-6);
    }
}
