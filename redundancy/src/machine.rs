//! The machine: gathers evidence from inputs, applies the transition table, says what to do.

mod hear;
mod poll;

use crate::boot::{self, Boot};
use crate::can_watch::CanWatch;
use crate::start::{Start, StartKind};
use crate::{
    Actions, BeatReceiver, BeatSender, Config, Event, Evidence, FailureMode, Input, Loaded, Mode,
    PeerReport, Phase, Role, Snapshot, SystemState, Takeover, Term, next,
};
use tandem_board::{Instant, ResetCause, ResetRequest, SystemId};

/// How far the first term after a start lies above the highest known one: more masterships than can
/// have gone unwritten when the power failed.
const TERM_STEP_AT_START: u32 = 8;
/// The same if nobody has told the highest term since power-on: more masterships than the other is
/// likely to have had while this system was off. A term that the vehicle refuses would leave nobody
/// driving.
const TERM_STEP_UNHEARD: u32 = 1024;

/// The redundancy of one system.
///
/// Any context, never blocks, never panics whatever the inputs are. Times must not go back.
#[derive(Clone, Debug)]
pub struct Redundancy {
    config: Config,
    system: SystemId,
    phase: Phase,
    start: Start,
    state: SystemState,
    /// What was last handed out to be written.
    written: Option<SystemState>,
    /// The term that this system drives in, once it drives.
    term: Term,
    /// The highest term is known well enough: told since the start, or the system was not off
    /// before.
    term_known: bool,
    /// The vehicle was heard to obey a higher term than this master's.
    outvoted: bool,
    beat_sender: BeatSender,
    beats: BeatReceiver,
    can: CanWatch,
    last: Option<Snapshot>,
    last_poll: Instant,
    /// When it last was permitted to transmit.
    last_permit: Instant,
    /// A transmission was refused because the last poll was too long ago.
    refused: bool,
    /// When the peer's last valid control frame was heard, or when this system became standby.
    last_control: Instant,
    control_known: bool,
    control_while_starting: bool,
    peer_mode: Mode,
    peer_low_since: Option<Instant>,
    /// The level line says "off" while the peer is seen to live.
    level_broken: bool,
    /// The peer's last word over the link, and when.
    peer_link: Option<(PeerReport, Instant)>,
    /// Since when the peer says over the link, without a pause, that it drives in a higher term
    /// and hears the bus.
    peer_claims_since: Option<Instant>,
    /// When the peer was last heard on CAN as standby.
    peer_standby_at: Option<Instant>,
    running_since: Option<Instant>,
    thawed_at: Instant,
    stopping: bool,
    can_silent: bool,
    lines_split: bool,
    /// The master was silent or in its start since its last control frame.
    suspected: bool,
    stale_told: Term,
    pending: Option<Event>,
    reset: Option<ResetRequest>,
}

impl Redundancy {
    /// A system after the checks of T-RED-7. `loaded` is what the store found in flash, `now` the
    /// time of the start.
    #[must_use]
    pub fn new(
        config: Config,
        system: SystemId,
        cause: ResetCause,
        loaded: Loaded,
        now: Instant,
    ) -> Self {
        let (state, verdict) = boot::check(&config, system, cause, loaded);
        let (phase, kind, claims_master) = match verdict {
            Boot::Suspend => (Phase::Suspended, StartKind::Listen, false),
            Boot::Start {
                kind,
                claims_master,
            } => (Phase::Starting, kind, claims_master),
        };
        let suspended = phase == Phase::Suspended;
        Self {
            config,
            system,
            phase,
            start: Start::new(kind, claims_master, system, now),
            state,
            written: None,
            term: Term::NONE,
            term_known: cause != ResetCause::PowerOn,
            outvoted: false,
            beat_sender: BeatSender::new(config.heartbeat_period),
            beats: BeatReceiver::new(config.silent_limit(), [0; 2], now),
            can: CanWatch::new(0, now),
            last: None,
            last_poll: now,
            last_permit: now,
            refused: false,
            last_control: now,
            control_known: false,
            control_while_starting: false,
            peer_mode: Mode::DegradedL2,
            peer_low_since: None,
            level_broken: false,
            peer_link: None,
            peer_claims_since: None,
            peer_standby_at: None,
            running_since: None,
            thawed_at: now,
            stopping: false,
            can_silent: false,
            lines_split: false,
            suspected: false,
            stale_told: Term::NONE,
            pending: matches!(loaded, Loaded::Lost).then_some(Event::StateLost),
            reset: suspended.then_some(ResetRequest::Suspend),
        }
    }

    /// Takes one input at time `now`.
    pub fn on(&mut self, now: Instant, input: Input) -> Actions {
        let mut actions = Actions::none(now);
        if let Some(event) = self.pending.take() {
            actions.events.push(event);
        }
        match input {
            Input::Poll(snapshot) => self.poll(now, snapshot, &mut actions),
            Input::ControlFrame(frame) => self.control_frame(now, frame, &mut actions),
            Input::StatusFrame(report) => {
                if report.role == Role::Standby {
                    self.peer_standby_at = Some(now);
                }
                self.report(now, report, true, &mut actions);
            }
            Input::LinkReport(report) => {
                self.peer_link = Some((report, now));
                let reaches_bus = self.claim_holds(now, report);
                self.report(now, report, reaches_bus, &mut actions);
            }
            Input::VehicleTerm(term) => self.vehicle_term(now, term, &mut actions),
            Input::OwnFault(mode) => self.own_fault(now, mode, &mut actions),
        }
        if self.written != Some(self.state) {
            self.written = Some(self.state);
            actions.persist = Some(self.state);
        }
        actions.reset = self.reset;
        let poll_due = self.last_poll + self.config.poll_interval;
        actions.deadline = poll_due.min(self.beat_sender.due());
        actions
    }

    /// Whether a control frame may be sent now. Ask right before sending, for every frame, and send
    /// at once if the answer is yes.
    ///
    /// The answer is no unless the output is open and the last poll is within [`Config::lease`]: a
    /// core that was held up must first look whether the other system has taken over meanwhile. If
    /// it has not, the next poll says [`Actions::transmit_now`], so the frame that was refused is
    /// only late. A core that is frozen between the answer and the transmission can still send one
    /// stale frame; no software can prevent that, and the vehicle refuses it by its term.
    #[must_use]
    pub fn may_transmit(&mut self, now: Instant) -> bool {
        let leased = now.since(self.last_poll) <= self.config.lease();
        let granted = self.phase.is_driving() && leased;
        if granted {
            self.last_permit = now;
        }
        self.refused = self.phase.is_driving() && !leased;
        granted
    }

    /// The phase.
    #[must_use]
    pub const fn phase(&self) -> Phase {
        self.phase
    }

    /// The role, as in the frames.
    #[must_use]
    pub const fn role(&self) -> Role {
        self.phase.role()
    }

    /// The driving function to run. A standby computes what the master drives.
    #[must_use]
    pub const fn mode(&self) -> Mode {
        match self.phase {
            Phase::Starting | Phase::Thawed | Phase::Resetting | Phase::Suspended => Mode::None,
            Phase::Master => Mode::L3,
            Phase::DegradedMaster if self.stopping => Mode::SafeStop,
            Phase::DegradedMaster => Mode::DegradedL2,
            Phase::Standby => self.peer_mode,
        }
    }

    /// The term for control frames; meaningful while the system drives.
    #[must_use]
    pub const fn term(&self) -> Term {
        self.term
    }

    /// The highest term seen or used, for the status frame.
    #[must_use]
    pub const fn highest_term(&self) -> Term {
        self.state.term
    }

    /// The persistent state as it is now; it is in flash when the store is settled.
    #[must_use]
    pub const fn state(&self) -> &SystemState {
        &self.state
    }

    /// Whether heartbeat line 1 and 2 are silent.
    #[must_use]
    pub fn lines_silent(&self) -> [bool; 2] {
        self.beats.silent()
    }

    /// Heartbeats sent, and received on line 1 and 2; wrap around. T-RED-3
    #[must_use]
    pub fn heartbeat_counts(&self) -> (u32, [u32; 2]) {
        (self.beat_sender.sent(), self.beats.received())
    }

    /// What to tell the other system over the link every control cycle.
    #[must_use]
    pub fn link_report(&self) -> PeerReport {
        PeerReport {
            role: self.role(),
            mode: self.mode(),
            term: self.state.term,
            can_alive: self.can.is_alive(),
        }
    }

    fn own_fault(&mut self, now: Instant, mode: FailureMode, actions: &mut Actions) {
        if mode == FailureMode::None || matches!(self.phase, Phase::Suspended) {
            return;
        }
        let alone = matches!(self.phase, Phase::DegradedMaster) && !self.peer_is_there();
        // Without CAN or a term there is nothing left to drive with.
        let can_drive = !matches!(
            mode,
            FailureMode::CanOpenCircuit | FailureMode::TermsExhausted
        );
        if self.state.failure_mode != mode && !self.state.sys_failure {
            self.state.failure_mode = mode;
        }
        if !mode.reset_may_cure() {
            self.state.sys_failure = true;
        }
        let evidence = if alone && can_drive {
            Evidence::FaultStop
        } else if mode.reset_may_cure() {
            Evidence::FaultReset
        } else {
            Evidence::FaultSuspend
        };
        self.stopping |= evidence == Evidence::FaultStop;
        self.apply(now, evidence, actions);
    }

    fn set_peer_failed(&mut self, failed: bool, actions: &mut Actions) {
        if self.state.cpsys_failure != failed {
            self.state.cpsys_failure = failed;
            actions.events.push(Event::PeerFailed(failed));
        }
    }

    /// Follows the transition table.
    fn apply(&mut self, now: Instant, on: Evidence, actions: &mut Actions) {
        if on == Evidence::BeatsBack {
            self.set_peer_failed(false, actions);
        }
        if on == Evidence::HigherTerm && self.peer_low_since.is_some() {
            // It drives without power: the level line is broken.
            self.level_broken = true;
        }
        let Some(to) = next(self.phase, on) else {
            return;
        };
        let from = self.phase;
        if to.is_driving() && !self.take_term(from) {
            self.own_fault(now, FailureMode::TermsExhausted, actions);
            return;
        }
        self.phase = to;
        actions.events.push(Event::Phase { from, to, on });
        actions.output_closed = from.is_driving() && !to.is_driving();
        actions.transmit_now = to.is_driving() && !from.is_driving();
        if actions.transmit_now {
            self.last_permit = now;
        }
        if to.sends_heartbeats() {
            self.beat_sender.start(now);
            self.running_since.get_or_insert(now);
        } else {
            self.beat_sender.stop();
        }
        if from == Phase::Standby && to == Phase::DegradedMaster {
            actions.events.push(Event::Takeover(Takeover {
                cause: on,
                since_heartbeat: self.beats.silent_for(now),
                since_control: now.since(self.last_control),
                term: self.term,
            }));
        }
        self.enter(now, from, actions);
    }

    fn enter(&mut self, now: Instant, from: Phase, actions: &mut Actions) {
        if from == Phase::Starting && matches!(self.phase, Phase::Standby | Phase::Master) {
            self.beats.expect(now + self.config.silent_limit());
        }
        match self.phase {
            Phase::Starting => {}
            Phase::Standby => {
                self.state.is_master = false;
                self.last_control = now;
                self.control_known = false;
                self.suspected = false;
                self.peer_mode = Mode::DegradedL2;
                self.set_peer_failed(false, actions);
            }
            Phase::Master => {
                self.state.is_master = true;
                self.set_peer_failed(false, actions);
            }
            Phase::DegradedMaster => {
                self.state.is_master = true;
                self.set_peer_failed(true, actions);
            }
            Phase::Thawed => self.thawed_at = now,
            Phase::Resetting => self.reset = Some(ResetRequest::CoreDead),
            Phase::Suspended => {
                self.state.sys_failure = true;
                self.reset = Some(ResetRequest::Suspend);
            }
        }
    }

    /// A term to drive in: above all known ones, unless this system still has one. `false` if no
    /// term is left.
    fn take_term(&mut self, from: Phase) -> bool {
        let step = match from {
            Phase::Starting | Phase::Standby if !self.term_known => TERM_STEP_UNHEARD,
            Phase::Starting => TERM_STEP_AT_START,
            Phase::Standby => 1,
            // Between the driving phases, and after a stall: had the other taken over unheard, a
            // new term would depose it.
            _ => return true,
        };
        let Some(term) = self.state.term.above(step, self.system) else {
            return false;
        };
        self.term = term;
        self.state.term = term;
        true
    }

    /// A long time without a reset ends a row of abnormal ones. T-RED-5
    fn note_health(&mut self, now: Instant) {
        let healthy = self
            .running_since
            .is_some_and(|since| now.since(since) >= self.config.healthy_after);
        if healthy && self.phase.sends_heartbeats() {
            self.state.abn_in_a_row = 0;
        }
    }
}
