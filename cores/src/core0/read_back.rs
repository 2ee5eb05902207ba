//! Reads back the command that the vehicle obeys: it must be one that this system has sent. T-RED-9
//!
//! The vehicle's echo contains the command that the vehicle obeys, and the counter of that
//! command's frame. A fault between the computation and the bus (a stuck signal with a valid
//! protection, for instance) shows here within a few control periods. An echo may be late: the
//! frames of the last 0.3 s are remembered, and echoes of older ones are not judged.
//!
//! If the steering angles differ, the measured angle says which one is wrong, the command or the
//! echo.

use super::agreement::{Deviation, LATERAL, LONGITUDINAL};
use super::frames;
use super::wheel::{Follows, Wheel};
use crate::driving::types::Command;
use tandem_bus::{Control, GateEcho};

/// Commands that are remembered, by the counter of their frames.
const REMEMBERED: usize = 32;
/// The command counts as wrong after this many successive wrong echoes.
const WRONG_ECHOES: u8 = 2;
/// The same if the measured steering angle can tell, but does not within this time: 60 ms.
const UNDECIDED_ECHOES: u8 = 6;
/// The measured angle cannot tell smaller differences from noise soon, rad. In the lane they have
/// an effect of some centimetres.
const DISTINCT: f32 = 2e-3;
/// Half a step of the signals plus the rounding error, rad and m/s².
const STEERING_STEP: f32 = 1.5e-5;
const ACCELERATION_STEP: f32 = 0.75e-3;
/// Limits for a stop with a wrong command, besides the tolerance that applies to two systems: error
/// of the wheel angle, rad, and the least share of the braking that was sent.
const ASIDE: f32 = 5e-3;
const LEAST_BRAKING: f32 = 0.5;

/// The commands that were sent, and the vehicle's echoes of them.
#[derive(Clone, Debug)]
pub(super) struct ReadBack {
    term: u32,
    /// Indexed by the counter of the frame.
    sent: [Command; REMEMBERED],
    /// How many of these commands are of this term, and the counter of the newest.
    count: u8,
    newest: u8,
    wrong: u8,
    refused: Option<u8>,
    /// Counter of the frame that is obeyed, according to the last echo.
    obeyed: u8,
    pub(super) wheel: Wheel,
    /// The echo was named wrong, and differs since.
    is_echo_wrong: bool,
}

impl ReadBack {
    pub(super) fn new() -> Self {
        Self {
            term: 0,
            sent: [Command {
                steering_angle: 0.0,
                acceleration: 0.0,
            }; REMEMBERED],
            count: 0,
            newest: 0,
            wrong: 0,
            refused: None,
            obeyed: 0,
            wheel: Wheel::default(),
            is_echo_wrong: false,
        }
    }

    /// Called before this frame is sent with this counter.
    pub(super) fn on_sent(&mut self, counter: u8, control: &Control) {
        if control.term != self.term {
            (self.term, self.count) = (control.term, 0);
            (self.wrong, self.refused) = (0, None);
        }
        self.sent[usize::from(counter) % REMEMBERED] = frames::command(control);
        self.count = (self.count + 1).min(REMEMBERED as u8);
        self.newest = counter;
    }

    /// Takes the vehicle's echo. `term`: the term in which this system drives. `has_standby`: a
    /// system is there that can drive instead. `stops_at`: the vehicle's speed, m/s, if this system
    /// stops the vehicle although the command is wrong. In that case, a difference does not count
    /// if the vehicle still stops in its lane.
    pub(super) fn on_echo(
        &mut self,
        term: u32,
        echo: &GateEcho,
        has_standby: bool,
        stops_at: Option<f32>,
    ) -> Verdict {
        // If the echo has a lower term, the vehicle has not yet accepted a frame of this term: it
        // has refused every frame sent.
        let in_term = echo.term == term;
        let obeyed = frames::obeyed(echo);
        let ago = self.newest.wrapping_sub(echo.obeyed_counter);
        let is_known = in_term && self.term == term && ago < self.count;
        let sent = match is_known {
            true => self.sent[usize::from(echo.obeyed_counter) % REMEMBERED],
            false => obeyed,
        };
        self.wheel
            .on_echo(sent.steering_angle, obeyed.steering_angle);
        if echo.term > term || self.term != term {
            (self.wrong, self.refused) = (0, None);
            return Verdict::Right;
        }
        let before = self.refused.replace(echo.refused);
        // A count that goes back was wrong before, and one wrong count must not count twice.
        let more = before.map_or(0, |count| echo.refused.wrapping_sub(count));
        let refuses = (1..128).contains(&more);
        let stops = stops_at.is_some_and(|speed| stops_with(&sent, &obeyed, speed));
        let aside = (sent.steering_angle - obeyed.steering_angle).abs();
        let brakes_alike = (sent.acceleration - obeyed.acceleration).abs() < ACCELERATION_STEP;
        let by_angle = if aside < STEERING_STEP || stops {
            Steering::Obeyed
        } else {
            self.steering(aside, has_standby)
        };
        let is_echo_wrong = by_angle == Steering::EchoWrong;
        let is_new = is_echo_wrong && !self.is_echo_wrong;
        self.is_echo_wrong = is_echo_wrong || self.is_echo_wrong && aside >= STEERING_STEP;
        let (differs, limit) = match by_angle {
            Steering::Disobeyed => (true, WRONG_ECHOES),
            Steering::Unknown => (true, UNDECIDED_ECHOES),
            Steering::Obeyed | Steering::EchoWrong => (false, WRONG_ECHOES),
        };
        let otherwise = !brakes_alike && !stops;
        let limit = if otherwise || refuses {
            WRONG_ECHOES
        } else {
            limit
        };
        let before = core::mem::replace(&mut self.obeyed, echo.obeyed_counter);
        if differs || otherwise || refuses {
            self.wrong += 1;
        } else if before != echo.obeyed_counter {
            // Further echoes of the same frame give no new information.
            self.wrong = 0;
        }
        if self.wrong >= limit {
            self.wrong = 0;
            return Verdict::Wrong;
        }
        if is_new {
            Verdict::EchoWrong
        } else {
            Verdict::Right
        }
    }

    /// Judges an angle in the echo that differs from the sent one by `aside`, rad.
    fn steering(&self, aside: f32, has_standby: bool) -> Steering {
        match self.wheel.follows() {
            Follows::Sent => Steering::EchoWrong,
            Follows::Echo => Steering::Disobeyed,
            Follows::Unknown if aside >= DISTINCT => Steering::Unknown,
            // Two systems must not leave in turn for an echo that is a little wrong.
            Follows::Unknown if !has_standby => Steering::Obeyed,
            Follows::Unknown => Steering::Disobeyed,
        }
    }
}

/// What an echo says of this system's command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    /// The vehicle obeys it, as far as is known.
    Right,
    /// The vehicle does not obey it.
    Wrong,
    /// The vehicle obeys it, though its echo says otherwise; returned once.
    EchoWrong,
}

/// What an echo says of the steering angle.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Steering {
    Obeyed,
    Disobeyed,
    EchoWrong,
    Unknown,
}

/// Returns whether the vehicle, at this speed in m/s, still stops in its lane although it obeys a
/// command other than the one sent.
fn stops_with(sent: &Command, obeyed: &Command, speed: f32) -> bool {
    let deviation = Deviation::of(sent, obeyed, speed);
    let in_lane = (sent.steering_angle - obeyed.steering_angle).abs() <= ASIDE
        && deviation.lateral.abs() <= LATERAL.tolerance;
    let brakes = sent.acceleration < 0.0
        && obeyed.acceleration <= LEAST_BRAKING * sent.acceleration
        && deviation.longitudinal <= LONGITUDINAL.tolerance;
    in_lane && brakes
}

#[cfg(test)]
mod tests {
    use super::*;

    const TERM: u32 = 16;

    fn control(cycle: u32) -> Control {
        Control {
            term: TERM,
            steering_angle: cycle as f32 * 1e-3,
            acceleration: -1.0,
            ..Control::default()
        }
    }

    /// Returns the echo of the frame of this cycle.
    fn echo(cycle: u32) -> GateEcho {
        let control = control(cycle);
        GateEcho {
            refused: 0,
            term: control.term,
            term_age: 1.0,
            obeyed_counter: cycle as u8,
            sent_at: 0,
            // Rounded like the signal on the bus.
            steering_angle: libm::roundf(control.steering_angle / 2e-5) * 2e-5,
            acceleration: control.acceleration,
        }
    }

    /// Sends 400 frames; `obeyed` makes the echo of each. Returns the first cycle that is found
    /// wrong.
    fn found(obeyed: impl Fn(u32, GateEcho) -> GateEcho) -> Option<u32> {
        found_at(None, obeyed)
    }

    fn found_at(stops_at: Option<f32>, obeyed: impl Fn(u32, GateEcho) -> GateEcho) -> Option<u32> {
        let mut read_back = ReadBack::new();
        (0..400).find(|cycle| {
            read_back.on_sent(*cycle as u8, &control(*cycle));
            let echo = obeyed(*cycle, echo(*cycle));
            read_back.on_echo(TERM, &echo, true, stops_at) == Verdict::Wrong
        })
    }

    /// T-RED-9: a command that the vehicle obeys unchanged is right, even if the echo is late. A
    /// command that it obeys differently, or keeps refusing, is wrong. Commands of the other system
    /// are not judged.
    #[test]
    fn a_command_that_is_obeyed_otherwise_is_wrong() {
        assert_eq!(found(|_, echo| echo), None);
        for late in [5, 31, 32, 100] {
            let late = |cycle: u32, _| echo(cycle.saturating_sub(late));
            assert_eq!(found(late), None);
        }
        let stuck = |_, it| GateEcho {
            steering_angle: 0.5,
            ..it
        };
        // No measured angle says which of both is wrong.
        assert_eq!(found(stuck), Some(5));
        let brakes = |cycle, it| match cycle {
            10 | 20.. => GateEcho {
                acceleration: -1.002,
                ..it
            },
            _ => it,
        };
        assert_eq!(found(brakes), Some(21));
        let refused = |cycle: u32, it| GateEcho {
            refused: cycle.saturating_sub(10) as u8,
            ..it
        };
        assert_eq!(found(refused), Some(12));
        // One forged count of refusals is not two refusals.
        for forged in [1, 9, 200, 255] {
            let once = |cycle, it| GateEcho {
                refused: if cycle == 10 { forged } else { 0 },
                ..it
            };
            assert_eq!(found(once), None, "{forged}");
        }
        // A system stops the vehicle with -1 m/s² because no reset repaired the command.
        let differs = |aside: f32, more: f32| {
            move |_, it: GateEcho| GateEcho {
                steering_angle: it.steering_angle + aside,
                acceleration: it.acceleration + more,
                ..it
            }
        };
        for (aside, more, stops_at, at) in [
            (0.001, -0.5, None, Some(1)),
            (0.001, -0.5, Some(25.0), None),
            (0.001, -0.5, Some(40.0), Some(1)),
            (0.004, 0.0, Some(10.0), None),
            (-0.004, 0.0, Some(20.0), Some(5)),
            // Nearly standing, or the speed is not known.
            (0.1, 0.0, Some(0.0), Some(5)),
            (0.0, 0.45, Some(25.0), None),
            (0.0, 0.55, Some(25.0), Some(1)),
            (0.0, -1.6, Some(25.0), Some(1)),
        ] {
            let found = found_at(stops_at, differs(aside, more));
            assert_eq!(found, at, "{aside} {more} {stops_at:?}");
        }
        assert_eq!(found_at(Some(5.0), refused), Some(12));
        let others = |_, it| GateEcho {
            steering_angle: 0.5,
            term: TERM + 1,
            ..it
        };
        assert_eq!(found(others), None);
    }

    /// Drives 2 s with a wheel that turns as the actuators do; `obeyed` and `echoed` alter the sent
    /// angle from 1 s on. Returns the cycles from then to the first verdict of each kind.
    fn judged(
        has_standby: bool,
        obeyed: impl Fn(f32) -> f32,
        echoed: impl Fn(f32) -> f32,
    ) -> [Option<u32>; 2] {
        let mut read_back = ReadBack::new();
        let (mut wheel, mut delayed, mut found) = (0.0_f32, 0.0, [None; 2]);
        for cycle in 0..200_u32 {
            // Turns at up to 0.06 rad/s; the sensor has noise and an offset.
            let sent = 0.02 * (cycle as f32 * 0.03).sin();
            let control = Control {
                term: TERM,
                steering_angle: sent,
                ..Control::default()
            };
            read_back.on_sent(cycle as u8, &control);
            let of = |alter: &dyn Fn(f32) -> f32| if cycle < 100 { sent } else { alter(sent) };
            let echo = GateEcho {
                steering_angle: of(&echoed),
                acceleration: 0.0,
                ..echo(cycle)
            };
            let verdict = read_back.on_echo(TERM, &echo, has_standby, None);
            for (place, kind) in [(0, Verdict::Wrong), (1, Verdict::EchoWrong)] {
                if verdict == kind && found[place].is_none() {
                    found[place] = Some(cycle.saturating_sub(100));
                }
            }
            wheel += 0.181 * (delayed - wheel);
            delayed = of(&obeyed);
            let noise = 4e-4 * (cycle as f32 * 2.3).sin() + 2e-4;
            read_back.wheel.on_measured(wheel + noise);
        }
        found
    }

    /// T-RED-9: the measured angle names the wrong one of command and echo within 60 ms. A
    /// difference that it cannot see soon makes a system leave only beside a standby.
    #[test]
    fn the_measured_angle_decides_between_command_and_echo() {
        let same = |angle: f32| angle;
        assert_eq!(judged(true, same, same), [None; 2]);
        for by in [0.004, -0.01, 0.3] {
            let aside = |angle: f32| angle + by;
            let [wrong, of_echo] = judged(true, aside, aside);
            assert!(wrong.is_some_and(|cycles| cycles <= 6), "{by}: {wrong:?}");
            assert_eq!(of_echo, None, "{by}");
            for has_standby in [true, false] {
                let [wrong, of_echo] = judged(has_standby, same, aside);
                assert_eq!(wrong, None, "{by}");
                assert!(
                    of_echo.is_some_and(|cycles| cycles <= 5),
                    "{by}: {of_echo:?}"
                );
            }
        }
        let little = |angle: f32| angle + 5e-4;
        assert_eq!(judged(true, same, little), [Some(1), None]);
        assert_eq!(judged(false, same, little), [None, None]);
    }
}
