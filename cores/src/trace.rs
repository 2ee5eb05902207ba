//! The events that cores write to the board's trace, in four words each.
//!
//! The trace is for people and reports; nothing that drives reads it. `docs/tracing.md` shows what
//! becomes of it. Codes of tasks and interrupts are those of [`crate::task_table`].
//!
//! The scheduler writes [`Event::TaskIn`] and [`Event::TaskOut`] around whatever gets the CPU. For
//! a kernel that pre-empts, its hooks map one to one: *switched in* is `TaskIn` with
//! [`Begin::Goes`], *switched out* is `TaskOut` with [`Leaves::Gives`], *moved to ready* is
//! `Ready`, entry and exit of an interrupt are `IrqIn` and `IrqOut`. A job of a task reaches from
//! its release (`Ready`, [`Begin::Released`] or the signal of a [`Event::Woken`]) to the `TaskOut`
//! that says [`Leaves::Done`].

use crate::task_table::{IrqCode, TaskCode};
use strum::{FromRepr, VariantArray};
use tandem_board::{CanErrors, CoreId, Duration, TraceRecord};
use tandem_redundancy::{Evidence, Phase};

/// How a task gets the CPU.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Begin {
    /// It continues, or begins a job whose release is an [`Event::Ready`] or [`Event::Woken`].
    Goes,
    /// It begins a job.
    Released {
        /// Time since the release, ns.
        late_ns: u32,
        /// Releases before this one that no job answered.
        missed: u32,
    },
}

/// What a task does that leaves the CPU.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr)]
#[repr(u8)]
pub enum Leaves {
    /// Its job is done; it waits for the next release.
    Done,
    /// It waits for something within its job.
    Blocked,
    /// It could continue, but a more urgent one runs first.
    Preempted,
    /// The kernel does not say why. Its job is done if it is then made ready; else it continues.
    Gives,
}

/// A source of frames, edges or interrupts that core 0 does not control.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr, VariantArray)]
#[repr(u8)]
pub enum FloodSource {
    /// Frames on the CAN bus.
    Can,
    /// Datagrams of the other system on the link.
    Link,
    /// Edges of the other system on the start line.
    StartLine,
    /// Edges of the other system on a heartbeat line.
    HeartbeatLines,
    /// The doorbell: cores 1 and 2, edges on the start line, the other system's power level.
    Doorbell,
}

/// One thing that happened on a core.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// The core runs.
    Started {
        /// Incarnation of the core.
        generation: u32,
        /// Code of the [`ResetCause`](tandem_board::ResetCause); 0 on cores 1 and 2.
        cause: u8,
    },
    /// Role and mode of the system are now these, with their codes in the frames.
    Role {
        /// 0 starting, 1 master, 2 standby, 3 suspended.
        role: u8,
        /// 0 none, 1 L3, 2 degraded L2, 3 safe stop.
        mode: u8,
        /// The highest mastership term that the system knows.
        term: u32,
    },
    /// The redundancy's phase changed.
    Phase {
        /// Before.
        from: Phase,
        /// After.
        to: Phase,
        /// On what evidence.
        on: Evidence,
    },
    /// This system became master because the other failed.
    TookOver {
        /// On what evidence.
        cause: Evidence,
        /// Time since the other's last heartbeat, µs.
        since_heartbeat_us: u32,
        /// Time since the other's last control frame, µs.
        since_control_us: u32,
        /// The new term.
        term: u32,
    },
    /// The other system is taken for failed, or no longer.
    PeerFailed(bool),
    /// A heartbeat line went silent, or came back; another line was found broken.
    Line {
        /// 1 or 2: a heartbeat line; 3: the power level; 4: the start line.
        line: u8,
        /// Went silent, or is broken.
        silent: bool,
    },
    /// Both heartbeat lines are silent, but the other system is seen to live.
    LinesSplit,
    /// Nothing arrives on CAN, or frames arrive again.
    CanSilent(bool),
    /// A frame came that no correct peer sends, or one of a lower term; it was ignored.
    Ignored {
        /// Its term; 0 if that was not the reason.
        term: u32,
    },
    /// The term was raised without a change of role.
    TermRaised {
        /// The new term.
        term: u32,
    },
    /// The state in flash was lost.
    StateLost,
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
    /// Jobs of a task did not run, because an earlier one or a more urgent task took their time.
    /// Those of the roles are traced with each status frame.
    DeadlineMiss {
        /// Which.
        task: TaskCode,
        /// Jobs that did not run, since the last report.
        missed: u32,
    },
    /// Received CAN frames were lost: this core did not fetch them in time.
    FramesLost {
        /// How many, since the last report.
        count: u32,
    },
    /// Sensors are lost or late, or are back.
    Sensors {
        /// Those that are missing, one bit for each by
        /// [`SensorId::index`](tandem_bus::SensorId::index).
        missing: u8,
    },
    /// The CAN controller changed its state, or was bus-off.
    CanErrors {
        /// Its counters now.
        errors: CanErrors,
    },
    /// A frame or a value in the LMU was refused.
    Refused {
        /// CAN id, or 0 for the LMU.
        id: u32,
    },
    /// A source sends faster than core 0 takes: the fault of another system or core.
    Flood {
        /// Which.
        source: FloodSource,
        /// Polls since the last report that reached the limit, or doorbells that were held back.
        times: u32,
        /// Frames that the receiver lost, datagrams that a newer one replaced, edges above the
        /// limit, or doorbells that were held back.
        beyond: u32,
    },
    /// A task has the CPU from now on.
    TaskIn {
        /// Which.
        task: TaskCode,
        /// How it came to it.
        begin: Begin,
    },
    /// A task gives the CPU up.
    TaskOut {
        /// Which.
        task: TaskCode,
        /// Why.
        leaves: Leaves,
    },
    /// A job of a task is released, or continues as soon as it gets the CPU.
    Ready {
        /// Which.
        task: TaskCode,
    },
    /// The handler of an interrupt begins.
    IrqIn {
        /// Which.
        irq: IrqCode,
    },
    /// The handler of an interrupt ends.
    IrqOut {
        /// Which.
        irq: IrqCode,
    },
    /// A pending interrupt ended the core's sleep; no handler ran.
    Interrupted {
        /// Which.
        irq: IrqCode,
    },
    /// This core is about to signal a task of another one.
    Wake {
        /// To which core.
        core: CoreId,
        /// To which of its tasks.
        task: TaskCode,
        /// Number of the signal: that of its [`Event::Woken`].
        flow: u32,
    },
    /// This core is about to ring the doorbell of another one, which may be asleep.
    Ring {
        /// Whose.
        core: CoreId,
    },
    /// The running task takes up a signal of another core.
    Woken {
        /// From which core.
        core: CoreId,
        /// Number of the signal.
        flow: u32,
    },
    /// The stack of a task was never fuller than this.
    Stack {
        /// Which.
        task: TaskCode,
        /// Bytes that were never used.
        free_bytes: u32,
    },
    /// How well the other system agrees with this one's commands: at each change, and whenever the
    /// difference has become larger than ever by a tenth of the limit.
    Agreement {
        /// 0 agreed, 1 disagreed, 2 unresolved: a safe stop is asked for.
        stage: u8,
        /// Share of the limit that the difference uses, %.
        percent: u8,
    },
    /// A clock has drifted away from the two others.
    ClockWrong {
        /// 0 this system's: it leaves. 1 the other system's, 2 the vehicle's.
        of: u8,
    },
    /// This system found that its command is wrong, and leaves.
    WrongCommand {
        /// 0: the vehicle obeys another one than was sent, or refuses it. 1: core 2 computes
        /// another one from the same inputs.
        witness: u8,
    },
    /// The driver of the outputs has a fault, for as long as it takes to believe it.
    OutputFault {
        /// 1 open load, 2 short circuit.
        found: u8,
    },
    /// A task never held what all share for longer than this.
    Held {
        /// Which.
        task: TaskCode,
        /// From the lock to its release, with what interrupted it, ns.
        longest_ns: u32,
    },
}

impl From<tandem_redundancy::RedundancyEvent> for Event {
    fn from(event: tandem_redundancy::RedundancyEvent) -> Self {
        use tandem_redundancy::RedundancyEvent as E;
        let us = |span: Duration| u32::try_from(span.as_us()).unwrap_or(u32::MAX);
        match event {
            E::Phase { from, to, on } => Self::Phase { from, to, on },
            E::Takeover(takeover) => Self::TookOver {
                cause: takeover.cause,
                since_heartbeat_us: us(takeover.since_heartbeat),
                since_control_us: us(takeover.since_control),
                term: takeover.term.bits(),
            },
            E::LineSilent(line) => Self::Line { line, silent: true },
            E::LineBack(line) => Self::Line {
                line,
                silent: false,
            },
            E::LinesSplit => Self::LinesSplit,
            E::PeerFailed(failed) => Self::PeerFailed(failed),
            E::Implausible => Self::Ignored { term: 0 },
            E::StaleTerm(term) => Self::Ignored { term: term.bits() },
            E::TermRaised(term) => Self::TermRaised { term: term.bits() },
            E::CanSilent(silent) => Self::CanSilent(silent),
            E::StateLost => Self::StateLost,
            E::LevelBroken(silent) => Self::Line { line: 3, silent },
            E::StartLineSilent => Self::Line {
                line: 4,
                silent: true,
            },
            E::ClockWrong(clock) => Self::ClockWrong { of: clock as u8 },
        }
    }
}

impl Event {
    /// Whether a scheduler or a signal writes it, thousands of times in a second. The others stand
    /// for themselves.
    #[must_use]
    pub const fn is_scheduling(self) -> bool {
        matches!(
            self,
            Self::TaskIn { .. }
                | Self::TaskOut { .. }
                | Self::Ready { .. }
                | Self::IrqIn { .. }
                | Self::IrqOut { .. }
                | Self::Interrupted { .. }
                | Self::Wake { .. }
                | Self::Woken { .. }
                | Self::Ring { .. }
                | Self::Stack { .. }
                | Self::Held { .. }
        )
    }

    /// The event as four words: kind and up to three small fields in the first, then three numbers.
    #[must_use]
    pub const fn encode(self) -> TraceRecord {
        const fn head(kind: u8, a: u8, b: u8, c: u8) -> u32 {
            u32::from_le_bytes([kind, a, b, c])
        }
        match self {
            Self::Started { generation, cause } => [head(1, cause, 0, 0), generation, 0, 0],
            Self::Role { role, mode, term } => [head(2, role, mode, 0), term, 0, 0],
            Self::Phase { from, to, on } => [head(3, from as u8, to as u8, on as u8), 0, 0, 0],
            Self::TookOver {
                cause,
                since_heartbeat_us,
                since_control_us,
                term,
            } => [
                head(4, cause as u8, 0, 0),
                since_heartbeat_us,
                since_control_us,
                term,
            ],
            Self::PeerFailed(failed) => [head(5, failed as u8, 0, 0), 0, 0, 0],
            Self::Line { line, silent } => [head(6, line, silent as u8, 0), 0, 0, 0],
            Self::LinesSplit => [head(7, 0, 0, 0), 0, 0, 0],
            Self::CanSilent(silent) => [head(8, silent as u8, 0, 0), 0, 0, 0],
            Self::Ignored { term } => [head(9, 0, 0, 0), term, 0, 0],
            Self::TermRaised { term } => [head(10, 0, 0, 0), term, 0, 0],
            Self::StateLost => [head(11, 0, 0, 0), 0, 0, 0],
            Self::ControlCycle {
                lateness_ns,
                execution_ns,
                transmitted,
            } => [
                head(12, transmitted as u8, 0, 0),
                lateness_ns,
                execution_ns,
                0,
            ],
            Self::Chain { latency_ns, cycle } => [head(13, 0, 0, 0), latency_ns, cycle, 0],
            Self::CoreSilent { core } => [head(14, core, 0, 0), 0, 0, 0],
            Self::DeadlineMiss { task, missed } => [head(15, task.0, 0, 0), missed, 0, 0],
            Self::FramesLost { count } => [head(33, 0, 0, 0), count, 0, 0],
            Self::Sensors { missing } => [head(35, missing, 0, 0), 0, 0, 0],
            Self::CanErrors { errors } => [head(34, 0, 0, 0), errors.to_word(), 0, 0],
            Self::Refused { id } => [head(16, 0, 0, 0), id, 0, 0],
            Self::TaskIn { task, begin } => match begin {
                Begin::Goes => [head(17, task.0, 0, 0), 0, 0, 0],
                Begin::Released { late_ns, missed } => [head(17, task.0, 1, 0), late_ns, missed, 0],
            },
            Self::TaskOut { task, leaves } => [head(18, task.0, leaves as u8, 0), 0, 0, 0],
            Self::Ready { task } => [head(19, task.0, 0, 0), 0, 0, 0],
            Self::IrqIn { irq } => [head(20, irq.0, 0, 0), 0, 0, 0],
            Self::IrqOut { irq } => [head(21, irq.0, 0, 0), 0, 0, 0],
            Self::Interrupted { irq } => [head(22, irq.0, 0, 0), 0, 0, 0],
            Self::Wake { core, task, flow } => {
                [head(23, core.index() as u8, task.0, 0), flow, 0, 0]
            }
            Self::Woken { core, flow } => [head(24, core.index() as u8, 0, 0), flow, 0, 0],
            Self::Stack { task, free_bytes } => [head(25, task.0, 0, 0), free_bytes, 0, 0],
            Self::Held { task, longest_ns } => [head(27, task.0, 0, 0), longest_ns, 0, 0],
            Self::Ring { core } => [head(26, core.index() as u8, 0, 0), 0, 0, 0],
            Self::Agreement { stage, percent } => [head(29, stage, percent, 0), 0, 0, 0],
            Self::OutputFault { found } => [head(32, found, 0, 0), 0, 0, 0],
            Self::WrongCommand { witness } => [head(30, witness, 0, 0), 0, 0, 0],
            Self::ClockWrong { of } => [head(31, of, 0, 0), 0, 0, 0],
            Self::Flood {
                source,
                times,
                beyond,
            } => [head(28, source as u8, 0, 0), times, beyond, 0],
        }
    }

    /// The event in a record; `None` if the record has another kind.
    #[must_use]
    pub fn decode([first, x, y, z]: TraceRecord) -> Option<Self> {
        let [kind, a, b, c] = first.to_le_bytes();
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
            3 => Self::Phase {
                from: Phase::from_repr(a)?,
                to: Phase::from_repr(b)?,
                on: Evidence::from_repr(c)?,
            },
            4 => Self::TookOver {
                cause: Evidence::from_repr(a)?,
                since_heartbeat_us: x,
                since_control_us: y,
                term: z,
            },
            5 => Self::PeerFailed(a != 0),
            6 => Self::Line {
                line: a,
                silent: b != 0,
            },
            7 => Self::LinesSplit,
            8 => Self::CanSilent(a != 0),
            9 => Self::Ignored { term: x },
            10 => Self::TermRaised { term: x },
            11 => Self::StateLost,
            12 => Self::ControlCycle {
                lateness_ns: x,
                execution_ns: y,
                transmitted: a != 0,
            },
            13 => Self::Chain {
                latency_ns: x,
                cycle: y,
            },
            14 => Self::CoreSilent { core: a },
            15 => Self::DeadlineMiss {
                task: TaskCode(a),
                missed: x,
            },
            33 => Self::FramesLost { count: x },
            35 => Self::Sensors { missing: a },
            34 => Self::CanErrors {
                errors: CanErrors::from_word(x),
            },
            16 => Self::Refused { id: x },
            17 => Self::TaskIn {
                task: TaskCode(a),
                begin: match b {
                    0 => Begin::Goes,
                    1 => Begin::Released {
                        late_ns: x,
                        missed: y,
                    },
                    _ => return None,
                },
            },
            18 => Self::TaskOut {
                task: TaskCode(a),
                leaves: Leaves::from_repr(b)?,
            },
            19 => Self::Ready { task: TaskCode(a) },
            20 => Self::IrqIn { irq: IrqCode(a) },
            21 => Self::IrqOut { irq: IrqCode(a) },
            22 => Self::Interrupted { irq: IrqCode(a) },
            23 => Self::Wake {
                core: CoreId::new(a)?,
                task: TaskCode(b),
                flow: x,
            },
            24 => Self::Woken {
                core: CoreId::new(a)?,
                flow: x,
            },
            25 => Self::Stack {
                task: TaskCode(a),
                free_bytes: x,
            },
            27 => Self::Held {
                task: TaskCode(a),
                longest_ns: x,
            },
            26 => Self::Ring {
                core: CoreId::new(a)?,
            },
            29 if a <= 2 => Self::Agreement {
                stage: a,
                percent: b,
            },
            32 if matches!(a, 1 | 2) => Self::OutputFault { found: a },
            30 if a <= 1 => Self::WrongCommand { witness: a },
            31 if a <= 2 => Self::ClockWrong { of: a },
            28 => Self::Flood {
                source: FloodSource::from_repr(a)?,
                times: x,
                beyond: y,
            },
            _ => return None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_event_survives_the_trace() {
        let phase = |from, to| Event::Phase {
            from,
            to,
            on: Evidence::PeerOff,
        };
        let leaves = |leaves| Event::TaskOut {
            task: TaskCode::MONITORING,
            leaves,
        };
        let flood = |source| Event::Flood {
            source,
            times: 12,
            beyond: 3,
        };
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
            phase(Phase::Standby, Phase::DegradedMaster),
            Event::TookOver {
                cause: Evidence::PeerSilent,
                since_heartbeat_us: 4000,
                since_control_us: 12_000,
                term: 4,
            },
            Event::PeerFailed(true),
            Event::Line {
                line: 2,
                silent: true,
            },
            Event::LinesSplit,
            Event::CanSilent(false),
            Event::Ignored { term: 6 },
            Event::TermRaised { term: 7 },
            Event::StateLost,
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
            Event::DeadlineMiss {
                task: TaskCode::CONTROL,
                missed: 5,
            },
            Event::FramesLost { count: 77 },
            Event::Sensors { missing: 33 },
            Event::CanErrors {
                errors: CanErrors {
                    transmit: 256,
                    receive: 3,
                    bus_offs: 1,
                },
            },
            Event::Refused { id: 0x110 },
            Event::TaskIn {
                task: TaskCode::CONTROL,
                begin: Begin::Goes,
            },
            Event::TaskIn {
                task: TaskCode(200),
                begin: Begin::Released {
                    late_ns: 12,
                    missed: 3,
                },
            },
            leaves(Leaves::Done),
            leaves(Leaves::Blocked),
            leaves(Leaves::Preempted),
            leaves(Leaves::Gives),
            Event::Ready {
                task: TaskCode::STATUS,
            },
            Event::IrqIn { irq: IrqCode::TICK },
            Event::IrqOut {
                irq: IrqCode::DOORBELL,
            },
            Event::Interrupted {
                irq: IrqCode::DOORBELL,
            },
            Event::Wake {
                core: CoreId::PLANNING,
                task: TaskCode::PLANNING,
                flow: 77,
            },
            Event::Woken {
                core: CoreId::PERCEPTION,
                flow: 77,
            },
            Event::Stack {
                task: TaskCode::CONTROL,
                free_bytes: 900,
            },
            Event::Ring {
                core: CoreId::CONTROL,
            },
            Event::Held {
                task: TaskCode::STATUS,
                longest_ns: 1200,
            },
            flood(FloodSource::Can),
            flood(FloodSource::Doorbell),
            Event::Agreement {
                stage: 2,
                percent: 99,
            },
            Event::WrongCommand { witness: 1 },
            Event::ClockWrong { of: 2 },
            Event::OutputFault { found: 2 },
        ];
        for event in events {
            assert_eq!(Event::decode(event.encode()), Some(event));
        }
        assert_eq!(Event::decode([0; 4]), None);
        assert_eq!(Event::decode([0xFF03, 0, 0, 0]), None);
        for strange in [
            0x0002_0011,
            0x0004_0012,
            0x0000_0317,
            0x0000_0318,
            0x051C,
            0x031D,
            0x021E,
            0x031F,
            0x0320,
            36,
        ] {
            assert_eq!(Event::decode([strange, 0, 0, 0]), None, "{strange:X}");
        }
    }
}
