//! What the cores write to the board's trace: four words an event.
//!
//! The trace is for people and reports; nothing that drives reads it.

use tandem_board::TraceRecord;

/// One thing that happened on a core.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// The core runs, in this life; `cause` is the reset cause (0 power-on, 1 software, 2 watchdog,
    /// 3 trap).
    Started {
        /// Life of the core.
        generation: u32,
        /// Reset cause.
        cause: u8,
    },
    /// Role and mode of the system are now these (as in the DBC's value tables).
    Role {
        /// 0 starting, 1 master, 2 standby, 3 suspended.
        role: u8,
        /// 0 none, 1 L3, 2 degraded L2, 3 safe stop.
        mode: u8,
        /// Mastership term that the system holds or knows.
        term: u32,
    },
    /// Start protocol done: both systems run in step.
    Synchronised,
    /// The other system is taken for failed.
    PeerLost {
        /// What it was seen by, as [`Evidence`].
        evidence: Evidence,
        /// Time since its last sign of life, µs.
        silent_us: u32,
    },
    /// The other system's heartbeats are back.
    PeerBack,
    /// This system became master because the other failed.
    TookOver {
        /// What the failure was seen by.
        evidence: Evidence,
        /// Time since the other's last sign of life, µs.
        silent_us: u32,
        /// The new term.
        term: u32,
    },
    /// One control cycle of core 0.
    ControlCycle {
        /// Start after its release, ns.
        lateness_ns: u32,
        /// Execution time, ns.
        execution_ns: u32,
        /// The control frame was transmitted.
        transmitted: bool,
    },
    /// One pass through cores 1, 2 and 0 has ended on core 0.
    Chain {
        /// From the acquisition on core 1 to the handler on core 0, ns.
        latency_ns: u32,
        /// Cycle of core 1.
        cycle: u32,
    },
    /// A core of this system no longer answers.
    CoreSilent {
        /// 1 or 2.
        core: u8,
    },
    /// A control cycle was released late by whole periods.
    DeadlineMiss {
        /// Cycles that did not run.
        missed: u32,
    },
    /// One heartbeat line is silent while the other is alive, or the level line contradicts both.
    LineBroken {
        /// 1 or 2; 0 for a contradiction.
        line: u8,
    },
    /// An own fault was found.
    OwnFault {
        /// Failure mode as in the status frame.
        mode: u8,
    },
    /// A frame or a word from a peer was refused.
    Refused {
        /// CAN id, or 0 for the LMU.
        id: u32,
    },
}

/// What the loss of the other system was seen by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Evidence {
    /// Its power level fell.
    Level,
    /// Both heartbeat lines and its control frames are silent.
    Heartbeats,
    /// Its heartbeats are alive, its control frames are missing.
    ControlFrames,
    /// It never answered the handshake.
    Handshake,
}

impl Evidence {
    const ALL: [Self; 4] = [
        Self::Level,
        Self::Heartbeats,
        Self::ControlFrames,
        Self::Handshake,
    ];

    /// The name that reports use.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Level => "power level fell",
            Self::Heartbeats => "heartbeats and control frames silent",
            Self::ControlFrames => "control frames missing",
            Self::Handshake => "no handshake",
        }
    }
}

impl Event {
    /// The event as four words: kind and two small fields in the first, then three numbers.
    #[must_use]
    pub const fn encode(self) -> TraceRecord {
        const fn head(kind: u8, a: u8, b: u8) -> u32 {
            u32::from_le_bytes([kind, a, b, 0])
        }
        match self {
            Self::Started { generation, cause } => [head(1, cause, 0), generation, 0, 0],
            Self::Role { role, mode, term } => [head(2, role, mode), term, 0, 0],
            Self::Synchronised => [head(3, 0, 0), 0, 0, 0],
            Self::PeerLost {
                evidence,
                silent_us,
            } => [head(4, evidence as u8, 0), silent_us, 0, 0],
            Self::PeerBack => [head(5, 0, 0), 0, 0, 0],
            Self::TookOver {
                evidence,
                silent_us,
                term,
            } => [head(6, evidence as u8, 0), silent_us, term, 0],
            Self::ControlCycle {
                lateness_ns,
                execution_ns,
                transmitted,
            } => [head(7, transmitted as u8, 0), lateness_ns, execution_ns, 0],
            Self::Chain { latency_ns, cycle } => [head(8, 0, 0), latency_ns, cycle, 0],
            Self::CoreSilent { core } => [head(9, core, 0), 0, 0, 0],
            Self::DeadlineMiss { missed } => [head(10, 0, 0), missed, 0, 0],
            Self::LineBroken { line } => [head(11, line, 0), 0, 0, 0],
            Self::OwnFault { mode } => [head(12, mode, 0), 0, 0, 0],
            Self::Refused { id } => [head(13, 0, 0), id, 0, 0],
        }
    }

    /// The event in a record; `None` if it is none of ours.
    #[must_use]
    pub fn decode([first, x, y, _]: TraceRecord) -> Option<Self> {
        let [kind, a, b, _] = first.to_le_bytes();
        let evidence = Evidence::ALL.get(usize::from(a)).copied();
        Some(match kind {
            1 => Self::Started {
                generation: x,
                cause: a,
            },
            2 => Self::Role {
                role: a,
                mode: b,
                term: x,
            },
            3 => Self::Synchronised,
            4 => Self::PeerLost {
                evidence: evidence?,
                silent_us: x,
            },
            5 => Self::PeerBack,
            6 => Self::TookOver {
                evidence: evidence?,
                silent_us: x,
                term: y,
            },
            7 => Self::ControlCycle {
                lateness_ns: x,
                execution_ns: y,
                transmitted: a != 0,
            },
            8 => Self::Chain {
                latency_ns: x,
                cycle: y,
            },
            9 => Self::CoreSilent { core: a },
            10 => Self::DeadlineMiss { missed: x },
            11 => Self::LineBroken { line: a },
            12 => Self::OwnFault { mode: a },
            13 => Self::Refused { id: x },
            _ => return None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_event_survives_the_trace() {
        let events = [
            Event::Started {
                generation: 3,
                cause: 2,
            },
            Event::Role {
                role: 1,
                mode: 2,
                term: 9,
            },
            Event::Synchronised,
            Event::PeerLost {
                evidence: Evidence::Heartbeats,
                silent_us: 4000,
            },
            Event::PeerBack,
            Event::TookOver {
                evidence: Evidence::ControlFrames,
                silent_us: 12_000,
                term: 4,
            },
            Event::ControlCycle {
                lateness_ns: 1,
                execution_ns: 2,
                transmitted: true,
            },
            Event::Chain {
                latency_ns: 7,
                cycle: 8,
            },
            Event::CoreSilent { core: 2 },
            Event::DeadlineMiss { missed: 5 },
            Event::LineBroken { line: 1 },
            Event::OwnFault { mode: 6 },
            Event::Refused { id: 0x110 },
        ];
        for event in events {
            assert_eq!(Event::decode(event.encode()), Some(event));
        }
        assert_eq!(Event::decode([0; 4]), None);
        assert_eq!(Event::decode([0xFF04, 0, 0, 0]), None);
    }
}
