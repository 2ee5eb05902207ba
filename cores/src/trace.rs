//! The events that cores write to the board's trace, in four words each.
//!
//! The trace is for people and reports; no driving function reads it. `docs/tracing.md` shows how
//! to use it. Codes of tasks and interrupts are those of [`crate::task_table`].
//!
//! The scheduler writes [`Event::TaskIn`] and [`Event::TaskOut`] around each use of the CPU. For a
//! kernel that pre-empts, its hooks map one to one: *switched in* is `TaskIn` with [`Begin::Goes`],
//! *switched out* is `TaskOut` with [`Leaves::Gives`], *moved to ready* is `Ready`, entry and exit
//! of an interrupt are `IrqIn` and `IrqOut`. A job of a task extends from its release (`Ready`,
//! [`Begin::Released`] or the signal of a [`Event::Woken`]) to the `TaskOut` that says
//! [`Leaves::Done`].

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
        /// Earlier releases for which no job ran.
        missed: u32,
    },
}

/// What a task does when it leaves the CPU.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr)]
#[repr(u8)]
pub enum Leaves {
    /// Its job is done; it waits for the next release.
    Done,
    /// It waits for something within its job.
    Blocked,
    /// It could continue, but a more urgent one runs first.
    Preempted,
    /// The kernel gives no reason. The job continues unless the task's next event is `Ready`.
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
    /// The system's role or mode changed. The fields use the codes of the frames.
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
        /// The evidence for it.
        on: Evidence,
    },
    /// This system became master because the other failed.
    TookOver {
        /// The evidence for it.
        cause: Evidence,
        /// Time since the other's last heartbeat, µs.
        since_heartbeat_us: u32,
        /// Time since the other's last control frame, µs.
        since_control_us: u32,
        /// The new term.
        term: u32,
    },
    /// The other system is considered failed, or healthy again.
    PeerFailed(bool),
    /// A heartbeat line went silent, or came back; another line was found broken.
    Line {
        /// 1 or 2: a heartbeat line; 3: the power level; 4: the start line.
        line: u8,
        /// Went silent, or is broken.
        silent: bool,
    },
    /// Both heartbeat lines are silent, but other witnesses show that the other system runs.
    LinesSplit,
    /// Nothing arrives on CAN, or frames arrive again.
    CanSilent(bool),
    /// A frame that no correct peer sends, or one of a lower or an unexplained term, arrived and
    /// was ignored.
    Ignored {
        /// Its term; 0 if it was ignored for another reason.
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
        /// Delay of the start after the release, ns.
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
    /// Missed jobs of the roles are traced with each status frame.
    DeadlineMiss {
        /// Which task.
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
    /// A source sends faster than core 0 reads: the fault of another system or core.
    Flood {
        /// Which source.
        source: FloodSource,
        /// Polls that reached the limit, or doorbells that were held back, since the last report.
        times: u32,
        /// Frames that the receiver lost, datagrams that a newer one replaced, edges above the
        /// limit, or doorbells that were held back.
        beyond: u32,
    },
    /// A task gets the CPU.
    TaskIn {
        /// Which task.
        task: TaskCode,
        /// How it gets the CPU.
        begin: Begin,
    },
    /// A task leaves the CPU.
    TaskOut {
        /// Which task.
        task: TaskCode,
        /// Why it leaves.
        leaves: Leaves,
    },
    /// A job of a task is released, or continues as soon as it gets the CPU.
    Ready {
        /// Which task.
        task: TaskCode,
    },
    /// The handler of an interrupt begins.
    IrqIn {
        /// Which interrupt.
        irq: IrqCode,
    },
    /// The handler of an interrupt ends.
    IrqOut {
        /// Which interrupt.
        irq: IrqCode,
    },
    /// A pending interrupt ended the core's sleep; no handler ran.
    Interrupted {
        /// Which interrupt.
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
        /// Which core.
        core: CoreId,
    },
    /// The running task takes a signal of another core.
    Woken {
        /// From which core.
        core: CoreId,
        /// Number of the signal.
        flow: u32,
    },
    /// The deepest use of a task's stack so far.
    Stack {
        /// Which task.
        task: TaskCode,
        /// Bytes that were never used.
        free_bytes: u32,
    },
    /// How well the other system agrees with this one's commands. Traced at each change, and when
    /// the largest difference has grown by a tenth of the limit.
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
    /// The SoC no longer commands while the vehicle is parked: the function stops the vehicle.
    SocSilent {
        /// The topic that is missing, as in [`SocTopic`](tandem_topics::endpoints::SocTopic).
        topic: u8,
    },
    /// This system found that its command is wrong, and leaves.
    WrongCommand {
        /// 0: the vehicle obeys a command other than the one sent, or refuses it. 1: core 2
        /// computes another command from the same inputs.
        witness: u8,
    },
    /// The scene differs from what core 0 itself hears of the sensors. This system leaves.
    WrongScene {
        /// 0 the lanes, 1 speed, 2 yaw rate, 3 steering angle, 4 slip angle of the vehicle, 5 place
        /// and 6 speed of an object ahead, 7 an object that no sensor sees, 8 acceleration.
        what: u8,
        /// 0: the scene is wrong. 1: core 0 hears wrong values.
        hearing: bool,
        /// The difference, in thousandths of m, m/s, rad/s or rad.
        thousandths: u32,
    },
    /// Three trajectories in succession were wrong. Core 0 does not follow them, and this system
    /// leaves.
    WrongTrajectory {
        /// 0 its start, 1 the way from point to point, 2 the limits of the vehicle, 3 the lane, 4 a
        /// vehicle ahead.
        what: u8,
        /// Share of the limit, %; `u32::MAX` if the words were no trajectory.
        percent: u32,
    },
    /// The largest share of a limit that a right trajectory uses has grown by a tenth.
    TrajectoryCheck {
        /// As in [`WrongTrajectory`](Self::WrongTrajectory).
        what: u8,
        /// %
        percent: u8,
    },
    /// The largest difference between a scene and the sensors' frames has grown by a tenth of what
    /// one scene may differ. A finding takes at least three scenes beyond it.
    SceneCheck {
        /// Share of the tolerance; of objects, the accumulated share of the finding's limit. %
        percent: u8,
    },
    /// The scenes of both systems differ.
    PeerScene {
        /// As in [`WrongScene`](Self::WrongScene).
        what: u8,
        /// This system's scene has jumped, so this system leaves. Otherwise it stays.
        own: bool,
        /// The difference, in thousandths of m, m/s, rad/s or rad.
        thousandths: u32,
    },
    /// Most of the other sensors see an object ahead at another place than this one. No system
    /// leaves.
    SensorContradicted {
        /// [`SensorId::index`](tandem_bus::SensorId::index).
        sensor: u8,
    },
    /// A sensor contradicts the others for all cores. No system leaves: each reports that it can
    /// only stop, and does so by what the other sensors say.
    SensorLies {
        /// 0 the camera's line, 1 speed, 2 yaw rate, 3 steering angle, 4 slip angle, 5 acceleration
        /// of the vehicle, 6 yaw rate or steering angle.
        what: u8,
        /// How far it is from what the others say, in thousandths of m, m/s, rad/s or rad.
        thousandths: u32,
    },
    /// The vehicle's echo names a steering angle that the measured one contradicts. The command is
    /// right: no system leaves.
    WrongEcho,
    /// How well this system can drive has changed.
    Ability {
        /// 0 with all sensors, 1 without one of them, 2 it can only stop, 3 it can only brake.
        bits: u8,
        /// What is missing: one bit for each by `SensorId::index`, bit 6 lanes, bit 7 the motion.
        missing: u8,
    },
    /// The output driver has had a fault for the confirmation time.
    OutputFault {
        /// 1 open load, 2 short circuit.
        found: u8,
    },
    /// A cyclic frame of the bus has not been heard for five of its periods. Told with a network to
    /// an SoC.
    FrameSilent {
        /// CAN id.
        id: u32,
        /// Time since the last one, ms.
        age_ms: u32,
    },
    /// Frames of the bus were lost, by their counter. Told with a network to an SoC.
    FrameGaps {
        /// CAN id.
        id: u32,
        /// How many, since the last report.
        lost: u32,
    },
    /// The vehicle's time on this system, ten times a second.
    Time {
        /// Code of the [`TimeSource`](crate::core0::TimeSource).
        source: u8,
        /// Bits of the [`TimeStatus`](tandem_timesync::TimeStatus).
        status: u8,
        /// Low word of the vehicle's time, ns.
        global_ns: u32,
        /// Low word of this system's clock at that time, ns.
        local_ns: u32,
        /// How much faster than this system's clock the vehicle's time runs, ppb.
        rate_ppb: i32,
    },
    /// Another clock told its time.
    TimeSample {
        /// As in [`Time`](Self::Time).
        source: u8,
        /// How much later it says it is than this system thought, ns.
        offset_ns: i32,
        /// Delay of its messages, ns; 0 if it has none.
        delay_ns: u32,
        /// Largest error of the sample that the protocol knows of, ns.
        error_ns: u32,
    },
    /// Another clock has leapt.
    TimeLeap {
        /// As in [`Time`](Self::Time).
        source: u8,
        /// The vehicle's time has followed it. Before that, the leap is told.
        followed: bool,
        /// How far, us.
        by_us: i32,
    },
    /// A standby hears the grandmaster and the pulses of the system that drives, and they tell
    /// different times: one of both links is asymmetric, or one of both lies.
    TimeDisagrees {
        /// How much later the grandmaster says it is, ns.
        apart_ns: i32,
    },
    /// The grandmaster is followed, or no longer, or not yet.
    GrandmasterTime {
        /// 0: it is followed. Else the reason why not: the code of
        /// [`gptp::Unfollowed`](tandem_timesync::gptp).
        why: u8,
    },
    /// Another grandmaster than the one that is followed sends in its domain. Once a second.
    OtherGrandmaster {
        /// How many of its messages were heard; wraps around.
        others: u32,
    },
    /// A sensor's stamps in global time deviate from what they have shown before: what was learned
    /// from arrivals is used in their place.
    StampRefused {
        /// The sensor by [`SensorId::index`](tandem_bus::SensorId::index); 6: the camera's lanes.
        source: u8,
        /// By its stamp the measurement was later than expected; otherwise it was earlier.
        later: bool,
        /// By this, µs.
        off_us: u32,
    },
    /// The longest time for which a task held the shared state.
    Held {
        /// Which task.
        task: TaskCode,
        /// From the lock to its release, including interruptions, ns.
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
            E::StaleTerm(term) | E::FarTerm(term) => Self::Ignored { term: term.bits() },
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
    /// Returns whether a scheduler or a signal writes it, thousands of times a second. Any other
    /// event is reported one by one.
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
}

/// The content of a record: three small fields, and three numbers.
#[derive(Clone, Copy, Default)]
struct Fields {
    a: u8,
    b: u8,
    c: u8,
    x: u32,
    y: u32,
    z: u32,
}

/// A field of an event in a record.
trait Field<R>: Sized {
    fn put(self) -> R;
    fn take(raw: R) -> Option<Self>;
}

macro_rules! fields {
    ($($type:ty as $raw:ty: $put:expr, $take:expr;)+) => {$(
        impl Field<$raw> for $type {
            fn put(self) -> $raw {
                $put(self)
            }
            fn take(raw: $raw) -> Option<Self> {
                $take(raw)
            }
        }
    )+};
}

fields! {
    u8 as u8: u8::from, Some;
    bool as u8: u8::from, |code| Some(code != 0);
    TaskCode as u8: |task: Self| task.0, |code| Some(Self(code));
    IrqCode as u8: |irq: Self| irq.0, |code| Some(Self(code));
    CoreId as u8: |core: Self| core.index() as u8, Self::new;
    Phase as u8: |phase| phase as u8, Self::from_repr;
    Evidence as u8: |on| on as u8, Self::from_repr;
    Leaves as u8: |leaves| leaves as u8, Self::from_repr;
    FloodSource as u8: |source| source as u8, Self::from_repr;
    u32 as u32: u32::from, Some;
    i32 as u32: i32::cast_unsigned, |word: u32| Some(word.cast_signed());
    CanErrors as u32: Self::to_word, |word| Some(Self::from_word(word));
}

/// The codec of the events: the number of each event, the place of each of its fields, and the
/// values to which its field `a` is limited.
macro_rules! codec {
    ($(
        $kind:literal $event:ident {$($field:tt: $place:ident),*}
        $($least:literal ..= $most:literal)?;
    )+) => {
        impl Event {
            /// Returns the event as four words: kind and up to three small fields in the first,
            /// then three numbers.
            #[must_use]
            pub fn encode(self) -> TraceRecord {
                let none = Fields::default();
                let (kind, fields) = match self {
                    $(Self::$event { $($field: $place),* } => {
                        ($kind, Fields { $($place: $place.put(),)* ..none })
                    })+
                    Self::TaskIn { task, begin: Begin::Goes } => (17, Fields { a: task.0, ..none }),
                    Self::TaskIn { task, begin: Begin::Released { late_ns, missed } } => {
                        (17, Fields { a: task.0, b: 1, x: late_ns, y: missed, ..none })
                    }
                };
                let Fields { a, b, c, x, y, z } = fields;
                [u32::from_le_bytes([kind, a, b, c]), x, y, z]
            }

            /// The event in a record; `None` if the record has another kind.
            #[must_use]
            pub fn decode([first, x, y, z]: TraceRecord) -> Option<Self> {
                let [kind, a, b, c] = first.to_le_bytes();
                let fields = Fields { a, b, c, x, y, z };
                Some(match (kind, a) {
                    $(($kind, codec!(@limits $($least $most)?)) => Self::$event {
                        $($field: Field::take(fields.$place)?),*
                    },)+
                    (17, _) => Self::TaskIn {
                        task: TaskCode(a),
                        begin: match b {
                            0 => Begin::Goes,
                            1 => Begin::Released { late_ns: x, missed: y },
                            _ => return None,
                        },
                    },
                    _ => return None,
                })
            }
        }
    };
    (@limits) => { _ };
    (@limits $least:literal $most:literal) => { $least..=$most };
}

codec! {
    1 Started { generation: x, cause: a };
    2 Role { role: a, mode: b, term: x };
    3 Phase { from: a, to: b, on: c };
    4 TookOver { cause: a, since_heartbeat_us: x, since_control_us: y, term: z };
    5 PeerFailed { 0: a };
    6 Line { line: a, silent: b };
    7 LinesSplit {};
    8 CanSilent { 0: a };
    9 Ignored { term: x };
    10 TermRaised { term: x };
    11 StateLost {};
    12 ControlCycle { lateness_ns: x, execution_ns: y, transmitted: a };
    13 Chain { latency_ns: x, cycle: y };
    14 CoreSilent { core: a };
    15 DeadlineMiss { task: a, missed: x };
    16 Refused { id: x };
    18 TaskOut { task: a, leaves: b };
    19 Ready { task: a };
    20 IrqIn { irq: a };
    21 IrqOut { irq: a };
    22 Interrupted { irq: a };
    23 Wake { core: a, task: b, flow: x };
    24 Woken { core: a, flow: x };
    25 Stack { task: a, free_bytes: x };
    26 Ring { core: a };
    27 Held { task: a, longest_ns: x };
    28 Flood { source: a, times: x, beyond: y };
    29 Agreement { stage: a, percent: b } 0..=2;
    30 WrongCommand { witness: a } 0..=1;
    31 ClockWrong { of: a } 0..=2;
    32 OutputFault { found: a } 1..=2;
    33 FramesLost { count: x };
    34 CanErrors { errors: x };
    35 Sensors { missing: a };
    40 WrongScene { what: a, hearing: b, thousandths: x } 0..=8;
    41 SceneCheck { percent: a };
    42 WrongEcho {};
    46 SensorContradicted { sensor: a } 0..=5;
    47 PeerScene { what: a, own: b, thousandths: x } 0..=4;
    48 Ability { bits: a, missing: b } 0..=3;
    49 WrongTrajectory { what: a, percent: x } 0..=4;
    50 TrajectoryCheck { what: a, percent: b } 0..=4;
    51 SensorLies { what: a, thousandths: x } 0..=6;
    52 SocSilent { topic: a } 0..=3;
    53 FrameSilent { id: x, age_ms: y };
    54 FrameGaps { id: x, lost: y };
    55 Time { source: a, status: b, global_ns: x, local_ns: y, rate_ppb: z } 0..=2;
    56 TimeSample { source: a, offset_ns: x, delay_ns: y, error_ns: z } 0..=2;
    57 TimeLeap { source: a, followed: b, by_us: x } 0..=2;
    58 TimeDisagrees { apart_ns: x };
    59 GrandmasterTime { why: a };
    60 StampRefused { source: a, later: b, off_us: x } 0..=6;
    61 OtherGrandmaster { others: x };
}

#[cfg(test)]
mod tests;
