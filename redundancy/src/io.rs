//! What the machine is told and what it answers.

use crate::{Beat, Evidence, FailureMode, Mode, PeerReport, Phase, Role, SystemState, Term};
use tandem_board::{Duration, Edge, Instant, Line, Lines, ResetRequest, SystemId};

/// The lines and the CAN receiver at one moment. Counts are running counts; they wrap around, and
/// where they begin does not matter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Snapshot {
    /// Rising edges on [`Line::Start`].
    pub handshakes: u32,
    /// Falling edges on [`Line::Start`].
    pub syncs: u32,
    /// Edges of either type on [`Line::Heartbeat1`] and [`Line::Heartbeat2`].
    pub beats: [u32; 2],
    /// The other system's power level.
    pub peer_powered: bool,
    /// Valid frames received on CAN, from whomever.
    pub can_frames: u32,
}

impl Snapshot {
    /// Reads the lines. `can_frames`: running count of the valid frames received on CAN.
    ///
    /// Fetch everything from the CAN receiver and hand it to the machine *before* this: else it
    /// would be told of silence while evidence waits in a buffer.
    #[must_use]
    pub fn read(lines: &impl Lines, can_frames: u32) -> Self {
        let both = |line| {
            lines
                .received(line, Edge::Rising)
                .wrapping_add(lines.received(line, Edge::Falling))
        };
        Self {
            handshakes: lines.received(Line::Start, Edge::Rising),
            syncs: lines.received(Line::Start, Edge::Falling),
            beats: [both(Line::Heartbeat1), both(Line::Heartbeat2)],
            peer_powered: lines.peer_powered(),
            can_frames,
        }
    }
}

/// A control frame that passed its end-to-end protection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ControlFrame {
    /// The system that the frame names as its sender.
    pub system: SystemId,
    /// Its mastership term.
    pub term: Term,
    /// Its role; a control frame of anything but a master is implausible.
    pub role: Role,
    /// The function that produced the command.
    pub mode: Mode,
}

/// What the machine is told.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Input {
    /// The periodic look at the lines; also at once when an edge or the power level interrupts.
    Poll(Snapshot),
    /// A control frame was received on CAN.
    ControlFrame(ControlFrame),
    /// A status frame of the other system was received on CAN.
    StatusFrame(PeerReport),
    /// A report of the other system came over the link.
    LinkReport(PeerReport),
    /// The vehicle told the highest term that it has accepted. Optional: without it, a system that
    /// was off while the other had very many masterships may drive in a term that the vehicle
    /// refuses.
    VehicleTerm(Term),
    /// This system found a fault in itself. Repeat it while the fault lasts.
    OwnFault(FailureMode),
}

/// A takeover, for the record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Takeover {
    /// On what evidence.
    pub cause: Evidence,
    /// Time since the last heartbeat of the failed master.
    pub since_heartbeat: Duration,
    /// Time since the last control frame of the failed master, or since this system became standby
    /// if it heard none.
    pub since_control: Duration,
    /// The new term.
    pub term: Term,
}

/// Something worth a line in the trace.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// The phase changed.
    Phase {
        /// Before.
        from: Phase,
        /// After.
        to: Phase,
        /// On what evidence.
        on: Evidence,
    },
    /// This system took over.
    Takeover(Takeover),
    /// Heartbeat line 1 or 2 went silent.
    LineSilent(u8),
    /// Heartbeat line 1 or 2 is back.
    LineBack(u8),
    /// Both heartbeat lines are silent, but the other system is seen to live: the lines are cut.
    LinesSplit,
    /// The other system is taken for failed, or no longer.
    PeerFailed(bool),
    /// A frame came that no correct peer sends; it was ignored.
    Implausible,
    /// A control frame of a lower term was heard and ignored; the vehicle refuses it.
    StaleTerm(Term),
    /// This system takes a higher term without a change of role, because the other knows a higher
    /// one.
    TermRaised(Term),
    /// Nothing is heard on CAN (`true`), or something again.
    CanSilent(bool),
    /// The state in flash was lost; this system began with the factory state.
    StateLost,
}

impl Event {
    /// Kind and two details, for a trace record.
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
        }
    }
}

/// The events of one call, in order. Room for eight, which is more than one call can cause.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Events {
    list: [Option<Event>; 8],
}

impl Events {
    pub(crate) fn push(&mut self, event: Event) {
        if let Some(place) = self.list.iter_mut().find(|place| place.is_none()) {
            *place = Some(event);
        }
    }

    /// The events.
    pub fn iter(&self) -> impl Iterator<Item = Event> + '_ {
        self.list.iter().flatten().copied()
    }

    /// The takeover among them.
    #[must_use]
    pub fn takeover(&self) -> Option<Takeover> {
        self.iter().find_map(|event| match event {
            Event::Takeover(takeover) => Some(takeover),
            _ => None,
        })
    }
}

/// What the core must do now.
#[must_use = "edges, state and resets that the machine asks for must be carried out"]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Actions {
    /// Send a rising edge on [`Line::Start`].
    pub handshake: bool,
    /// Send a falling edge on [`Line::Start`], after the handshake if both.
    pub sync: bool,
    /// Send this edge on both heartbeat lines.
    pub beat: Option<Beat>,
    /// The output has just opened, or a frame was refused until this poll: send a control frame
    /// now (ask [`Redundancy::may_transmit`](crate::Redundancy::may_transmit)), do not wait for
    /// the next cycle.
    pub transmit_now: bool,
    /// The output just closed: discard control frames that wait in the transmit buffer.
    pub output_closed: bool,
    /// Dual operation begins now in both systems: the moment to align the control cycle to.
    pub synchronised: bool,
    /// Write this state to the flash: hand it to
    /// [`StateStore::request`](crate::StateStore::request).
    pub persist: Option<SystemState>,
    /// Ask the supply for this reset, as soon as the store is settled (what led to the reset must
    /// be in flash before it comes). Stays set in the actions of later calls; asking twice does no
    /// harm.
    pub reset: Option<ResetRequest>,
    /// For the trace.
    pub events: Events,
    /// Call again with [`Input::Poll`] no later than this.
    pub deadline: Instant,
}

impl Actions {
    pub(crate) fn none(deadline: Instant) -> Self {
        Self {
            handshake: false,
            sync: false,
            beat: None,
            transmit_now: false,
            output_closed: false,
            synchronised: false,
            persist: None,
            reset: None,
            events: Events::default(),
            deadline,
        }
    }

    /// The edges to send, in this order.
    pub fn edges(&self) -> impl Iterator<Item = (Line, Edge)> {
        let beat = self.beat.map(|beat| beat.edge);
        [
            self.handshake.then_some((Line::Start, Edge::Rising)),
            self.sync.then_some((Line::Start, Edge::Falling)),
            beat.map(|edge| (Line::Heartbeat1, edge)),
            beat.map(|edge| (Line::Heartbeat2, edge)),
        ]
        .into_iter()
        .flatten()
    }
}
