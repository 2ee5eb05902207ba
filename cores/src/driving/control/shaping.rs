//! Limits of the commands to the actuators: amplitude and rate, so that no command ever jumps.

use crate::driving::math::{bound, clamp, max, min, sqrt};
use crate::driving::types::{Command, Ego};
use crate::driving::vehicle::{MAX_STEERING_RAD, MAX_STEERING_RATE, WHEELBASE_M};

/// Braking that holds the standing vehicle, m/s².
pub(crate) const STANDSTILL_BRAKE: f32 = -0.5;

/// Period of core 0, s: rates are limited per step.
const PERIOD_S: f32 = 0.01;
/// m/s²
const MAX_ACCELERATION: f32 = 3.0;
/// m/s²; the tyres can transmit 10.
const MAX_BRAKING: f32 = 9.5;
/// Jerk of comfortable driving, m/s³.
const COMFORT_JERK: f32 = 6.0;
/// Jerk of hard braking and of its release when there is no emergency, m/s³.
const FIRM_JERK: f32 = 9.0;
/// Jerk of an emergency, m/s³: full braking after 0.2 s.
const EMERGENCY_JERK: f32 = 45.0;
/// Braking beyond this is hard, m/s², as in planning.
pub(crate) const HARD_BRAKING: f32 = -4.0;
/// A brake that is not released before standstill ends the stop with a jolt. So it is released with
/// this jerk, m/s³, to the braking that holds the vehicle. This adds 5 cm from 2.5 m/s², 19 cm from
/// 4 m/s². Braking `a` adds a³ / 24 jerk²: where that would be more than this way, m, the jerk is
/// higher.
const SOFT_STOP_JERK: f32 = 4.0;
const SOFT_STOP_M: f32 = 0.2;
/// The release delay of the brake, s: twice its lag of 0.14 s, after which a tenth is left.
const BRAKE_DELAY_S: f32 = 0.3;
/// At this speed and above, the wheels may turn as fast as they can, m/s.
const ROLLING_SPEED: f32 = 4.0;
/// Lateral jerk that a change of steering may cause, m/s³.
const LATERAL_JERK: f32 = 12.0;

/// A command before its limits.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Wish {
    pub(crate) command: Command,
    /// An emergency: the brake may jerk.
    pub(crate) urgent: bool,
}

/// Limits commands; remembers the last one.
#[derive(Clone, Debug)]
pub(crate) struct Shaper {
    last: Command,
}

impl Shaper {
    pub(crate) fn new() -> Self {
        Self {
            last: Command::default(),
        }
    }

    pub(crate) fn resume(&mut self, last: &Command) {
        if last.steering_angle.is_finite() && last.acceleration.is_finite() {
            self.last = Command {
                steering_angle: bound(last.steering_angle, MAX_STEERING_RAD),
                acceleration: clamp(last.acceleration, -MAX_BRAKING, MAX_ACCELERATION),
            };
        }
    }

    pub(crate) fn last(&self) -> Command {
        self.last
    }

    /// The command nearest to the wish within the limits, one period after the last command.
    pub(crate) fn shape(&mut self, wish: &Wish, ego: &Ego) -> Command {
        let Wish {
            command: wish,
            urgent,
        } = *wish;
        let speed = max(ego.speed, 3.0);
        let lateral_rate = LATERAL_JERK * WHEELBASE_M / (speed * speed);
        // The wheels of a standing vehicle are not turned: they would only follow noise.
        let rolling = clamp(ego.speed / ROLLING_SPEED, 0.02, 1.0);
        let turn = min(rolling * MAX_STEERING_RATE, lateral_rate) * PERIOD_S;
        let angle = bound(wish.steering_angle, MAX_STEERING_RAD);
        let angle = clamp(
            angle,
            self.last.steering_angle - turn,
            self.last.steering_angle + turn,
        );

        let mut wished = clamp(wish.acceleration, -MAX_BRAKING, MAX_ACCELERATION);
        if !urgent {
            wished = max(wished, self.soft_stop(-wished, ego.speed));
        }
        let firm = |is_hard| if is_hard { FIRM_JERK } else { COMFORT_JERK };
        let down = if urgent {
            EMERGENCY_JERK
        } else {
            firm(wished < HARD_BRAKING)
        };
        let up = firm(min(self.last.acceleration, wish.acceleration) < HARD_BRAKING);
        let acceleration = clamp(
            wished,
            self.last.acceleration - down * PERIOD_S,
            self.last.acceleration + up * PERIOD_S,
        );
        self.last = Command {
            steering_angle: angle,
            acceleration,
        };
        self.last
    }

    /// Returns the hardest braking from which the vehicle comes to a soft stop, m/s², negative, if
    /// the wish is this `braking`, m/s².
    fn soft_stop(&self, braking: f32, speed: f32) -> f32 {
        let jerk = if braking > -HARD_BRAKING {
            let needed = sqrt(braking * braking * braking / (24.0 * SOFT_STOP_M));
            max(SOFT_STOP_JERK, needed)
        } else {
            SOFT_STOP_JERK
        };
        let soon = max(
            speed + BRAKE_DELAY_S * min(self.last.acceleration, 0.0),
            0.0,
        );
        STANDSTILL_BRAKE - sqrt(2.0 * jerk * soon)
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;

    fn cruising() -> Ego {
        Ego {
            speed: 25.0,
            ..Ego::default()
        }
    }

    fn wish(steering_angle: f32, acceleration: f32) -> Wish {
        let command = Command {
            steering_angle,
            acceleration,
        };
        Wish {
            command,
            urgent: false,
        }
    }

    #[test]
    fn comfort_limits_the_rate_of_gentle_wishes() {
        let mut shaper = Shaper::new();
        let first = shaper.shape(&wish(0.1, -2.0), &cruising());
        assert!((first.acceleration + COMFORT_JERK * PERIOD_S).abs() < 1e-6);
        let lateral_jerk = first.steering_angle / PERIOD_S / WHEELBASE_M * 625.0;
        assert!((lateral_jerk - LATERAL_JERK).abs() < 0.1, "{lateral_jerk}");
    }

    #[test]
    fn an_emergency_brakes_at_once() {
        let mut shaper = Shaper::new();
        for _ in 0..21 {
            let wish = Wish {
                urgent: true,
                ..wish(0.0, -9.0)
            };
            shaper.shape(&wish, &cruising());
        }
        assert!(shaper.last().acceleration <= -9.0);
    }

    /// Brakes to standstill from this deceleration, with a brake that has a delay of 20 ms and a
    /// time constant of 0.12 s. Returns the largest jerk over 100 ms, m/s³, and the distance, m.
    fn stop(braking: f32, urgent: bool) -> (f32, f32) {
        let (mut shaper, mut speed, mut way) = (Shaper::new(), 6.0_f32, 0.0_f32);
        shaper.resume(&wish(0.0, -braking).command);
        let (mut commands, mut felt) = (std::vec![-braking; 20], std::vec![-braking; 100]);
        for ms in 0.. {
            if ms % 10 == 0 {
                let ego = Ego {
                    speed,
                    ..Ego::default()
                };
                let wish = Wish {
                    urgent,
                    ..wish(0.0, -braking)
                };
                shaper.shape(&wish, &ego);
            }
            commands.push(shaper.last().acceleration);
            let before = felt[felt.len() - 1];
            let acceleration = before + (commands[ms] - before) / 120.0;
            speed += 1e-3 * acceleration;
            if speed <= 0.0 {
                felt.extend([0.0; 100]);
                break;
            }
            way += 1e-3 * speed;
            felt.push(acceleration);
        }
        let jerks = felt
            .windows(101)
            .map(|span| 10.0 * (span[100] - span[0]).abs());
        (jerks.fold(0.0, f32::max), way)
    }

    /// The brake is released before standstill, which avoids the usual stopping jolt. In an
    /// emergency the stopping distance has priority.
    #[test]
    fn a_stop_ends_softly() {
        for (braking, longer_m) in [(1.5, 0.03), (2.5, 0.07), (4.0, 0.22), (7.0, 0.4)] {
            let (jerk, way) = stop(braking, false);
            assert!(jerk < 9.5, "{braking}: {jerk}");
            let shortest = 36.0 / (2.0 * braking);
            assert!(way < shortest + longer_m, "{braking}: {way}");
            assert!(stop(braking, true).0 > 9.9 * braking);
        }
    }

    /// Hard braking without an emergency does not jerk when it begins or ends.
    #[test]
    fn only_an_emergency_jerks() {
        let steepest = |urgent: bool| {
            let mut shaper = Shaper::new();
            let mut steepest = 0.0_f32;
            for step in 0..300 {
                let before = shaper.last().acceleration;
                let acceleration = if step < 150 { -7.0 } else { 0.0 };
                let wish = Wish {
                    urgent: urgent && step < 150,
                    ..wish(0.0, acceleration)
                };
                let now = shaper.shape(&wish, &cruising()).acceleration;
                steepest = steepest.max((now - before).abs() / PERIOD_S);
            }
            assert!(shaper.last().acceleration > -0.01);
            steepest
        };
        assert!(steepest(false) < 9.5, "{}", steepest(false));
        assert!(steepest(true) > 40.0, "{}", steepest(true));
    }

    /// T-RED-4: the command of a system that takes over begins where the failed one's ended.
    #[test]
    fn goes_on_from_another_systems_command() {
        let mut shaper = Shaper::new();
        shaper.resume(&Command {
            steering_angle: 0.02,
            acceleration: -1.5,
        });
        let next = shaper.shape(&Wish::default(), &cruising());
        assert!((next.acceleration + 1.5).abs() <= COMFORT_JERK * PERIOD_S + 1e-6);
        assert!((next.steering_angle - 0.02).abs() < 0.001);
    }

    #[test]
    fn refuses_to_go_on_from_what_is_no_number() {
        let mut shaper = Shaper::new();
        shaper.resume(&Command {
            steering_angle: f32::NAN,
            acceleration: 1.0,
        });
        assert_eq!(shaper.last(), Command::default());
    }
}
