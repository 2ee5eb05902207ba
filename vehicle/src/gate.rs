//! The vehicle's own decision which control frames act: valid, from a master, of the highest term.
//!
//! The term is a fencing token: a frame with a lower term than one seen before never acts, whatever
//! its sender believes. The caller is told of every control frame what became of it, and records
//! it, so that "two masters" and "no master" are facts.
//!
//! | frame | verdict | acts |
//! |---|---|---|
//! | protection, length or value wrong, or the term's lowest bit is another | `Invalid` | no |
//! | role other than master | `NotMaster` | no |
//! | term lower than the highest seen | `Fenced` | no |
//! | else | `Accepted` | yes; its term is now the highest |

use tandem_bus::e2e::{Check, Checker};
use tandem_bus::{Control, GateEcho, Message, Role};

use crate::mastership::Mastership;

/// After this silence a sender may start with any counter, ns: it was down, so missing frames are
/// no fault.
const COUNTER_FORGOTTEN_NS: u64 = 150_000_000;

/// A control frame is overdue this long after the last one, ns: the shortest limit of any standby.
const OVERDUE_NS: u64 = 11_000_000;
/// After this silence no system waits for a hasty word any more, ns.
const OVERDUE_ENDS_NS: u64 = 100_000_000;

/// What became of a control frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It acts.
    Accepted,
    /// Its term is lower than one seen before.
    Fenced,
    /// Its sender does not claim to be master.
    NotMaster,
    /// It is damaged, repeated, out of sequence, or contradicts itself.
    Invalid,
}

/// What became of a control frame, and when.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Acceptance {
    /// When the frame arrived, ns, on the caller's clock.
    pub at_ns: u64,
    /// 0 = A, 1 = B, by the frame's id.
    pub system: u8,
    /// The frame's term; 0 if it is invalid.
    pub term: u32,
    /// What became of it.
    pub verdict: Verdict,
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
}

/// Judges control frames.
#[derive(Debug)]
pub struct Gate {
    checkers: [Checker; 2],
    last_ns: [Option<u64>; 2],
    highest_term: u32,
    accepted: Option<Acceptance>,
    counts: FrameCounts,
    mastership: Mastership,
}

/// A control frame that was judged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Judged {
    /// What became of it.
    pub acceptance: Acceptance,
    /// What it demands, if it acts.
    pub command: Option<Control>,
}

impl Gate {
    /// A gate that has seen no frame.
    #[must_use]
    pub fn new() -> Self {
        Self {
            checkers: Control::IDS.map(Checker::new),
            last_ns: [None; 2],
            highest_term: 0,
            accepted: None,
            counts: FrameCounts::default(),
            mastership: Mastership::default(),
        }
    }

    /// Judges a frame that arrives at `now_ns` on the caller's clock; `None` if it is no control
    /// frame.
    pub fn on_frame(&mut self, now_ns: u64, id: u32, data: &[u8]) -> Option<Judged> {
        let system = Control::IDS
            .iter()
            .position(|known| u32::from(*known) == id)?;
        let (verdict, control) = self.judge(now_ns, system, data);
        let term = control.map_or(0, |control| control.term);
        let acceptance = Acceptance {
            at_ns: now_ns,
            system: system as u8,
            term,
            verdict,
        };
        match verdict {
            Verdict::Accepted => self.accept(acceptance),
            Verdict::Fenced => self.counts.fenced += 1,
            Verdict::NotMaster => self.counts.not_master += 1,
            Verdict::Invalid => self.counts.invalid += 1,
        }
        Some(Judged {
            acceptance,
            command: control.filter(|_| verdict == Verdict::Accepted),
        })
    }

    fn judge(&mut self, now_ns: u64, system: usize, data: &[u8]) -> (Verdict, Option<Control>) {
        let mut check = self.checkers[system].check(data);
        if check == Check::CrcError {
            return (Verdict::Invalid, None);
        }
        let silence = self.last_ns[system].map(|last| now_ns.saturating_sub(last));
        self.last_ns[system] = Some(now_ns);
        if silence.is_some_and(|silence| silence > COUNTER_FORGOTTEN_NS) {
            check = Check::Initial;
        }
        let message = Message::decode(u32::from(Control::IDS[system]), data);
        let Ok(Message::Control { control, .. }) = message else {
            return (Verdict::Invalid, None);
        };
        if !check.is_accepted() || control.term & 1 != system as u32 {
            return (Verdict::Invalid, None);
        }
        if control.role != Role::Master {
            return (Verdict::NotMaster, Some(control));
        }
        if control.term < self.highest_term {
            return (Verdict::Fenced, Some(control));
        }
        (Verdict::Accepted, Some(control))
    }

    fn accept(&mut self, entry: Acceptance) {
        self.counts.accepted += 1;
        self.highest_term = entry.term;
        self.mastership
            .accept(entry.at_ns, entry.system, entry.term);
        self.accepted = Some(entry);
    }

    /// The last frame that acted.
    #[must_use]
    pub fn accepted(&self) -> Option<Acceptance> {
        self.accepted
    }

    /// What the vehicle tells both systems: which term it obeys, and how old its last frame is.
    #[must_use]
    pub fn echo(&self, now_ns: u64) -> GateEcho {
        self.accepted.map_or(GateEcho::default(), |last| GateEcho {
            term: last.term,
            term_age: now_ns.saturating_sub(last.at_ns) as f32 * 1e-6,
        })
    }

    /// Whether a control frame is overdue: then both systems are told each millisecond, so that the
    /// standby need not wait for the next echo. Such an echo takes about 0.13 ms of a bus of 500
    /// kbit/s and 2 Mbit/s: 13 % of it, while the frames of the master are missing.
    #[must_use]
    pub fn is_overdue(&self, now_ns: u64) -> bool {
        let silence = |last: Acceptance| now_ns.saturating_sub(last.at_ns);
        let overdue = OVERDUE_NS..OVERDUE_ENDS_NS;
        self.accepted
            .is_some_and(|last| overdue.contains(&silence(last)))
    }

    /// What became of the control frames so far.
    #[must_use]
    pub fn counts(&self) -> FrameCounts {
        self.counts
    }

    /// Gaps, changes and two masters, from the frames that acted.
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
    use tandem_bus::Transmitter;

    const MS: u64 = 1_000_000;

    struct Sender(Transmitter);

    impl Sender {
        fn frame(&mut self, system: u8, term: u32, role: Role) -> (u32, Vec<u8>) {
            let control = Control {
                role,
                term,
                ..Control::default()
            };
            let frame = self.0.encode(&Message::Control { system, control });
            (u32::from(frame.id), frame.data().to_vec())
        }
    }

    /// Sends master frames of (time in ms, system, term) and returns the verdicts.
    fn verdicts(gate: &mut Gate, frames: &[(u64, u8, u32)]) -> Vec<Verdict> {
        let mut sender = Sender(Transmitter::new());
        let judged = frames.iter().map(|(at, system, term)| {
            let (id, data) = sender.frame(*system, *term, Role::Master);
            gate.on_frame(at * MS, id, &data)
        });
        judged.map(|it| it.unwrap().acceptance.verdict).collect()
    }

    /// T-CHIP-7: after a takeover no frame of the former master acts, not one.
    #[test]
    fn a_higher_term_fences_the_former_master() {
        use Verdict::{Accepted, Fenced};
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

    /// T-RED-9: the echo tells the term that is obeyed, and since when no frame of it came; a frame
    /// that does not act changes nothing.
    #[test]
    fn the_echo_tells_the_term_that_is_obeyed() {
        let mut gate = Gate::new();
        assert_eq!(gate.echo(5 * MS), GateEcho::default());
        verdicts(&mut gate, &[(0, 0, 2), (10, 0, 2), (25, 1, 3), (30, 0, 2)]);
        let echo = gate.echo(32 * MS);
        assert_eq!((echo.term, echo.term_age), (3, 7.0));
        assert_eq!(
            [35, 36, 124, 125].map(|at| gate.is_overdue(at * MS)),
            [false, true, true, false]
        );
        let (id, damaged) = Sender(Transmitter::new()).frame(1, 9, Role::Master);
        gate.on_frame(33 * MS, id, &damaged[1..]);
        assert_eq!(gate.echo(33 * MS).term, 3);
    }

    /// Whether a control frame acts; `None` if it is none.
    fn acts(judged: Option<Judged>) -> Option<bool> {
        let judged = judged?;
        let accepted = judged.acceptance.verdict == Verdict::Accepted;
        assert_eq!(judged.command.is_some(), accepted);
        Some(accepted)
    }

    #[test]
    fn only_whole_frames_of_a_master_act() {
        let mut gate = Gate::new();
        let mut sender = Sender(Transmitter::new());
        let (id, good) = sender.frame(0, 2, Role::Master);
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
        let (id, standby) = sender.frame(0, 2, Role::Standby);
        assert_eq!(acts(gate.on_frame(2, id, &standby)), Some(false));
        let (id, wrong_parity) = sender.frame(0, 3, Role::Master);
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
        assert_eq!(verdicts(&mut gate, &[(2_000, 0, 4)]), [Verdict::Accepted]);
        assert_eq!(
            verdicts(&mut gate, &[(2_010, 0, 4)]),
            [Verdict::Invalid],
            "no silence before"
        );
    }
}
