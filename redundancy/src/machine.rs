//! The machine: gathers evidence from inputs, applies the transition table, says what to do.

use crate::boot::{self, Boot};
use crate::can_watch::CanWatch;
use crate::start::{Seen, Start, StartKind, Verdict};
use crate::{
    Actions, BeatReceiver, BeatSender, Config, ControlFrame, Event, Evidence, FailureMode, Input,
    LineChange, Loaded, Mode, PeerReport, Phase, Role, Snapshot, SystemState, Takeover, Term, next,
};
use tandem_board::{Instant, ResetCause, ResetRequest, SystemId};

/// How far the first term after a start lies above the highest known one: more masterships than can have
/// gone unwritten when the power failed.
const TERM_STEP_AT_START: u32 = 8;
/// The same if nobody has told the highest term since power-on: more masterships than the other is likely
/// to have had while this system was off. A term that the vehicle refuses would leave nobody driving.
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
    /// The highest term is known well enough: told since the start, or the system was not off before.
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
    /// Since when the peer says over the link, without a pause, that it drives in a higher term and hears
    /// the bus.
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
    /// A system after the checks of T-RED-7. `loaded` is what the store found in flash, `now` the time
    /// of the start.
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

    /// Whether a control frame may be sent now. Ask right before sending, for every frame, and send at
    /// once if the answer is yes.
    ///
    /// The answer is no unless the output is open and the last poll is within [`Config::lease`]: a core
    /// that was held up must first look whether the other system has taken over meanwhile. If it has not,
    /// the next poll says [`Actions::transmit_now`], so the frame that was refused is only late. A core that
    /// is frozen between the answer and the transmission can still send one stale frame; no software can
    /// prevent that, and the vehicle refuses it by its term.
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

    fn poll(&mut self, now: Instant, snapshot: Snapshot, actions: &mut Actions) {
        let last = *self.last.get_or_insert_with(|| {
            self.beats = BeatReceiver::new(self.config.silent_limit(), snapshot.beats, now);
            self.can = CanWatch::new(snapshot.can_frames, now);
            self.last_poll = now;
            snapshot
        });
        self.last = Some(snapshot);
        let held_up = now.since(self.last_poll);
        if held_up > self.config.stall_limit() {
            // Silence is what was listened to: own absence is no evidence against the other.
            self.beats.forgive(now);
            self.can.forgive(now);
            self.last_control = self.last_control.max(now);
        }
        let new_beats = self.watch_lines(now, &last, &snapshot, actions);
        self.watch_can(now, &snapshot, actions);
        self.last_poll = now;

        let overdue = held_up > self.config.lease();
        match self.phase {
            Phase::Starting => self.poll_start(now, &last, &snapshot, new_beats, actions),
            Phase::Standby => {
                // A handshake is a word of a system that has just started, so it does not drive.
                self.suspected |= snapshot.handshakes != last.handshakes;
                self.poll_standby(now, actions);
            }
            Phase::Master | Phase::DegradedMaster => {
                if overdue && self.may_be_deposed(now, new_beats) {
                    self.apply(now, Evidence::Stalled, actions);
                } else {
                    self.poll_driving(now, actions);
                }
            }
            Phase::Thawed => self.poll_thawed(now, actions),
            Phase::Resetting | Phase::Suspended => {}
        }
        if self.phase.is_driving() && snapshot.handshakes != last.handshakes {
            // The other starts while this system drives: tell it to follow.
            actions.handshake = true;
            actions.sync = true;
        }
        if core::mem::take(&mut self.refused) && self.phase.is_driving() {
            actions.transmit_now = true;
        }
        self.note_health(now);
        actions.beat = self.beat_sender.poll(now);
    }

    /// Updates what is known from the lines; returns the number of new heartbeats.
    fn watch_lines(
        &mut self,
        now: Instant,
        last: &Snapshot,
        snapshot: &Snapshot,
        actions: &mut Actions,
    ) -> u32 {
        for (line, change) in (1..).zip(self.beats.update(now, snapshot.beats)) {
            match change {
                Some(LineChange::Silent) => actions.events.push(Event::LineSilent(line)),
                Some(LineChange::Back) => actions.events.push(Event::LineBack(line)),
                None => {}
            }
        }
        let new = |line: usize| snapshot.beats[line].wrapping_sub(last.beats[line]);
        let new_beats = new(0).max(new(1));
        if snapshot.peer_powered {
            self.peer_low_since = None;
            self.level_broken = false;
        } else if self.peer_low_since.is_none() {
            self.peer_low_since = Some(now);
        } else if new_beats > 0 {
            self.note_life(now);
        }
        new_beats
    }

    /// A sign of life of the other. If its power level has been low for longer than anything can be
    /// under way, the level line is broken and is not believed until it is high again.
    fn note_life(&mut self, now: Instant) {
        let under_way = self.config.witness_limit();
        if self
            .peer_low_since
            .is_some_and(|since| now.since(since) > under_way)
        {
            self.level_broken = true;
        }
    }

    fn peer_off(&self) -> bool {
        self.peer_low_since.is_some() && !self.level_broken
    }

    /// The other system is powered and its heartbeats come.
    fn peer_is_there(&self) -> bool {
        !self.peer_off() && !self.beats.both_silent()
    }

    fn watch_can(&mut self, now: Instant, snapshot: &Snapshot, actions: &mut Actions) {
        self.can
            .update(now, snapshot.can_frames, self.config.witness_limit());
        let silent = self.can.silent_for(now) > self.config.can_open_limit;
        if silent != self.can_silent {
            self.can_silent = silent;
            actions.events.push(Event::CanSilent(silent));
        }
        // Nothing heard may also mean that the whole bus is dead, and then both systems would suspend.
        // Only if the other hears what this one does not is the own connection open. T-RED-6
        let limit = self.config.report_limit;
        let peer_hears = self
            .peer_link
            .is_some_and(|(report, at)| report.can_alive && now.since(at) <= limit);
        if silent && peer_hears {
            self.own_fault(now, FailureMode::CanOpenCircuit, actions);
        }
    }

    fn poll_start(
        &mut self,
        now: Instant,
        last: &Snapshot,
        snapshot: &Snapshot,
        beats: u32,
        actions: &mut Actions,
    ) {
        let seen = Seen {
            handshakes: snapshot.handshakes.wrapping_sub(last.handshakes),
            syncs: snapshot.syncs.wrapping_sub(last.syncs),
            beats,
            control_frame: self.control_while_starting,
            peer_off: self.peer_off(),
        };
        let (handshake, verdict) = self.start.poll(&self.config, now, seen);
        actions.handshake = handshake;
        let Some(verdict) = verdict else { return };
        match verdict {
            Verdict::FollowSync => {
                actions.synchronised = true;
                self.apply(now, Evidence::SyncHeard, actions);
                self.peer_mode = Mode::L3;
            }
            Verdict::Join => self.apply(now, Evidence::PeerRuns, actions),
            Verdict::Lead => {
                actions.handshake = true;
                actions.sync = true;
                actions.synchronised = true;
                self.apply(now, Evidence::HandshakeDone, actions);
            }
            Verdict::Alone => self.apply(now, Evidence::NobodyThere, actions),
            Verdict::PeerOff => self.apply(now, Evidence::PeerOff, actions),
        }
    }

    fn poll_standby(&mut self, now: Instant, actions: &mut Actions) {
        let control_age = now.since(self.last_control);
        let silent = self.beats.both_silent();
        // A silence is remembered until control frames come again: a master that was reset may be back
        // with its heartbeats, as a standby, before the third witness has spoken.
        self.suspected |= silent;
        if self.peer_off() {
            self.apply(now, Evidence::PeerOff, actions);
        } else if self.suspected && control_age > self.config.witness_limit() {
            self.apply(now, Evidence::PeerSilent, actions);
        } else if !silent && self.master_is_mute(now) {
            self.apply(now, Evidence::MasterMute, actions);
        } else if silent && !self.lines_split {
            // The third witness speaks for the master: the lines are cut, not the system.
            actions.events.push(Event::LinesSplit);
        }
        self.lines_split = silent && self.phase == Phase::Standby;
    }

    /// Heartbeats come, but control frames do not.
    fn master_is_mute(&self, now: Instant) -> bool {
        let age = now.since(self.last_control);
        // After an outage of the whole bus the master needs a control period to be heard again.
        let bus_alive = self.can.alive_for(now) > self.config.witness_limit();
        if self.control_known {
            return age > self.config.mute_limit() && bus_alive;
        }
        let master_reported = self.peer_link.is_some_and(|(report, at)| {
            report.role == Role::Master && now.since(at) <= self.config.report_limit
        });
        age > self.config.no_master_limit(self.system) && (bus_alive || !master_reported)
    }

    fn poll_driving(&mut self, now: Instant, actions: &mut Actions) {
        let gone =
            self.beats.both_silent() && self.beats.silent_for(now) > self.config.standby_limit;
        if self.phase == Phase::Master {
            if self.peer_off() {
                self.apply(now, Evidence::PeerOff, actions);
            } else if gone {
                self.apply(now, Evidence::BeatsSilent, actions);
            }
            return;
        }
        let alive_for = self.beats.alive_for(now);
        if self.peer_off() || gone {
            self.set_peer_failed(true, actions);
        } else if alive_for >= self.config.recover_after {
            self.apply(now, Evidence::BeatsBack, actions);
        }
        // A backup that is not heard on CAN is none.
        let limit = self.config.can_open_limit;
        let heard = self
            .peer_standby_at
            .is_some_and(|at| now.since(at) <= limit);
        let stable = !self.state.cpsys_failure && alive_for >= self.config.recover_after.times(2);
        if self.config.reintegrate && stable && heard && !self.stopping {
            self.apply(now, Evidence::PeerStable, actions);
        }
    }

    fn poll_thawed(&mut self, now: Instant, actions: &mut Actions) {
        if self.peer_off() {
            self.apply(now, Evidence::PeerOff, actions);
        } else if now.since(self.thawed_at) > self.config.mute_limit() {
            self.apply(now, Evidence::ListenOver, actions);
        }
    }

    /// Whether the other may have taken over since this master last showed a sign of life. It may not
    /// have before the third witness was silent for its limit, nor if it is not there.
    fn may_be_deposed(&self, now: Instant, new_beats: u32) -> bool {
        let others = self.peer_is_there() || new_beats > 0 || self.peer_standby_at.is_some();
        let earliest = self.last_permit + self.config.witness_limit();
        others && !self.peer_off() && now >= earliest
    }

    fn control_frame(&mut self, now: Instant, frame: ControlFrame, actions: &mut Actions) {
        let peer = self.system.peer();
        let plausible =
            frame.system == peer && frame.term.system() == peer && frame.role == Role::Master;
        if !plausible {
            actions.events.push(Event::Implausible);
            return;
        }
        self.note_life(now);
        self.control_while_starting = true;
        self.term_known = true;
        if frame.term < self.state.term {
            // Fenced off by the vehicle, so nobody is driven by it.
            if self.stale_told != frame.term {
                self.stale_told = frame.term;
                actions.events.push(Event::StaleTerm(frame.term));
            }
            return;
        }
        self.state.term = frame.term;
        match self.phase {
            Phase::Standby => {
                self.last_control = now;
                self.control_known = true;
                self.suspected = false;
                self.peer_mode = standby_mode(frame.mode);
            }
            _ => self.apply(now, Evidence::HigherTerm, actions),
        }
    }

    /// Whether the other has said for long enough that it drives and hears the bus. One that is cut off
    /// believes for a while that the bus is alive, and takes over because it hears nobody.
    fn claim_holds(&mut self, now: Instant, report: PeerReport) -> bool {
        let claims = report.role == Role::Master && report.can_alive && report.term > self.term;
        if !claims {
            self.peer_claims_since = None;
            return false;
        }
        let since = *self.peer_claims_since.get_or_insert(now);
        now.since(since) >= self.config.mute_limit()
    }

    /// The other's word about itself. `reaches_bus`: what it sends as a master reaches the vehicle.
    /// Closing for a master that the vehicle cannot hear would leave nobody driving.
    fn report(
        &mut self,
        now: Instant,
        report: PeerReport,
        reaches_bus: bool,
        actions: &mut Actions,
    ) {
        self.note_life(now);
        self.term_known = true;
        self.state.term = self.state.term.max(report.term);
        if report.term <= self.term {
            return;
        }
        if report.role == Role::Master && report.term.system() == self.system.peer() {
            if reaches_bus {
                self.apply(now, Evidence::HigherTerm, actions);
            }
        } else if self.phase.is_driving() {
            // The vehicle may know that higher term too and refuse this one.
            self.raise_term(now, actions);
        }
    }

    /// The highest term that the vehicle has accepted. If the other drove in it now, its control frames
    /// would have deposed this master before; so the vehicle must say it twice before the term is raised.
    fn vehicle_term(&mut self, now: Instant, term: Term, actions: &mut Actions) {
        self.term_known = true;
        self.state.term = self.state.term.max(term);
        let higher = self.phase.is_driving() && term > self.term;
        if higher && self.outvoted {
            self.raise_term(now, actions);
        }
        self.outvoted = higher && term > self.term;
    }

    fn raise_term(&mut self, now: Instant, actions: &mut Actions) {
        match self.state.term.above(1, self.system) {
            Some(term) => {
                self.term = term;
                self.state.term = term;
                actions.events.push(Event::TermRaised(term));
            }
            None => self.own_fault(now, FailureMode::TermsExhausted, actions),
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

    /// A term to drive in: above all known ones, unless this system still has one. `false` if no term is
    /// left.
    fn take_term(&mut self, from: Phase) -> bool {
        let step = match from {
            Phase::Starting | Phase::Standby if !self.term_known => TERM_STEP_UNHEARD,
            Phase::Starting => TERM_STEP_AT_START,
            Phase::Standby => 1,
            // Between the driving phases, and after a stall: had the other taken over unheard, a new term
            // would depose it.
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

/// What a standby computes while the master drives in `mode`.
const fn standby_mode(mode: Mode) -> Mode {
    match mode {
        Mode::L3 => Mode::L3,
        Mode::None | Mode::DegradedL2 | Mode::SafeStop => Mode::DegradedL2,
    }
}
