//! The input of the machine.

use crate::{Ability, FailureMode, LinkReport, Mode, PeerReport, Role, Term};
use tandem_board::{Duration, Edge, Instant, Line, SystemId};

/// The state of the lines and the CAN receiver at one moment. Counts increase and wrap around; only
/// their differences matter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct LineSnapshot {
    /// Rising edges on [`Line::Start`].
    pub handshakes: u32,
    /// Falling edges on [`Line::Start`].
    pub syncs: u32,
    /// Edges of either type on [`Line::Heartbeat1`] and [`Line::Heartbeat2`].
    pub beats: [u32; 2],
    /// The other system's power level.
    pub peer_powered: bool,
    /// Valid frames received on CAN from third parties: from neither of the two systems.
    pub can_frames: u32,
}

impl LineSnapshot {
    /// Creates a snapshot. `received`: the count of edges of one type on one line. `can_frames`:
    /// running count of the valid frames received on CAN from third parties.
    ///
    /// First take all frames from the CAN receiver and pass them to the machine. Otherwise the
    /// machine sees silence while evidence waits in a buffer.
    #[must_use]
    pub fn new(received: impl Fn(Line, Edge) -> u32, peer_powered: bool, can_frames: u32) -> Self {
        let both = |line| received(line, Edge::Rising).wrapping_add(received(line, Edge::Falling));
        Self {
            handshakes: received(Line::Start, Edge::Rising),
            syncs: received(Line::Start, Edge::Falling),
            beats: [both(Line::Heartbeat1), both(Line::Heartbeat2)],
            peer_powered,
            can_frames,
        }
    }
}

/// A control frame that passed its end-to-end protection. On the bus, role and mode are their
/// numbers (`Role::from_repr`, `Mode::from_repr`), the term is [`Term::bits`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ControlHeader {
    /// The system that the frame names as its sender.
    pub system: SystemId,
    /// The term in which its sender drives.
    pub term: Term,
    /// Its role; a control frame with any role but master is implausible.
    pub role: Role,
    /// The function that produced the command.
    pub mode: Mode,
}

/// The vehicle's echo: which system it obeys.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ObeyedTerm {
    /// The term of the last control frame that the vehicle accepted; [`Term::NONE`] before the
    /// first. The vehicle refuses every lower one.
    pub term: Term,
    /// Time since then.
    pub age: Duration,
    /// The last eight bits of the time of sending, ms on the vehicle's clock, and the time from
    /// sending to this call; `None` if unknown.
    pub sent: Option<(u8, Duration)>,
}

/// One input of the machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Input {
    /// The lines. Poll periodically, and at once if an edge or the level raises an interrupt.
    Poll(LineSnapshot),
    /// A control frame was received on CAN.
    ControlFrame(ControlHeader),
    /// A status frame of the other system was received on CAN.
    StatusFrame(PeerReport),
    /// A report of the other system was received over the link.
    LinkReport(LinkReport),
    /// A control frame with a right CRC and a wrong counter was received on CAN: frames were lost,
    /// or its sender has restarted. The vehicle may have accepted it, so only its term is used.
    StaleFrame(ControlHeader),
    /// The vehicle reported which term it obeys, as it does every control period.
    VehicleTerm(ObeyedTerm),
    /// An echo with a right CRC and a wrong counter was received, with this term: another node may
    /// send in the vehicle's name. It only disputes what other echoes say of a far term.
    StaleEcho(Term),
    /// This system found a fault in itself. Repeat it while the fault lasts.
    OwnFault(FailureMode),
    /// This system is asked to let the other one drive. In dual operation it resigns for
    /// [`Config::report_limit`](crate::Config::report_limit), without a fault and without stopping
    /// the vehicle; in every other phase the request has no effect. Repeat it while the request
    /// lasts.
    HandOver,
    /// How well this system can drive. It holds until the next one; [`Ability::All`] before the
    /// first. A master that is less able than its standby offers its role.
    Ability(Ability),
}

/// The differences between a poll and the one before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Seen {
    pub(crate) handshakes: u32,
    pub(crate) syncs: u32,
    pub(crate) beats: [u32; 2],
    pub(crate) can_frames: u32,
    pub(crate) peer_powered: bool,
    /// Time since the last poll; `None` at the first.
    pub(crate) since_last: Option<Duration>,
}

impl Seen {
    /// Returns the number of heartbeats: the count of the line that carried more.
    pub(crate) fn heartbeats(&self) -> u32 {
        self.beats[0].max(self.beats[1])
    }
}

/// Computes the differences between two snapshots.
#[derive(Clone, Debug)]
pub(crate) struct Polls {
    last: Option<LineSnapshot>,
    at: Instant,
}

impl Polls {
    pub(crate) const fn new(now: Instant) -> Self {
        Self {
            last: None,
            at: now,
        }
    }

    /// Returns the time of the last poll, or of the start if there was none.
    pub(crate) const fn last(&self) -> Instant {
        self.at
    }

    pub(crate) fn take(&mut self, now: Instant, snapshot: &LineSnapshot) -> Seen {
        let since_last = self.last.map(|_| now.since(self.at));
        let last = self.last.replace(*snapshot).unwrap_or(*snapshot);
        self.at = now;
        Seen {
            handshakes: snapshot.handshakes.wrapping_sub(last.handshakes),
            syncs: snapshot.syncs.wrapping_sub(last.syncs),
            beats: [0, 1].map(|line| snapshot.beats[line].wrapping_sub(last.beats[line])),
            can_frames: snapshot.can_frames.wrapping_sub(last.can_frames),
            peer_powered: snapshot.peer_powered,
            since_last,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// T-RED-3: only differences count, even if a count wraps around; the first snapshot is the
    /// reference.
    #[test]
    fn differences_across_the_wrap_around() {
        let first = LineSnapshot {
            handshakes: u32::MAX,
            syncs: u32::MAX - 1,
            beats: [u32::MAX - 5, u32::MAX],
            peer_powered: true,
            can_frames: u32::MAX,
        };
        let mut polls = Polls::new(Instant::ORIGIN);
        let seen = polls.take(Instant::from_ns(7), &first);
        assert_eq!((seen.handshakes, seen.syncs, seen.beats), (0, 0, [0; 2]));
        assert_eq!((seen.can_frames, seen.since_last), (0, None));
        let next = LineSnapshot {
            handshakes: 1,
            syncs: u32::MAX,
            beats: [0, 3],
            peer_powered: false,
            can_frames: 4,
        };
        let seen = polls.take(Instant::from_ns(17), &next);
        assert_eq!((seen.handshakes, seen.syncs, seen.beats), (2, 1, [6, 4]));
        assert_eq!((seen.can_frames, seen.heartbeats()), (5, 6));
        assert_eq!(seen.since_last, Some(Duration::from_ns(10)));
    }
}
