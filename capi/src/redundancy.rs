//! The redundancy machine: takes the time and an input, and returns the actions to carry out.

use crate::cell::{self, opaque};
use crate::config::TandemConfig;
use crate::status::{TandemStatus, TandemStatus as S, status};
use crate::store::{TandemLoaded, TandemState, failure_mode, system_id};
use tandem_board::{Duration, Edge, Instant, Line, ResetCause, ResetRequest, SystemId};
use tandem_redundancy::{
    Ability, Action, Actions, ControlHeader, Input, LineSnapshot, LinkReport, Mode, ObeyedTerm,
    PeerReport, Redundancy, RedundancyEvent, Role, Term,
};

/// The power was switched on.
pub const TANDEM_CAUSE_POWER_ON: u32 = 0;
/// The software requested the reset.
pub const TANDEM_CAUSE_SOFTWARE: u32 = 1;
/// A watchdog was not serviced correctly.
pub const TANDEM_CAUSE_WATCHDOG: u32 = 2;
/// A core trapped or died.
pub const TANDEM_CAUSE_TRAP: u32 = 3;

/// Role: none yet, the system is starting.
pub const TANDEM_ROLE_STARTING: u32 = 0;
/// Role: drives the vehicle.
pub const TANDEM_ROLE_MASTER: u32 = 1;
/// Role: computes silently.
pub const TANDEM_ROLE_STANDBY: u32 = 2;
/// Role: has failed and stays silent.
pub const TANDEM_ROLE_SUSPENDED: u32 = 3;

/// Mode: no driving function.
pub const TANDEM_MODE_NONE: u32 = 0;
/// Mode: automated driving with both systems healthy.
pub const TANDEM_MODE_L3: u32 = 1;
/// Mode: lane and distance keeping by the remaining system.
pub const TANDEM_MODE_DEGRADED_L2: u32 = 2;
/// Mode: bringing the vehicle to a stop.
pub const TANDEM_MODE_SAFE_STOP: u32 = 3;

/// Ability: drives with all sensors.
pub const TANDEM_ABILITY_ALL: u32 = 0;
/// Ability: drives, but a sensor is missing.
pub const TANDEM_ABILITY_LACKS: u32 = 1;
/// Ability: can only stop the vehicle.
pub const TANDEM_ABILITY_STOP_ONLY: u32 = 2;
/// Ability: could only brake.
pub const TANDEM_ABILITY_NONE: u32 = 3;

const _: () = {
    assert!(Ability::All.bits() as u32 == TANDEM_ABILITY_ALL);
    assert!(Ability::Lacks.bits() as u32 == TANDEM_ABILITY_LACKS);
    assert!(Ability::StopOnly.bits() as u32 == TANDEM_ABILITY_STOP_ONLY);
    assert!(Ability::None.bits() as u32 == TANDEM_ABILITY_NONE);
    assert!(Role::Starting as u32 == TANDEM_ROLE_STARTING);
    assert!(Role::Master as u32 == TANDEM_ROLE_MASTER);
    assert!(Role::Standby as u32 == TANDEM_ROLE_STANDBY);
    assert!(Role::Suspended as u32 == TANDEM_ROLE_SUSPENDED);
    assert!(Mode::None as u32 == TANDEM_MODE_NONE);
    assert!(Mode::L3 as u32 == TANDEM_MODE_L3);
    assert!(Mode::DegradedL2 as u32 == TANDEM_MODE_DEGRADED_L2);
    assert!(Mode::SafeStop as u32 == TANDEM_MODE_SAFE_STOP);
};

/// No edge.
pub const TANDEM_EDGE_NONE: u32 = 0;
/// A rising edge.
pub const TANDEM_EDGE_RISING: u32 = 1;
/// A falling edge.
pub const TANDEM_EDGE_FALLING: u32 = 2;

/// No reset.
pub const TANDEM_RESET_NONE: u32 = 0;
/// An orderly restart.
pub const TANDEM_RESET_SOFTWARE: u32 = 1;
/// A core of this system does not answer.
pub const TANDEM_RESET_CORE_DEAD: u32 = 2;
/// Hold the system in reset permanently.
pub const TANDEM_RESET_SUSPEND: u32 = 3;

/// The largest number of events of one call.
pub const TANDEM_MAX_EVENTS: usize = 8;

const _: () = assert!(TANDEM_MAX_EVENTS == Actions::EVENTS);

/// The redundancy of one system. Must be static and initially zero.
#[repr(C)]
#[derive(Debug)]
pub struct TandemRedundancy {
    /// Private.
    pub opaque: [u64; 128],
}

opaque!(TandemRedundancy, Redundancy, 0x0E);

/// The state of the lines and the CAN receiver at one time. Counts only increase, and wrap around;
/// they may start at any value.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct TandemSnapshot {
    /// Rising edges on the start line.
    pub handshakes: u32,
    /// Falling edges on the start line.
    pub syncs: u32,
    /// Edges of either type on heartbeat lines 1 and 2.
    pub beats: [u32; 2],
    /// Not 0 if the other system's power level is high.
    pub peer_powered: u32,
    /// Valid frames received on CAN that neither of the two systems sent.
    pub can_frames: u32,
}

/// The content of a control frame that passed its end-to-end protection.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct TandemControlFrame {
    /// `TANDEM_SYSTEM_A` or `TANDEM_SYSTEM_B`: the sender.
    pub system: u32,
    /// The sender's mastership term.
    pub term: u32,
    /// The sender's `TANDEM_ROLE_…`.
    pub role: u32,
    /// The `TANDEM_MODE_…` that produced the command.
    pub mode: u32,
}

/// A system's report about itself, sent over the link every control cycle and in its status frame.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct TandemReport {
    /// The `TANDEM_ROLE_…` of the system.
    pub role: u32,
    /// The `TANDEM_MODE_…` that it runs.
    pub mode: u32,
    /// The highest term that it has seen or used.
    pub term: u32,
    /// Not 0 if it receives frames on CAN.
    pub can_alive: u32,
    /// The `TANDEM_ABILITY_…` of the system.
    pub ability: u32,
}

/// Words of a report on the link.
pub const TANDEM_REPORT_WORDS: usize = 4;

const _: () = assert!(TANDEM_REPORT_WORDS == LinkReport::WORDS);

/// The actions that the core must carry out now. Flags are 0 or 1.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct TandemActions {
    /// Send a rising edge on the start line.
    pub handshake: u32,
    /// Send a falling edge on the start line; if `handshake` is set too, after that edge.
    pub sync: u32,
    /// A `TANDEM_EDGE_…` to send on both heartbeat lines.
    pub beat: u32,
    /// The output has just opened, or a frame was refused before this poll: if
    /// `tandem_redundancy_may_transmit` returns 1, send a control frame now, not in the next cycle.
    pub transmit_now: u32,
    /// The output has just closed: discard control frames in the transmit buffer.
    pub output_closed: u32,
    /// Dual operation starts now in both systems: align the control cycle to this time.
    pub synchronised: u32,
    /// Write `state` to the flash: pass it to `tandem_store_request`.
    pub persist: u32,
    /// The state to write, if `persist` is 1.
    pub state: TandemState,
    /// A `TANDEM_RESET_…` to request from the supply as soon as the store is settled.
    pub reset: u32,
    /// Number of valid entries of `events`.
    pub event_count: u32,
    /// Events for the trace: each is a kind and two details.
    pub events: [[u32; 3]; TANDEM_MAX_EVENTS],
    /// Latest time of the next poll, in nanoseconds on the clock of `now_ns`.
    pub deadline_ns: u64,
}

impl TandemActions {
    const fn none(deadline: Instant) -> Self {
        Self {
            handshake: 0,
            sync: 0,
            beat: TANDEM_EDGE_NONE,
            transmit_now: 0,
            output_closed: 0,
            synchronised: 0,
            persist: 0,
            state: TandemState::factory(SystemId::A),
            reset: TANDEM_RESET_NONE,
            event_count: 0,
            events: [[0; 3]; TANDEM_MAX_EVENTS],
            deadline_ns: deadline.as_ns(),
        }
    }

    fn send_edge(&mut self, line: Line, edge: Edge) {
        match (line, edge) {
            (Line::Start, Edge::Rising) => self.handshake = 1,
            (Line::Start, Edge::Falling) => self.sync = 1,
            (Line::Heartbeat1 | Line::Heartbeat2, Edge::Rising) => self.beat = TANDEM_EDGE_RISING,
            (Line::Heartbeat1 | Line::Heartbeat2, Edge::Falling) => self.beat = TANDEM_EDGE_FALLING,
            // The redundancy never depends on the time line.
            (Line::Time, _) => {}
        }
    }

    fn record(&mut self, event: RedundancyEvent) {
        if let Some(place) = self.events.get_mut(self.event_count as usize) {
            *place = event.to_words();
            self.event_count += 1;
        }
    }
}

impl From<Actions> for TandemActions {
    #[deny(clippy::wildcard_enum_match_arm, reason = "no action may be forgotten")]
    fn from(actions: Actions) -> Self {
        let mut made = Self::none(actions.deadline());
        for action in actions.iter() {
            match action {
                Action::SendEdge(line, edge) => made.send_edge(line, edge),
                Action::Transmit => made.transmit_now = 1,
                Action::DiscardUnsent => made.output_closed = 1,
                Action::AlignControl => made.synchronised = 1,
                Action::Persist(state) => {
                    made.persist = 1;
                    made.state = state.into();
                }
                Action::Reset(request) => {
                    made.reset = match request {
                        // The redundancy requests no download.
                        ResetRequest::Software | ResetRequest::Download => TANDEM_RESET_SOFTWARE,
                        ResetRequest::CoreDead => TANDEM_RESET_CORE_DEAD,
                        ResetRequest::Suspend => TANDEM_RESET_SUSPEND,
                    }
                }
                Action::Record(event) => made.record(event),
            }
        }
        made
    }
}

fn role(number: u32) -> Result<Role, S> {
    let code = u8::try_from(number).ok();
    code.and_then(Role::from_repr).ok_or(S::OutOfRange)
}

fn mode(number: u32) -> Result<Mode, S> {
    let code = u8::try_from(number).ok();
    code.and_then(Mode::from_repr).ok_or(S::OutOfRange)
}

fn ability(number: u32) -> Result<Ability, S> {
    let bits = u8::try_from(number).ok().filter(|bits| *bits <= 3);
    bits.map(Ability::from_bits).ok_or(S::OutOfRange)
}

impl TandemControlFrame {
    fn checked(&self) -> Result<ControlHeader, S> {
        Ok(ControlHeader {
            system: system_id(self.system)?,
            term: Term::from_bits(self.term),
            role: role(self.role)?,
            mode: mode(self.mode)?,
        })
    }
}

impl TandemReport {
    fn checked(&self) -> Result<PeerReport, S> {
        Ok(PeerReport {
            role: role(self.role)?,
            mode: mode(self.mode)?,
            term: Term::from_bits(self.term),
            can_alive: self.can_alive != 0,
            ability: ability(self.ability)?,
        })
    }
}

impl From<PeerReport> for TandemReport {
    fn from(report: PeerReport) -> Self {
        Self {
            role: report.role as u32,
            mode: report.mode as u32,
            term: report.term.bits(),
            can_alive: report.can_alive.into(),
            ability: report.ability.bits().into(),
        }
    }
}

/// Makes the machine of `system` after the checks at power-on. `cause` is a `TANDEM_CAUSE_…`,
/// `loaded` is the record that the store found in the flash, `now_ns` is the time of the start.
/// Tasks only; does not block.
///
/// `TANDEM_STATUS_OUT_OF_RANGE` if a number is not defined, or the configuration does not fit
/// together.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_redundancy_init(
    machine: *mut TandemRedundancy,
    config: *const TandemConfig,
    system: u32,
    cause: u32,
    loaded: *const TandemLoaded,
    now_ns: u64,
) -> TandemStatus {
    status(|| {
        let (config, loaded) = (cell::read(config)?, cell::read(loaded)?);
        let cause = match cause {
            TANDEM_CAUSE_POWER_ON => ResetCause::PowerOn,
            TANDEM_CAUSE_SOFTWARE => ResetCause::Software,
            TANDEM_CAUSE_WATCHDOG => ResetCause::Watchdog,
            TANDEM_CAUSE_TRAP => ResetCause::Trap,
            _ => return Err(S::OutOfRange),
        };
        let made = Redundancy::new(
            config.checked()?,
            system_id(system)?,
            cause,
            loaded.checked()?,
            Instant::from_ns(now_ns),
        );
        // SAFETY: rules 1 and 3 of the caller's contract.
        unsafe { cell::put(machine, made) }
    })
}

/// Passes an input to the machine, and writes the actions that it returns.
///
/// # Safety
/// Rules 1 and 3 of the caller's contract apply.
unsafe fn pass(
    machine: *mut TandemRedundancy,
    now_ns: u64,
    actions: *mut TandemActions,
    input: impl FnOnce() -> Result<Input, S>,
) -> TandemStatus {
    status(|| {
        let input = input()?;
        cell::writable(actions)?;
        let answer = cell::get(machine)?.on(Instant::from_ns(now_ns), input);
        // SAFETY: rule 1 of the caller's contract.
        unsafe { cell::write(actions, answer.into()) }
    })
}

/// Passes an input that is read from memory of C.
///
/// # Safety
/// Rules 1 and 3 of the caller's contract apply.
unsafe fn pass_read<C: Copy>(
    machine: *mut TandemRedundancy,
    now_ns: u64,
    actions: *mut TandemActions,
    from: *const C,
    input: impl FnOnce(C) -> Result<Input, S>,
) -> TandemStatus {
    pass(machine, now_ns, actions, || input(cell::read(from)?))
}

/// Passes the state of the lines. Call it in each period, and immediately when an edge or the power
/// level interrupts. Pass all frames from the CAN receiver *before* this call. `now_ns` must not
/// decrease. Carry out the actions. Any context; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_redundancy_poll(
    machine: *mut TandemRedundancy,
    now_ns: u64,
    snapshot: *const TandemSnapshot,
    actions: *mut TandemActions,
) -> TandemStatus {
    let input = |seen: TandemSnapshot| {
        Ok(Input::Poll(LineSnapshot {
            handshakes: seen.handshakes,
            syncs: seen.syncs,
            beats: seen.beats,
            peer_powered: seen.peer_powered != 0,
            can_frames: seen.can_frames,
        }))
    };
    pass_read(machine, now_ns, actions, snapshot, input)
}

/// Passes a control frame that was received on CAN. Any context; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_redundancy_control_frame(
    machine: *mut TandemRedundancy,
    now_ns: u64,
    frame: *const TandemControlFrame,
    actions: *mut TandemActions,
) -> TandemStatus {
    let input = |frame: TandemControlFrame| Ok(Input::ControlFrame(frame.checked()?));
    pass_read(machine, now_ns, actions, frame, input)
}

/// Passes a status frame of the other system that was received on CAN. Any context; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_redundancy_status_frame(
    machine: *mut TandemRedundancy,
    now_ns: u64,
    report: *const TandemReport,
    actions: *mut TandemActions,
) -> TandemStatus {
    let input = |report: TandemReport| Ok(Input::StatusFrame(report.checked()?));
    pass_read(machine, now_ns, actions, report, input)
}

/// Passes a datagram that arrived from the other system over the link: `count` words at `words`.
/// Any context; does not block.
///
/// `TANDEM_STATUS_INVALID` if it is not a report.
///
/// # Safety
/// Rules 1 and 3 of the caller's contract apply, for `count` words.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_redundancy_link_report(
    machine: *mut TandemRedundancy,
    now_ns: u64,
    words: *const u32,
    count: usize,
    actions: *mut TandemActions,
) -> TandemStatus {
    let input = || {
        let report = LinkReport::from_words(cell::words(words, count)?);
        Ok(Input::LinkReport(report.ok_or(S::Invalid)?))
    };
    pass(machine, now_ns, actions, input)
}

/// Passes a control frame that was received on CAN with a correct CRC, but a wrong counter: frames
/// were lost, or the sender has restarted. The machine uses only its term; do not use its command.
/// Any context; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_redundancy_stale_frame(
    machine: *mut TandemRedundancy,
    now_ns: u64,
    frame: *const TandemControlFrame,
    actions: *mut TandemActions,
) -> TandemStatus {
    let input = |frame: TandemControlFrame| Ok(Input::StaleFrame(frame.checked()?));
    pass_read(machine, now_ns, actions, frame, input)
}

/// Passes the vehicle's report about the term that it obeys. `term` is that of the control frame
/// that it accepted last, `age_ns` ago; 0 if none. It sent the report `on_the_way_ns` ago, at
/// `sent_ms` on its own clock (only the low eight bits count; below 0 if the report has no time).
/// Any context; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_redundancy_vehicle_term(
    machine: *mut TandemRedundancy,
    now_ns: u64,
    term: u32,
    age_ns: u64,
    sent_ms: i32,
    on_the_way_ns: u64,
    actions: *mut TandemActions,
) -> TandemStatus {
    let has_time = sent_ms >= 0;
    let input = Input::VehicleTerm(ObeyedTerm {
        term: Term::from_bits(term),
        age: Duration::from_ns(age_ns),
        sent: has_time.then_some((sent_ms as u8, Duration::from_ns(on_the_way_ns))),
    });
    pass(machine, now_ns, actions, || Ok(input))
}

/// Passes the term of the vehicle's report if its CRC is correct, but its counter is wrong: another
/// node may send such reports, so a row of unexplained terms begins anew. Any context; does not
/// block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_redundancy_stale_echo(
    machine: *mut TandemRedundancy,
    now_ns: u64,
    term: u32,
    actions: *mut TandemActions,
) -> TandemStatus {
    let input = || Ok(Input::StaleEcho(Term::from_bits(term)));
    pass(machine, now_ns, actions, input)
}

/// Passes a fault that this system found in itself, a `TANDEM_FAILURE_…`. Call it repeatedly while
/// the fault lasts. Any context; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_redundancy_own_fault(
    machine: *mut TandemRedundancy,
    now_ns: u64,
    failure: u32,
    actions: *mut TandemActions,
) -> TandemStatus {
    let input = || Ok(Input::OwnFault(failure_mode(failure)?));
    pass(machine, now_ns, actions, input)
}

/// Passes how well this system can drive, a `TANDEM_ABILITY_…`. It holds until the next call;
/// `TANDEM_ABILITY_ALL` before the first. Any context; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_redundancy_ability(
    machine: *mut TandemRedundancy,
    now_ns: u64,
    able: u32,
    actions: *mut TandemActions,
) -> TandemStatus {
    pass(machine, now_ns, actions, || {
        Ok(Input::Ability(ability(able)?))
    })
}

/// Returns 1 if a control frame may be sent now, otherwise 0. Call it immediately before sending
/// each frame. Any context; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_redundancy_may_transmit(
    machine: *mut TandemRedundancy,
    now_ns: u64,
) -> u32 {
    let now = Instant::from_ns(now_ns);
    cell::get(machine).map_or(0, |machine| machine.may_transmit(now).into())
}

/// Returns the `TANDEM_ROLE_…` for frames; `TANDEM_ROLE_STARTING` without a machine. Any context.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_redundancy_role(machine: *mut TandemRedundancy) -> u32 {
    cell::get(machine).map_or(TANDEM_ROLE_STARTING, |machine| machine.role() as u32)
}

/// Returns the `TANDEM_MODE_…` to run; a standby computes in the master's mode. Any context.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_redundancy_mode(machine: *mut TandemRedundancy) -> u32 {
    cell::get(machine).map_or(TANDEM_MODE_NONE, |machine| machine.mode() as u32)
}

/// Returns the term for control frames; valid while the system is master. Any context.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_redundancy_term(machine: *mut TandemRedundancy) -> u32 {
    cell::get(machine).map_or(0, |machine| machine.term().bits())
}

/// Writes the current report to the other system: the datagram for the link to `words`
/// (`TANDEM_REPORT_WORDS` words), its content for the status frame to `report`. Both may be NULL.
/// Any context; does not block.
///
/// # Safety
/// Rules 1 and 3 of the caller's contract apply; `words` has room for `TANDEM_REPORT_WORDS` words.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_redundancy_report(
    machine: *mut TandemRedundancy,
    now_ns: u64,
    words: *mut u32,
    report: *mut TandemReport,
) -> TandemStatus {
    status(|| {
        let said = cell::get(machine)?.link_report(Instant::from_ns(now_ns));
        cell::write_if_wanted(words.cast::<[u32; TANDEM_REPORT_WORDS]>(), said.to_words())?;
        cell::write_if_wanted(report, said.report.into())
    })
}
