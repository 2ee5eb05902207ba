//! Decides, in the vehicle, which control frames act: those that are valid, from a master, of the
//! highest term, fresh and plausible.
//!
//! The term is a fencing token: a frame with a lower term than one seen before never acts, even if
//! its sender is still a master. The caller receives and records a ruling on every control frame,
//! so that the record shows whether there were "two masters" or "no master".
//!
//! | frame | ruling | acts |
//! |---|---|---|
//! | protection, length, value, or the term's lowest bit (the system) wrong | `Invalid` | no |
//! | role other than master | `NotMaster` | no |
//! | term near the end of all terms | `Invalid` | no |
//! | term lower than the highest seen | `Fenced` | no |
//! | term far above the highest, unless no other acts and its frames repeat | `Unexplained` | no |
//! | was on its way for too long, or rests on data that are too old | `Stale` | no |
//! | requests more than the vehicle can do, or changes too fast | `Implausible` | no |
//! | else | `Accepted` | yes; its term is now the highest |
//!
//! Each frame carries the time at which it was made, on the vehicle's clock: its sender learns this
//! time from the echoes. So the age of a frame is known in absolute terms. A frame that was held up
//! is old, whatever held it up, and even if it is valid otherwise. A frame without a time is not
//! checked: its sender has not heard the vehicle yet.
//!
//! A frame for gear and parking brake acts only in the term of the last accepted control frame, and
//! only while its sender is heard.

use tandem_bus::e2e::{Check, Checker};
use tandem_bus::{BodyControl, Control, GateEcho, Message, ModeCode, RoleCode};

use crate::mastership::Mastership;

/// After this silence a sender may start with any counter, ns: it was down, so missing frames are
/// not a fault.
const COUNTER_FORGOTTEN_NS: u64 = 150_000_000;

/// The next control frame is overdue this long after the last, ns: a standby's shortest limit.
const OVERDUE_NS: u64 = 11_000_000;
/// After this silence no system waits for an early echo, and no frame for gear and brake acts, ns.
const OVERDUE_ENDS_NS: u64 = 100_000_000;

/// A term whose count exceeds that of the highest one by no more than this is explained by the
/// rules of the systems: they believe half of this without a second witness, and raise it by 1, 8
/// or 1,024.
pub const EXPLAINED: u32 = 4_096;
/// The highest term. A number near the end, for instance with all bits set, is not a term, so no
/// single frame uses the terms up.
pub const LAST_TERM: u32 = u32::MAX - 2 * (1 << 13);
/// The highest term that is believed without an explanation.
pub const LAST_UNEXPLAINED_TERM: u32 = u32::MAX - 2 * (1 << 21);
/// A far term acts after this many frames of it in a row, if no frame has acted for this time, ns.
const UNEXPLAINED_FRAMES: u8 = 5;
const UNEXPLAINED_SILENCE_NS: u64 = 100_000_000;

/// The greatest age of the data that a command uses, ms. The functions stop using data before this
/// age; this limit catches a function that does not. A safe stop uses no data, and neither does a
/// frame of a function that does not drive.
const COMMAND_MAX_AGE_MS: f32 = 2_000.0;

/// The limits of the actuators: rad, m/s².
const MAX_STEERING: f32 = 0.61;
const MAX_BRAKING: f32 = 10.0;
const MAX_ACCELERATION: f32 = 4.0;
/// How fast a command may change: about twice as fast as the controllers change it, plus a step.
/// rad/s and rad; m/s³ and m/s² of lateral acceleration; m/s³ and m/s².
const STEERING_RATE: (f32, f32) = (0.8, 0.002);
const LATERAL_JERK: (f32, f32) = (30.0, 0.5);
const LONGITUDINAL_JERK: (f32, f32) = (100.0, 0.5);
/// Axle to axle, m.
const WHEELBASE: f32 = 2.578_9;

/// The ruling on a control frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ruling {
    /// It acts.
    Accepted,
    /// Its term is lower than one seen before.
    Fenced,
    /// Its sender does not claim to be master.
    NotMaster,
    /// It is damaged, repeated, out of sequence, or contradicts itself.
    Invalid,
    /// It was made too long ago, or the data behind it are too old.
    Stale,
    /// It demands more than a vehicle can do, or it jumps.
    Implausible,
    /// Its term is so far above the highest that the rules of the systems do not explain it.
    Unexplained,
}

/// The ruling on a control frame, and its time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Acceptance {
    /// When the frame arrived, ns, on the caller's clock.
    pub at_ns: u64,
    /// 0 = A, 1 = B, by the frame's id.
    pub system: u8,
    /// The frame's term; 0 if it is invalid.
    pub term: u32,
    /// The ruling on it.
    pub ruling: Ruling,
}

/// Counts of control frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameCounts {
    /// Frames that acted.
    pub accepted: u64,
    /// Frames of a lower term.
    pub fenced: u64,
    /// Frames of a sender that is not master.
    pub not_master: u64,
    /// Frames that were damaged, repeated or out of sequence.
    pub invalid: u64,
    /// Frames that were too old.
    pub stale: u64,
    /// Frames beyond the limits of range and rate.
    pub implausible: u64,
    /// Frames of a term that no rule explains.
    pub unexplained: u64,
}

/// The frames of one id, as the gate has received them.
#[derive(Debug)]
struct Received {
    checker: Checker,
    last_ns: Option<u64>,
}

impl Received {
    const fn new(id: u16) -> Self {
        Self {
            checker: Checker::new(id),
            last_ns: None,
        }
    }

    /// Checks the protection of the next frame.
    fn check(&mut self, now_ns: u64, data: &[u8]) -> Check {
        let check = self.checker.check(data);
        if check == Check::CrcError {
            return check;
        }
        let last_ns = self.last_ns.replace(now_ns);
        let silence = last_ns.map(|last| now_ns.saturating_sub(last));
        if silence.is_some_and(|silence| silence > COUNTER_FORGOTTEN_NS) {
            return Check::Initial;
        }
        check
    }
}

/// Judges control frames.
#[derive(Debug)]
pub struct Gate {
    controls: [Received; 2],
    bodies: [Received; 2],
    highest_term: u32,
    accepted: Option<Acceptance>,
    /// Demand of the last accepted frame: steering angle and acceleration.
    obeyed: (f32, f32),
    /// m/s
    speed: f32,
    obeyed_counter: u8,
    refused: u8,
    /// The last far term, and the number of its frames since one acted.
    far: (u32, u8),
    counts: FrameCounts,
    mastership: Mastership,
}

/// Returns the time on the vehicle's clock as frames carry it.
const fn ms(now_ns: u64) -> u16 {
    (now_ns / 1_000_000) as u16
}

/// A control frame that was judged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Judged {
    /// The ruling on it.
    pub acceptance: Acceptance,
    /// Its command, if it acts.
    pub command: Option<Control>,
}

impl Gate {
    /// Creates a gate that has received no frame.
    #[must_use]
    pub fn new() -> Self {
        Self {
            controls: Control::IDS.map(Received::new),
            bodies: BodyControl::IDS.map(Received::new),
            highest_term: 0,
            accepted: None,
            obeyed: (0.0, 0.0),
            speed: 0.0,
            obeyed_counter: 0,
            refused: 0,
            far: (0, 0),
            counts: FrameCounts::default(),
            mastership: Mastership::default(),
        }
    }

    /// Judges a frame that arrives at `now_ns` on the caller's clock; `None` if it is not a control
    /// frame.
    pub fn on_frame(&mut self, now_ns: u64, id: u32, data: &[u8]) -> Option<Judged> {
        let system = Control::IDS
            .iter()
            .position(|known| u32::from(*known) == id)?;
        let (ruling, control) = self.judge(now_ns, system, data);
        let term = control.map_or(0, |control| control.term);
        let acceptance = Acceptance {
            at_ns: now_ns,
            system: system as u8,
            term,
            ruling,
        };
        match ruling {
            Ruling::Accepted => {
                if let Some(Control {
                    steering_angle,
                    acceleration,
                    ..
                }) = control
                {
                    self.obeyed = (steering_angle, acceleration);
                    self.obeyed_counter = data[2];
                }
                self.accept(acceptance);
            }
            Ruling::Fenced => self.counts.fenced += 1,
            Ruling::NotMaster => self.counts.not_master += 1,
            Ruling::Invalid => self.counts.invalid += 1,
            Ruling::Stale => self.counts.stale += 1,
            Ruling::Implausible => {
                self.counts.implausible += 1;
                self.refused = self.refused.wrapping_add(1);
            }
            // A sound master does not leave because of another system's term.
            Ruling::Unexplained => self.counts.unexplained += 1,
        }
        Some(Judged {
            acceptance,
            command: control.filter(|_| ruling == Ruling::Accepted),
        })
    }

    /// Judges a frame for gear and parking brake; returns it if it acts. It acts only in the term
    /// of the last accepted control frame, so the same system is obeyed in both. D-3
    pub fn on_body(&mut self, now_ns: u64, id: u32, data: &[u8]) -> Option<BodyControl> {
        let mut ids = BodyControl::IDS.iter();
        let system = ids.position(|known| u32::from(*known) == id)?;
        let check = self.bodies[system].check(now_ns, data);
        let Ok(Message::BodyControl { body_control, .. }) = Message::decode(id, data) else {
            return None;
        };
        let is_of_system = body_control.term & 1 == system as u32;
        let is_heard = |last: Acceptance| now_ns.saturating_sub(last.at_ns) < OVERDUE_ENDS_NS;
        let is_obeyed =
            self.accepted.is_some_and(is_heard) && body_control.term == self.highest_term;
        (check.is_accepted() && is_of_system && is_obeyed).then_some(body_control)
    }

    fn judge(&mut self, now_ns: u64, system: usize, data: &[u8]) -> (Ruling, Option<Control>) {
        let check = self.controls[system].check(now_ns, data);
        let message = Message::decode(u32::from(Control::IDS[system]), data);
        let Ok(Message::Control { control, .. }) = message else {
            return (Ruling::Invalid, None);
        };
        if !check.is_accepted() || control.term & 1 != system as u32 {
            return (Ruling::Invalid, None);
        }
        if control.role != RoleCode::Master {
            return (Ruling::NotMaster, Some(control));
        }
        if control.term < self.highest_term {
            return (Ruling::Fenced, Some(control));
        }
        if let Some(refusal) = self.refuses_term(now_ns, control.term) {
            return (refusal, Some(control));
        }
        if !control.is_fresh(ms(now_ns)) {
            self.refused = self.refused.wrapping_add(1);
            return (Ruling::Stale, Some(control));
        }
        let rests_on_data = !matches!(control.mode, ModeCode::None | ModeCode::SafeStop);
        if rests_on_data && control.command_age > COMMAND_MAX_AGE_MS {
            return (Ruling::Stale, Some(control));
        }
        if !self.is_plausible(now_ns, &control) {
            return (Ruling::Implausible, Some(control));
        }
        (Ruling::Accepted, Some(control))
    }

    /// Judges a term that is not below the highest one; returns `None` if it may act.
    fn refuses_term(&mut self, now_ns: u64, term: u32) -> Option<Ruling> {
        let is_first = self.accepted.is_none();
        let is_believed = term <= LAST_UNEXPLAINED_TERM;
        let distance = (term >> 1) - (self.highest_term >> 1);
        if term <= LAST_TERM && (distance <= EXPLAINED || is_first && is_believed) {
            return None;
        }
        if term > LAST_TERM || !is_first && !is_believed {
            return Some(Ruling::Invalid);
        }
        let count = if self.far.0 == term { self.far.1 } else { 0 };
        self.far = (term, count.saturating_add(1));
        let is_silent = self
            .accepted
            .is_none_or(|last| now_ns.saturating_sub(last.at_ns) >= UNEXPLAINED_SILENCE_NS);
        let acts = is_silent && self.far.1 >= UNEXPLAINED_FRAMES;
        (!acts).then_some(Ruling::Unexplained)
    }

    /// Tests the command's range, and its rate of change since the last command that was obeyed.
    fn is_plausible(&self, now_ns: u64, control: &Control) -> bool {
        let (angle, acceleration) = (control.steering_angle, control.acceleration);
        if angle.abs() > MAX_STEERING || !(-MAX_BRAKING..=MAX_ACCELERATION).contains(&acceleration)
        {
            return false;
        }
        let Some(last) = self.accepted else {
            return true;
        };
        let dt = now_ns.saturating_sub(last.at_ns) as f32 * 1e-9;
        let within = |change: f32, (rate, step): (f32, f32)| change.abs() <= rate * dt + step;
        let turn = angle - self.obeyed.0;
        within(turn, STEERING_RATE)
            && within(turn * self.speed * self.speed / WHEELBASE, LATERAL_JERK)
            && within(acceleration - self.obeyed.1, LONGITUDINAL_JERK)
    }

    fn accept(&mut self, entry: Acceptance) {
        self.counts.accepted += 1;
        self.far = (0, 0);
        self.highest_term = entry.term;
        self.mastership
            .accept(entry.at_ns, entry.system, entry.term);
        self.accepted = Some(entry);
    }

    /// Returns the last frame that acted.
    #[must_use]
    pub fn accepted(&self) -> Option<Acceptance> {
        self.accepted
    }

    /// Sets the vehicle's speed, m/s: at a higher speed the wheels may turn less. Initially 0.
    pub fn set_speed(&mut self, speed: f64) {
        self.speed = speed as f32;
    }

    /// Returns the echo to both systems, to be sent at `now_ns`: the term that the vehicle obeys,
    /// the age of its last frame, and the command.
    pub fn echo(&self, now_ns: u64) -> GateEcho {
        let sent_at = ms(now_ns);
        let none = GateEcho {
            sent_at,
            ..GateEcho::default()
        };
        self.accepted.map_or(none, |last| GateEcho {
            sent_at,
            term: last.term,
            term_age: now_ns.saturating_sub(last.at_ns) as f32 * 1e-6,
            steering_angle: self.obeyed.0,
            acceleration: self.obeyed.1,
            refused: self.refused,
            obeyed_counter: self.obeyed_counter,
        })
    }

    /// Tests whether a control frame is overdue. While it is, an echo follows each millisecond, so
    /// that the standby need not wait for the next periodic one. Each takes about 0.15 ms of a bus
    /// of 500 kbit/s and 2 Mbit/s: 15 % of its time, while the master's frames are missing.
    #[must_use]
    pub fn is_overdue(&self, now_ns: u64) -> bool {
        let silence = |last: Acceptance| now_ns.saturating_sub(last.at_ns);
        let overdue = OVERDUE_NS..OVERDUE_ENDS_NS;
        self.accepted
            .is_some_and(|last| overdue.contains(&silence(last)))
    }

    /// Returns the counts of the rulings so far.
    #[must_use]
    pub fn counts(&self) -> FrameCounts {
        self.counts
    }

    /// Returns the gaps, the changes and the time with two masters, from the frames that acted.
    #[must_use]
    pub const fn mastership(&self) -> &Mastership {
        &self.mastership
    }
}

impl Default for Gate {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_bus::FrameTransmitter;

    const MS: u64 = 1_000_000;

    struct Sender(FrameTransmitter);

    impl Sender {
        fn frame(&mut self, system: u8, term: u32, role: RoleCode) -> (u32, Vec<u8>) {
            let control = Control {
                role,
                term,
                ..Control::default()
            };
            let frame = self.0.encode(&Message::Control { system, control });
            (u32::from(frame.id), frame.data().to_vec())
        }
    }

    /// Sends master frames of (time in ms, system, term) and returns the rulings.
    fn verdicts(gate: &mut Gate, frames: &[(u64, u8, u32)]) -> Vec<Ruling> {
        let mut sender = Sender(FrameTransmitter::new());
        let judged = frames.iter().map(|(at, system, term)| {
            let (id, data) = sender.frame(*system, *term, RoleCode::Master);
            gate.on_frame(at * MS, id, &data)
        });
        judged.map(|it| it.unwrap().acceptance.ruling).collect()
    }

    /// T-CHIP-7: after a takeover no frame of the former master acts.
    #[test]
    fn a_higher_term_fences_the_former_master() {
        use Ruling::{Accepted, Fenced};
        let mut gate = Gate::new();
        let frames = [
            (0, 0, 2),
            (10, 0, 2),
            (25, 1, 3),
            (26, 0, 2),
            (35, 1, 3),
            (36, 0, 2),
        ];
        let expected = [Accepted, Accepted, Accepted, Fenced, Accepted, Fenced];
        assert_eq!(verdicts(&mut gate, &frames), expected);
        let mastership = gate.mastership();
        assert_eq!((mastership.changes(), mastership.two_masters_ns()), (1, 0));
        assert_eq!(mastership.gap_max_ns(36 * MS), 15 * MS);
        assert_eq!(
            gate.counts(),
            FrameCounts {
                accepted: 4,
                fenced: 2,
                ..Default::default()
            }
        );
    }

    /// D-3: gear and parking brake obey the system that the vehicle obeys, and only that one.
    #[test]
    fn a_body_frame_acts_in_the_obeyed_term_only() {
        let mut gate = Gate::new();
        let mut sender = FrameTransmitter::new();
        let mut acts = |gate: &mut Gate, at_ms: u64, system: u8, term: u32| {
            let body_control = BodyControl {
                term,
                ..BodyControl::default()
            };
            let message = Message::BodyControl {
                system,
                body_control,
            };
            let frame = sender.encode(&message);
            let mut damaged = frame.data().to_vec();
            damaged[3] ^= 4;
            assert_eq!(gate.on_body(at_ms * MS, frame.id.into(), &damaged), None);
            let acts = gate.on_body(at_ms * MS, frame.id.into(), frame.data());
            let again = gate.on_body(at_ms * MS, frame.id.into(), frame.data());
            assert_eq!(again, None, "repeated");
            acts.is_some()
        };
        assert!(!acts(&mut gate, 0, 0, 0), "no master yet");
        verdicts(&mut gate, &[(0, 0, 2)]);
        assert!(acts(&mut gate, 1, 0, 2));
        assert!(
            !acts(&mut gate, 50, 1, 3),
            "a term that the vehicle does not obey"
        );
        assert!(!acts(&mut gate, 51, 1, 2), "a term of the other system");
        verdicts(&mut gate, &[(60, 1, 3)]);
        assert!(!acts(&mut gate, 61, 0, 2), "fenced");
        assert!(acts(&mut gate, 62, 1, 3));
        // What was held up while its sender fell silent, or lost its term, comes too late.
        assert!(acts(&mut gate, 159, 1, 3));
        assert!(
            !acts(&mut gate, 160, 1, 3),
            "its control frames are missing"
        );
        assert!(
            !acts(&mut gate, 5_000, 0, 2),
            "fenced, whatever its counter"
        );
        assert!(
            !acts(&mut gate, 5_001, 0, 4),
            "a term before its first control frame"
        );
        verdicts(&mut gate, &[(5_010, 0, 4)]);
        assert!(!acts(&mut gate, 5_011, 1, 3), "deposed");
        assert!(acts(&mut gate, 5_012, 0, 4));
        let control = Sender(FrameTransmitter::new()).frame(1, 3, RoleCode::Master);
        assert_eq!(gate.on_body(5_020 * MS, control.0, &control.1), None);
    }

    /// T-RED-9: a far term acts only after the current one has been silent for 100 ms and its
    /// frames repeat, and a term near the end never acts.
    #[test]
    fn a_far_term_acts_only_when_no_other_does() {
        use Ruling::{Accepted, Invalid, Unexplained};
        let near = 2 + 2 * EXPLAINED;
        for (term, ruling) in [
            (near, Accepted),
            (near + 1, Accepted),
            (near + 2, Unexplained),
            (LAST_UNEXPLAINED_TERM, Unexplained),
            (LAST_UNEXPLAINED_TERM + 1, Invalid),
            (LAST_TERM, Invalid),
            (u32::MAX - 1, Invalid),
            (u32::MAX, Invalid),
        ] {
            let mut gate = Gate::new();
            let frames = [(0, 0, 2), (1, (term & 1) as u8, term), (10, 0, 2)];
            let kept = if ruling == Accepted {
                Ruling::Fenced
            } else {
                Accepted
            };
            let rulings = verdicts(&mut gate, &frames);
            // Of two frames of A the second has the next counter.
            assert_eq!(rulings, [Accepted, ruling, kept], "{term:x}");
            assert_eq!(gate.echo(10 * MS).refused, 0);
        }
        let far = 1_000_001;
        let of_b = |from, to| (from..to).step_by(10).map(|at| (at, 1, far));
        let frames: Vec<_> = [(0, 0, 2)].into_iter().chain(of_b(10, 130)).collect();
        let rulings = verdicts(&mut Gate::new(), &frames);
        assert_eq!(
            (rulings[0], &rulings[1..10]),
            (Accepted, &[Unexplained; 9][..])
        );
        assert_eq!(rulings[10..], [Accepted; 3], "after 100 ms");
        // Each frame that acts begins the count anew.
        let last = [(0, 0, 2), (40, 0, 2)].into_iter().chain(of_b(110, 190));
        let rulings = verdicts(&mut Gate::new(), &Vec::from_iter(last));
        assert_eq!(rulings[2..6], [Unexplained; 4]);
        assert_eq!(rulings[6..], [Accepted; 4]);
    }

    /// T-RED-9: a gate that knows no term accepts each one, but a high one only when it repeats.
    #[test]
    fn the_first_term_leaves_terms_for_the_future() {
        use Ruling::{Accepted, Invalid, Unexplained};
        let first = |term: u32| {
            let frames = [0, 10, 20, 30, 40].map(|at| (at, (term & 1) as u8, term));
            verdicts(&mut Gate::new(), &frames)
        };
        assert_eq!(first(LAST_UNEXPLAINED_TERM), [Accepted; 5]);
        let high = first(LAST_UNEXPLAINED_TERM + 1);
        assert_eq!((&high[..4], high[4]), (&[Unexplained; 4][..], Accepted));
        assert_eq!(first(LAST_TERM + 1), [Invalid; 5]);
    }

    /// T-RED-9: the echo reports the term that is obeyed and the time since its last frame. A frame
    /// that does not act changes nothing.
    #[test]
    fn the_echo_tells_the_term_that_is_obeyed() {
        let mut gate = Gate::new();
        assert_eq!(
            gate.echo(261 * MS),
            GateEcho {
                sent_at: 261,
                ..GateEcho::default()
            }
        );
        verdicts(&mut gate, &[(0, 0, 2), (10, 0, 2), (25, 1, 3), (30, 0, 2)]);
        let echo = gate.echo(32 * MS);
        assert_eq!((echo.term, echo.term_age), (3, 7.0));
        assert_eq!(
            [35, 36, 124, 125].map(|at| gate.is_overdue(at * MS)),
            [false, true, true, false]
        );
        let (id, damaged) = Sender(FrameTransmitter::new()).frame(1, 9, RoleCode::Master);
        gate.on_frame(33 * MS, id, &damaged[1..]);
        assert_eq!(gate.echo(33 * MS).term, 3);
    }

    /// Returns the ruling on a frame of A that requests this at this time, ms.
    fn ruling_on(gate: &mut Gate, sender: &mut Sender, at: u64, control: Control) -> Ruling {
        let control = Control {
            role: RoleCode::Master,
            term: 2,
            ..control
        };
        let message = Message::Control { system: 0, control };
        let frame = sender.0.encode(&message);
        let judged = gate.on_frame(at * MS, frame.id.into(), frame.data());
        judged.unwrap().acceptance.ruling
    }

    /// T-RED-9: a frame that was made 40 ms ago is refused, although it is valid, in order, and
    /// reports fresh data: behind a queue that grows by 0.99 ms a second, and with a step after a
    /// pause. The clock wraps around.
    #[test]
    fn old_frames_are_refused() {
        let (mut gate, mut sender) = (Gate::new(), Sender(FrameTransmitter::new()));
        let mut ruling = |at: u64, delay: u64| {
            let control = Control {
                mode: ModeCode::L3,
                command_age: 30.0,
                sent_at: ((at - delay) as u16).max(1),
                ..Control::default()
            };
            ruling_on(&mut gate, &mut sender, at, control)
        };
        let queue = |at: u64| (at - 60_000) * 99 / 100_000;
        for at in (60_000..160_000).step_by(10) {
            let fresh = queue(at) < u64::from(Control::MAX_DELAY_MS);
            let expected = if fresh {
                Ruling::Accepted
            } else {
                Ruling::Stale
            };
            assert_eq!(ruling(at, queue(at)), expected, "{at} ms");
        }
        for at in (161_000..161_500).step_by(10) {
            assert_eq!(ruling(at, 160), Ruling::Stale);
        }
        assert_eq!(ruling(161_500, 39), Ruling::Accepted);
        // A time in the future is no time of this clock.
        assert_eq!(ruling(161_510, 0x1_0000 - 20), Ruling::Accepted);
        assert_eq!(ruling(161_520, 0x1_0000 - 21), Ruling::Stale);
    }

    /// T-RED-9: the age of the data of a command is limited, unless the command uses none.
    #[test]
    fn commands_that_rest_on_old_data_are_refused() {
        use Ruling::{Accepted, Stale};
        let table = [
            (ModeCode::L3, 1_999.0, Accepted),
            (ModeCode::L3, 2_001.0, Stale),
            (ModeCode::DegradedL2, 2_001.0, Stale),
            (ModeCode::SafeStop, 6553.5, Accepted),
        ];
        for (mode, command_age, expected) in table {
            let (mut gate, mut sender) = (Gate::new(), Sender(FrameTransmitter::new()));
            let control = Control {
                mode,
                command_age,
                ..Control::default()
            };
            let ruling = ruling_on(&mut gate, &mut sender, 0, control);
            assert_eq!(ruling, expected, "{mode:?} {command_age}");
        }
    }

    /// T-RED-9: a command beyond the actuators' range, or one that jumps, does not act. A command
    /// that changes as fast as the controllers change it acts.
    #[test]
    fn commands_out_of_range_and_rate_are_refused() {
        use Ruling::{Accepted, Implausible};
        // Speed, the previous command, and the command 10 ms later.
        let table = [
            (0.0, (0.0, 0.0), (0.004, 0.45), Accepted),
            (0.0, (0.6, -9.5), (0.596, -9.3), Accepted),
            (0.0, (0.0, 0.0), (0.02, 0.0), Implausible),
            (0.0, (0.0, 0.0), (-0.02, 0.0), Implausible),
            (0.0, (0.6, 0.0), (0.62, 0.0), Implausible),
            (25.0, (0.0, 0.0), (0.003, 0.0), Accepted),
            (25.0, (0.0, 0.0), (0.004, 0.0), Implausible),
            (25.0, (0.0, -9.9), (0.0, -10.1), Implausible),
            (25.0, (0.0, 0.0), (0.0, -1.6), Implausible),
            (25.0, (0.0, 3.9), (0.0, 4.1), Implausible),
        ];
        for (speed, before, after, expected) in table {
            let (mut gate, mut sender) = (Gate::new(), Sender(FrameTransmitter::new()));
            gate.set_speed(speed);
            let of = |(steering_angle, acceleration)| Control {
                steering_angle,
                acceleration,
                ..Control::default()
            };
            assert_eq!(ruling_on(&mut gate, &mut sender, 0, of(before)), Accepted);
            let ruling = ruling_on(&mut gate, &mut sender, 10, of(after));
            assert_eq!(ruling, expected, "{speed} m/s, {before:?} to {after:?}");
        }
    }

    /// Returns whether a control frame acts; `None` if the frame is not one.
    fn acts(judged: Option<Judged>) -> Option<bool> {
        let judged = judged?;
        let accepted = judged.acceptance.ruling == Ruling::Accepted;
        assert_eq!(judged.command.is_some(), accepted);
        Some(accepted)
    }

    #[test]
    fn only_whole_frames_of_a_master_act() {
        let mut gate = Gate::new();
        let mut sender = Sender(FrameTransmitter::new());
        let (id, good) = sender.frame(0, 2, RoleCode::Master);
        for byte in 0..good.len() {
            let mut bad = good.clone();
            bad[byte] ^= 0x10;
            assert_eq!(acts(gate.on_frame(0, id, &bad)), Some(false));
            assert_eq!(acts(gate.on_frame(0, id, &good[..byte])), Some(false));
        }
        assert_eq!(acts(gate.on_frame(0, id, &good)), Some(true));
        let repeated = gate.on_frame(1, id, &good);
        assert_eq!(acts(repeated), Some(false));
        let of_b = gate.on_frame(1, id + 1, &good);
        assert_eq!(acts(of_b), Some(false), "the id of the other system");
        assert_eq!(gate.on_frame(1, id + 2, &good), None, "no control frame");
        let (id, standby) = sender.frame(0, 2, RoleCode::Standby);
        assert_eq!(acts(gate.on_frame(2, id, &standby)), Some(false));
        let (id, wrong_parity) = sender.frame(0, 3, RoleCode::Master);
        assert_eq!(acts(gate.on_frame(3, id, &wrong_parity)), Some(false));
        assert_eq!(gate.counts().accepted, 1);
        assert_eq!(gate.counts().not_master, 1);
    }

    #[test]
    fn a_system_that_restarts_acts_with_its_first_frame() {
        let mut gate = Gate::new();
        let mut frames = vec![];
        for n in 0..30 {
            frames.push((n * 10, 0, 2));
        }
        verdicts(&mut gate, &frames);
        assert_eq!(verdicts(&mut gate, &[(2_000, 0, 4)]), [Ruling::Accepted]);
        assert_eq!(
            verdicts(&mut gate, &[(2_010, 0, 4)]),
            [Ruling::Invalid],
            "no silence before"
        );
    }
}
