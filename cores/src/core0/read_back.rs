//! Reads back the command that the vehicle obeys: it must be one that this system has sent. T-RED-9
//!
//! The vehicle's echo contains the command that the vehicle obeys, and the counter of that
//! command's frame. A fault between the computation and the bus (a stuck signal with a valid
//! protection, for instance) shows here within a few control periods. An echo may be late: the
//! frames of the last 0.3 s are remembered, and echoes of older ones are not judged.
//!
//! If the steering angles differ, the measured angle says which one is wrong, the command or the
//! echo.

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
/// A command of less than this tells nothing of its sign, m/s².
const DISTINCT_BRAKING: f32 = 0.5;
/// Half a step of the signals plus the rounding error, rad and m/s².
const STEERING_STEP: f32 = 1.5e-5;
const ACCELERATION_STEP: f32 = 0.75e-3;
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
    correction: Correction,
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
            correction: Correction::default(),
        }
    }

    /// Returns the command to send so that the vehicle obeys `wanted`, as far as the last echoes
    /// show how it differs. For a system that is alone and that no reset cures.
    pub(super) fn corrected(&mut self, wanted: Command) -> Command {
        self.correction.apply(wanted)
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
    /// system is there that can drive instead. `stops`: this system stops the vehicle because no
    /// reset cured its command. The echo then only corrects the command: silence would not stop the
    /// vehicle in its lane either.
    pub(super) fn on_echo(
        &mut self,
        term: u32,
        echo: &GateEcho,
        has_standby: bool,
        stops: bool,
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
        if is_known && self.obeyed != echo.obeyed_counter {
            self.correction.on_echo(&sent, &obeyed);
        }
        if stops || echo.term > term || self.term != term {
            (self.wrong, self.refused, self.obeyed) = (0, None, echo.obeyed_counter);
            return Verdict::Right;
        }
        let before = self.refused.replace(echo.refused);
        // A count that goes back was wrong before, and one wrong count must not count twice.
        let more = before.map_or(0, |count| echo.refused.wrapping_sub(count));
        let refuses = (1..128).contains(&more);
        let aside = (sent.steering_angle - obeyed.steering_angle).abs();
        let brakes_alike = (sent.acceleration - obeyed.acceleration).abs() < ACCELERATION_STEP;
        let by_angle = if aside < STEERING_STEP {
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
        let otherwise = !brakes_alike;
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

/// The difference between a command and what the vehicle obeys, learned from the echoes: a sign and
/// an offset for each actuator. A factor is an offset that follows the command.
#[derive(Clone, Debug, Default)]
struct Correction {
    steering: Axis,
    acceleration: Axis,
    /// The steering angle that was wanted last, rad.
    wanted: f32,
    /// Echoes whose steering angle is far from it, less those whose angle is near.
    astray: u8,
    /// Braking because the vehicle cannot be steered, m/s².
    braking: f32,
}

/// The vehicle cannot be steered if its angle is this far from the wanted one, rad, …
const ASTRAY: f32 = 5e-3;
/// … in this many more echoes than not: 0.3 s at least. A late angle swings through the right one.
const ASTRAY_ECHOES: u8 = 30;
/// Then it brakes hard, m/s²: the sooner it stands, the less it leaves its lane.
const ASTRAY_BRAKING: f32 = 7.0;
/// Change of this braking in a cycle, m/s².
const ASTRAY_STEP: f32 = 0.4;

/// One actuator.
#[derive(Clone, Copy, Debug, Default)]
struct Axis {
    /// The vehicle obeys the command with the other sign.
    is_turned: bool,
    /// Echoes in succession that show the other sign than assumed.
    turned: u8,
    /// How often the sign seemed to turn.
    turns: u8,
    /// The least and the greatest that was obeyed beyond what was sent.
    beyond: Option<(f32, f32)>,
    /// No sign and offset explain what is obeyed: correcting it makes it worse.
    is_late: bool,
    offset: f32,
    applied: f32,
}

/// Echoes in succession that show a turned sign.
const TURNED_ECHOES: u8 = 3;

impl Axis {
    fn on_echo(&mut self, sent: f32, obeyed: f32, least: f32) {
        // A value that is obeyed with the other sign is nearer to its opposite.
        let seems_turned = (obeyed + sent).abs() < (obeyed - sent).abs();
        if sent.abs() > least {
            self.turned = match seems_turned == self.is_turned || self.is_late {
                true => 0,
                false => self.turned.saturating_add(1),
            };
        }
        if self.turned >= TURNED_ECHOES {
            self.turns = self.turns.saturating_add(1);
            (self.is_turned, self.turned, self.applied) = (seems_turned, 0, 0.0);
        }
        let by = obeyed - sent;
        let (low, high) = self.beyond.unwrap_or((by, by));
        let (low, high) = (low.min(by), high.max(by));
        self.beyond = Some((low, high));
        // A turned sign turns once, and an offset beyond what is sent stays equal.
        if self.turns > 1 && high - low > least {
            (self.is_late, self.is_turned) = (true, false);
        }
        self.offset = obeyed - self.signed(sent);
    }

    fn signed(&self, value: f32) -> f32 {
        if self.is_turned { -value } else { value }
    }

    /// `step`: the most by which the correction changes in a cycle, so that no command jumps.
    fn apply(&mut self, wanted: f32, step: f32, most: f32) -> f32 {
        let due = if self.offset.is_finite() && !self.is_late {
            self.offset
        } else {
            0.0
        };
        self.applied += (due - self.applied).clamp(-step, step);
        self.applied = self.applied.clamp(-most, most);
        self.signed(wanted - self.applied)
    }
}

impl Correction {
    fn on_echo(&mut self, sent: &Command, obeyed: &Command) {
        let least = DISTINCT;
        let is_astray = (obeyed.steering_angle - self.wanted).abs() > ASTRAY;
        self.astray = if is_astray {
            self.astray.saturating_add(1)
        } else {
            self.astray.saturating_sub(1)
        };
        self.steering
            .on_echo(sent.steering_angle, obeyed.steering_angle, least);
        self.acceleration
            .on_echo(sent.acceleration, obeyed.acceleration, DISTINCT_BRAKING);
    }

    fn apply(&mut self, wanted: Command) -> Command {
        self.wanted = wanted.steering_angle;
        if self.astray >= ASTRAY_ECHOES || self.steering.is_late {
            self.braking = (self.braking + ASTRAY_STEP).min(ASTRAY_BRAKING);
        }
        let acceleration = wanted.acceleration.min(-self.braking);
        Command {
            steering_angle: self.steering.apply(wanted.steering_angle, 1e-3, 0.1),
            acceleration: self.acceleration.apply(acceleration, 0.3, 6.0),
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
        found_at(false, obeyed)
    }

    fn found_at(stops: bool, obeyed: impl Fn(u32, GateEcho) -> GateEcho) -> Option<u32> {
        let mut read_back = ReadBack::new();
        (0..400).find(|cycle| {
            read_back.on_sent(*cycle as u8, &control(*cycle));
            let echo = obeyed(*cycle, echo(*cycle));
            read_back.on_echo(TERM, &echo, true, stops) == Verdict::Wrong
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
        // A system that stops the vehicle because no reset cured its command is not silent.
        assert_eq!(found_at(true, refused), None);
        assert_eq!(found_at(true, stuck), None);
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
            let verdict = read_back.on_echo(TERM, &echo, has_standby, false);
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

    /// T-RED-9: no reset cures a wrong output. The command is corrected by the echoes until the
    /// vehicle obeys what is wanted: with an offset, a drift, a factor, and a turned sign.
    #[test]
    fn a_wrong_output_is_corrected_by_the_echoes() {
        type Output = fn(f32, u32) -> f32;
        let outputs: [(&str, Output); 5] = [
            ("right", |sent, _| sent),
            ("offset", |sent, _| sent + 0.01),
            ("drift", |sent, cycle| sent + 2e-5 * cycle as f32),
            ("factor", |sent, _| 0.4 * sent),
            ("sign", |sent, _| -sent),
        ];
        for (name, output) in outputs {
            let mut read_back = ReadBack::new();
            let mut last = (0.0_f32, 0.0_f32);
            for cycle in 0..400_u32 {
                let wanted = Command {
                    steering_angle: 0.02 + 0.01 * (cycle as f32 * 0.02).sin(),
                    acceleration: -2.5,
                };
                let sent = read_back.corrected(wanted);
                let control = Control {
                    term: TERM,
                    steering_angle: sent.steering_angle,
                    acceleration: sent.acceleration,
                    ..Control::default()
                };
                read_back.on_sent(cycle as u8, &control);
                let echo = GateEcho {
                    term: TERM,
                    steering_angle: output(sent.steering_angle, cycle),
                    acceleration: output(sent.acceleration, cycle),
                    obeyed_counter: cycle as u8,
                    ..GateEcho::default()
                };
                let verdict = read_back.on_echo(TERM, &echo, false, true);
                assert_eq!(verdict, Verdict::Right);
                last = (
                    echo.steering_angle - wanted.steering_angle,
                    echo.acceleration - wanted.acceleration,
                );
            }
            assert!(last.0.abs() < 1e-3, "{name}: {last:?}");
            assert!(last.1.abs() < 0.05, "{name}: {last:?}");
        }
    }

    /// Returns the wanted and the given command after 4 s, if the vehicle obeys each angle `cycles`
    /// later, and the angle grows by `drift` (rad) in each cycle.
    fn late_by(cycles: u32, drift: f32) -> (Command, Command) {
        let mut read_back = ReadBack::new();
        let mut sent = [Command::default(); 400];
        let mut last = (Command::default(), Command::default());
        for cycle in 0..400_u32 {
            let wanted = Command {
                steering_angle: 0.02 * (cycle as f32 * 0.05).sin(),
                acceleration: -2.5,
            };
            let command = read_back.corrected(wanted);
            sent[cycle as usize] = command;
            let control = Control {
                term: TERM,
                steering_angle: command.steering_angle,
                acceleration: command.acceleration,
                ..Control::default()
            };
            read_back.on_sent(cycle as u8, &control);
            let obeyed = sent[cycle.saturating_sub(cycles) as usize].steering_angle;
            let echo = GateEcho {
                term: TERM,
                steering_angle: obeyed + drift * cycle as f32,
                acceleration: command.acceleration,
                obeyed_counter: cycle as u8,
                ..GateEcho::default()
            };
            let _verdict = read_back.on_echo(TERM, &echo, false, true);
            last = (wanted, command);
        }
        last
    }

    /// T-RED-9: an angle that is late seems to turn its sign again and again. It is not corrected,
    /// and the vehicle brakes hard. One that is obeyed at once or drifts is no late one.
    #[test]
    fn a_late_output_is_not_corrected_but_braked() {
        for cycles in [30, 50, 80] {
            let (wanted, command) = late_by(cycles, 0.0);
            let braked = Command {
                acceleration: -ASTRAY_BRAKING,
                ..wanted
            };
            assert_eq!(command, braked, "{cycles}");
        }
        for (cycles, drift) in [(0, 0.0), (1, 0.0), (0, 1e-5), (0, -1e-5)] {
            let (wanted, command) = late_by(cycles, drift);
            assert_eq!(
                command.acceleration, wanted.acceleration,
                "{cycles} {drift}"
            );
            let obeyed = command.steering_angle + drift * 400.0;
            assert!(
                (obeyed - wanted.steering_angle).abs() < 5e-3,
                "{cycles} {drift}"
            );
        }
    }
}
