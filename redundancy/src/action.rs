//! The output of the machine: a list of actions, and the time of the next poll.

use crate::{Evidence, Phase, SystemState, Term};
use tandem_board::{Duration, Edge, Instant, Line, ResetRequest};

/// One thing that the caller must do now.
///
/// Match it without a wildcard, so that a new action does not compile until it is carried out:
///
/// ```compile_fail,E0004
/// use tandem_redundancy::Action;
///
/// fn carry_out(action: Action) {
///     match action {
///         Action::SendEdge(..) | Action::Transmit | Action::AlignControl => {}
///         Action::Persist(_) | Action::Reset(_) | Action::Record(_) => {}
///         // error[E0004]: pattern `Action::DiscardUnsent` not covered
///     }
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Action {
    /// Send this edge to the other system.
    SendEdge(Line, Edge),
    /// The output has just opened, or a frame was refused until this poll. Send a control frame now
    /// (check [`Redundancy::may_transmit`](crate::Redundancy::may_transmit)); do not wait for the
    /// next cycle.
    Transmit,
    /// The output has just closed: discard the control frames that wait in the transmit buffer.
    DiscardUnsent,
    /// Dual operation begins now in both systems: align the control cycle to this moment.
    AlignControl,
    /// Write this state to the flash: pass it to
    /// [`StateStore::request`](crate::StateStore::request). It replaces an earlier requested state
    /// that is not yet written.
    Persist(SystemState),
    /// Request this reset from the supply as soon as the store is settled: the reason for the reset
    /// must be in flash before the reset. Every later call repeats this action; a repeated request
    /// has no effect.
    Reset(ResetRequest),
    /// Write this event to the trace.
    Record(RedundancyEvent),
}

/// Describes a takeover, for the trace.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Takeover {
    /// The evidence that caused it.
    pub cause: Evidence,
    /// Time since the last heartbeat of the failed master.
    pub since_heartbeat: Duration,
    /// Time since the last control frame of the failed master, or since this system became standby
    /// if it heard none.
    pub since_control: Duration,
    /// The new term.
    pub term: Term,
}

/// Whose clock is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ClockOwner {
    /// This system's clock: it differs from both others by about the same amount.
    Own = 0,
    /// The other system's clock.
    Peer = 1,
    /// The vehicle's clock.
    Vehicle = 2,
}

/// An event for the trace.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum RedundancyEvent {
    /// The phase changed.
    Phase {
        /// The old phase.
        from: Phase,
        /// The new phase.
        to: Phase,
        /// The evidence that caused the change.
        on: Evidence,
    },
    /// This system took over.
    Takeover(Takeover),
    /// Heartbeat line 1 or 2 went silent.
    LineSilent(u8),
    /// Heartbeat line 1 or 2 carries edges again.
    LineBack(u8),
    /// Both heartbeat lines are silent, but another witness shows that the other system runs: the
    /// lines are cut.
    LinesSplit,
    /// The other system now counts as failed (`true`), or no longer does (`false`).
    PeerFailed(bool),
    /// A frame arrived that no correct peer sends; it was ignored.
    Implausible,
    /// A control frame of a lower term was heard and ignored; the vehicle refuses it.
    StaleTerm(Term),
    /// This system takes a higher term without a change of role, because the other system knows a
    /// higher one.
    TermRaised(Term),
    /// No frame is received on CAN (`true`), or frames are received again (`false`).
    CanSilent(bool),
    /// The state in flash was lost; this system began with the factory state.
    StateLost,
    /// The power level line was low while the other system was running (`true`): it is now ignored.
    /// Or it has been high for long enough to be used again (`false`).
    LevelBroken(bool),
    /// No edge ever arrived on the start line, although the other system runs: the line is cut.
    StartLineSilent,
    /// This clock has drifted away from the two others.
    ClockWrong(ClockOwner),
    /// A term that no rule explains was reported by one witness only, or is near the end of all
    /// terms; it was ignored.
    FarTerm(Term),
}

impl RedundancyEvent {
    /// Returns the kind and two details, for a trace record.
    #[must_use]
    pub fn to_words(&self) -> [u32; 3] {
        let us = |span: Duration| u32::try_from(span.as_us()).unwrap_or(u32::MAX);
        match *self {
            Self::Phase { from, to, on } => [1, (from as u32) << 8 | to as u32, on as u32],
            Self::Takeover(takeover) => [2, takeover.term.bits(), us(takeover.since_heartbeat)],
            Self::LineSilent(line) => [3, line.into(), 0],
            Self::LineBack(line) => [4, line.into(), 0],
            Self::LinesSplit => [5, 0, 0],
            Self::PeerFailed(failed) => [6, failed.into(), 0],
            Self::Implausible => [7, 0, 0],
            Self::StaleTerm(term) => [8, term.bits(), 0],
            Self::TermRaised(term) => [9, term.bits(), 0],
            Self::CanSilent(silent) => [10, silent.into(), 0],
            Self::StateLost => [11, 0, 0],
            Self::LevelBroken(broken) => [12, broken.into(), 0],
            Self::StartLineSilent => [13, 0, 0],
            Self::ClockWrong(clock) => [14, clock as u32, 0],
            Self::FarTerm(term) => [15, term.bits(), 0],
        }
    }
}

/// The actions of one call, in the order in which the caller must carry them out, and the time of
/// the next poll.
#[must_use = "edges, states and resets that the machine asks for must be carried out"]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Actions {
    list: [Option<Action>; Self::CAPACITY],
    /// The number of actions; they are at the start of the list.
    count: u8,
    deadline: Instant,
}

impl Actions {
    /// The largest number of actions: every kind once, heartbeats on both lines, and
    /// [`Actions::EVENTS`] events.
    pub const CAPACITY: usize = 18;
    /// The largest number of events; one call causes fewer. Further events are lost; other actions
    /// never are.
    pub const EVENTS: usize = 8;

    pub(crate) fn none() -> Self {
        Self {
            list: [None; Self::CAPACITY],
            count: 0,
            deadline: Instant::NEVER,
        }
    }

    /// Adds an action unless it is already in the list.
    pub(crate) fn push(&mut self, action: Action) {
        if !self.contains(action)
            && let Some(place) = self.list.get_mut(usize::from(self.count))
        {
            *place = Some(action);
            self.count += 1;
        }
    }

    pub(crate) fn record(&mut self, event: RedundancyEvent) {
        if self.events().count() < Self::EVENTS {
            self.push(Action::Record(event));
        }
    }

    pub(crate) fn set_deadline(&mut self, deadline: Instant) {
        self.deadline = deadline;
    }

    /// Returns the actions, in order.
    pub fn iter(&self) -> impl Iterator<Item = Action> + '_ {
        let list = self.list.iter().take(usize::from(self.count));
        list.flatten().copied()
    }

    /// Returns the events among the actions.
    pub fn events(&self) -> impl Iterator<Item = RedundancyEvent> + '_ {
        self.iter().filter_map(|action| match action {
            Action::Record(event) => Some(event),
            _ => None,
        })
    }

    /// Returns the takeover, if one is among the events.
    #[must_use]
    pub fn takeover(&self) -> Option<Takeover> {
        self.events().find_map(|event| match event {
            RedundancyEvent::Takeover(takeover) => Some(takeover),
            _ => None,
        })
    }

    /// Returns whether the list contains this action.
    #[must_use]
    pub fn contains(&self, action: Action) -> bool {
        self.iter().any(|one| one == action)
    }

    /// Call again with [`Input::Poll`](crate::Input::Poll) no later than this.
    #[must_use]
    pub const fn deadline(&self) -> Instant {
        self.deadline
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use RedundancyEvent as E;

    /// The words of each event stay the same, because firmware in C and old traces use them.
    #[test]
    fn events_have_these_words() {
        let term = Term::from_bits(77);
        let takeover = |since_us| {
            E::Takeover(Takeover {
                cause: Evidence::PeerSilent,
                since_heartbeat: Duration::from_us(since_us),
                since_control: Duration::ZERO,
                term,
            })
        };
        let change = E::Phase {
            from: Phase::Standby,
            to: Phase::DegradedMaster,
            on: Evidence::PeerOff,
        };
        for (event, words) in [
            (change, [1, 0x0103, 4]),
            (takeover(4_500), [2, 77, 4_500]),
            (takeover(1 << 32), [2, 77, u32::MAX]),
            (E::LineSilent(1), [3, 1, 0]),
            (E::LineBack(2), [4, 2, 0]),
            (E::LinesSplit, [5, 0, 0]),
            (E::PeerFailed(true), [6, 1, 0]),
            (E::Implausible, [7, 0, 0]),
            (E::StaleTerm(term), [8, 77, 0]),
            (E::TermRaised(term), [9, 77, 0]),
            (E::CanSilent(true), [10, 1, 0]),
            (E::StateLost, [11, 0, 0]),
            (E::LevelBroken(false), [12, 0, 0]),
            (E::StartLineSilent, [13, 0, 0]),
            (E::ClockWrong(ClockOwner::Vehicle), [14, 2, 0]),
            (E::FarTerm(term), [15, 77, 0]),
        ] {
            assert_eq!(event.to_words(), words);
        }
    }

    /// Each action is listed once; only the first eight events are kept.
    #[test]
    fn actions_are_listed_once_and_events_leave_room() {
        let mut actions = Actions::none();
        for line in 0..20 {
            actions.record(RedundancyEvent::LineSilent(line));
            actions.push(Action::Transmit);
        }
        assert_eq!(actions.events().count(), Actions::EVENTS);
        assert_eq!(actions.iter().count(), Actions::EVENTS + 1);
        assert!(actions.contains(Action::Transmit) && !actions.contains(Action::DiscardUnsent));
    }
}
