//! The machine: evaluates the witnesses in the current phase, follows the transition table, and
//! returns actions.

mod hear;
#[cfg(test)]
mod tests;

use crate::driving::{Driving, Thawed};
use crate::input::{Polls, Seen};
use crate::standby::Standby;
use crate::start_checks::{self, StartDecision};
use crate::starting::Starting;
use crate::transition::{Effect, rule};
use crate::witness::{BeatSender, Witnesses};
use crate::{
    Ability, Action, Actions, Config, Evidence, FailureMode, Input, LineSnapshot, LinkReport,
    Loaded, Mode, PeerReport, Phase, RedundancyEvent, Role, SystemState, Takeover, Term,
};
use tandem_board::{Duration, Edge, Instant, Line, ResetCause, ResetRequest, SystemId};

/// The first term after a start exceeds the highest known one by this much: more masterships than
/// can be missing from the flash after a loss of power.
const TERM_STEP_AT_START: u32 = 8;
/// The same step if no system has reported the highest term since power-on: more masterships than
/// the other system is likely to have had while this system was off. If the term were too low, the
/// vehicle would refuse it and obey no system.
const TERM_STEP_UNHEARD: u32 = 1024;

/// Tells the other system that this one is ready.
const HANDSHAKE: Action = Action::SendEdge(Line::Start, Edge::Rising);
/// Tells the other system to begin now, as standby.
const SYNC: Action = Action::SendEdge(Line::Start, Edge::Falling);

/// The phase and its data.
#[derive(Clone, Debug)]
enum PhaseState {
    Starting(Starting),
    Standby(Standby),
    Master(Driving),
    DegradedMaster(Driving),
    Thawed(Thawed),
    Resetting,
    Suspended,
}

impl PhaseState {
    const fn phase(&self) -> Phase {
        match self {
            Self::Starting(_) => Phase::Starting,
            Self::Standby(_) => Phase::Standby,
            Self::Master(_) => Phase::Master,
            Self::DegradedMaster(_) => Phase::DegradedMaster,
            Self::Thawed(_) => Phase::Thawed,
            Self::Resetting => Phase::Resetting,
            Self::Suspended => Phase::Suspended,
        }
    }

    /// Returns the mastership while the output is open.
    const fn driving(&mut self) -> Option<&mut Driving> {
        match self {
            Self::Master(driving) | Self::DegradedMaster(driving) => Some(driving),
            _ => None,
        }
    }

    /// Returns the mastership that this system holds, even if a stall has interrupted it.
    const fn mastership(&self) -> Option<Driving> {
        match self {
            Self::Master(driving) | Self::DegradedMaster(driving) => Some(*driving),
            Self::Thawed(thawed) => Some(thawed.driving),
            _ => None,
        }
    }
}

/// The redundancy of one system.
///
/// May be called in any context; never blocks; no input makes it panic. Times must not decrease.
#[derive(Clone, Debug)]
pub struct Redundancy {
    config: Config,
    system: SystemId,
    phase: PhaseState,
    state: SystemState,
    /// The fault of this system, from the record in flash or found since the start.
    fault: Option<FailureMode>,
    /// When the other system was last found to have failed.
    peer_failed_at: Instant,
    /// The number of consecutive changes of the driver, and the time of the last one.
    changes: u8,
    changed_at: Instant,
    /// An edge has arrived on the start line, or the missing edge has been reported.
    start_line_tested: bool,
    /// The last state passed to the store.
    persisted: Option<SystemState>,
    /// The record in flash was lost, and the loss has not been reported yet.
    unreported_loss: bool,
    /// The highest term is known well enough: the vehicle or a running system has reported it since
    /// the start, or this system was not off before and its record is whole.
    term_known: bool,
    /// The last term that was ignored and reported.
    ignored: Term,
    beats: BeatSender,
    /// The time of sending of the last report over the link, µs; wraps around.
    reported_us: u32,
    polls: Polls,
    witnesses: Witnesses,
    /// When this system was first ready for a role.
    running_since: Option<Instant>,
    /// This master offers its role to the standby until this time.
    hands_over_until: Option<Instant>,
    /// The standby can drive better.
    is_less_able: bool,
    /// This incarnation has already counted that its command is wrong.
    wrong_counted: bool,
}

impl Redundancy {
    /// Creates a system after the checks of T-RED-7. `loaded` is the store's result, `now` the time
    /// of the start.
    #[must_use]
    pub fn new(
        config: Config,
        system: SystemId,
        cause: ResetCause,
        loaded: Loaded,
        now: Instant,
    ) -> Self {
        let (state, start) = start_checks::check(&config, system, cause, loaded);
        let StartDecision {
            kind,
            claims_master,
            fault,
        } = start;
        let starting = Starting::new(kind, claims_master, system, now);
        Self {
            config,
            system,
            phase: PhaseState::Starting(starting),
            state,
            fault,
            peer_failed_at: now,
            changes: Config::changes_at_start(cause),
            changed_at: now,
            start_line_tested: false,
            persisted: None,
            unreported_loss: loaded == Loaded::Lost,
            term_known: cause != ResetCause::PowerOn
                && matches!(loaded, Loaded::State(it) if it.term == state.term),
            ignored: Term::NONE,
            beats: BeatSender::new(config.heartbeat_period),
            reported_us: (now.as_ns() / 1_000) as u32,
            polls: Polls::new(now),
            witnesses: Witnesses::new(&config, now),
            running_since: None,
            hands_over_until: None,
            is_less_able: false,
            wrong_counted: false,
        }
    }

    /// Handles one input at time `now`.
    pub fn on(&mut self, now: Instant, input: Input) -> Actions {
        let mut actions = Actions::none();
        if core::mem::take(&mut self.unreported_loss) {
            actions.record(RedundancyEvent::StateLost);
        }
        match input {
            Input::Poll(snapshot) => self.poll(now, &snapshot, &mut actions),
            Input::ControlFrame(frame) => self.control_frame(now, frame, &mut actions),
            Input::StatusFrame(report) => self.status_frame(now, report, &mut actions),
            Input::LinkReport(report) => self.link_report_of_peer(now, report, &mut actions),
            Input::StaleFrame(frame) => self.stale_frame(now, frame, &mut actions),
            Input::VehicleTerm(obeyed) => self.vehicle_term(now, obeyed, &mut actions),
            Input::StaleEcho(term) => self.stale_echo(term),
            Input::OwnFault(mode) => self.own_fault(now, mode, &mut actions),
            Input::HandOver => self.hands_over_until = Some(now + self.config.report_limit),
            Input::Ability(own) => self.witnesses.reports.abilities.own = own,
        }
        if self.persisted != Some(self.state) {
            self.persisted = Some(self.state);
            actions.push(Action::Persist(self.state));
        }
        if let Some(request) = self.reset_request() {
            actions.push(Action::Reset(request));
        }
        actions.set_deadline(self.deadline(now));
        actions
    }

    /// Returns the time of the next poll: the end of the poll interval, the next heartbeat, or the
    /// end of a limit after which the master counts as failed. A takeover must not wait for the
    /// next periodic poll, because polls of the two systems are not aligned.
    fn deadline(&self, now: Instant) -> Instant {
        let due = self.beats.due();
        let due = due.min(self.polls.last() + self.config.poll_interval);
        let due = due.min(self.next_limit(now));
        match &self.phase {
            PhaseState::Standby(standby) => {
                due.min(standby.next_look(&self.config, self.polls.last()))
            }
            _ => due,
        }
    }

    /// Returns the end of the next limit after which this system, as a standby, may have to take
    /// over; [`Instant::NEVER`] otherwise. Work that cannot be interrupted should not begin shortly
    /// before.
    #[must_use]
    pub fn next_limit(&self, now: Instant) -> Instant {
        match &self.phase {
            PhaseState::Standby(standby) => standby.next_limit(&self.config, now, &self.witnesses),
            _ => Instant::NEVER,
        }
    }

    /// Returns whether a control frame may be sent now. Check right before sending, for every
    /// frame, and send at once if the answer is yes.
    ///
    /// The answer is no unless the output is open and the last poll is within [`Config::lease`]: a
    /// core that was held up must first poll, to learn whether the other system has taken over. If
    /// it has not, the next poll returns [`Action::Transmit`], so the refused frame is only late. A
    /// core that is frozen between the answer and the transmission can still send one stale frame.
    /// No software can prevent that; the vehicle refuses the frame by its term.
    #[must_use]
    pub fn may_transmit(&mut self, now: Instant) -> bool {
        let since_poll = now.since(self.polls.last());
        let config = &self.config;
        self.phase
            .driving()
            .is_some_and(|driving| driving.may_transmit(config, now, since_poll))
    }

    /// Returns the phase.
    #[must_use]
    pub const fn phase(&self) -> Phase {
        self.phase.phase()
    }

    /// Returns the role, as in the frames.
    #[must_use]
    pub const fn role(&self) -> Role {
        self.phase().role()
    }

    /// Returns the driving function to run. A standby runs the function of the master.
    #[must_use]
    pub const fn mode(&self) -> Mode {
        match &self.phase {
            PhaseState::Starting(_)
            | PhaseState::Thawed(_)
            | PhaseState::Resetting
            | PhaseState::Suspended => Mode::None,
            PhaseState::Master(_) => Mode::L3,
            PhaseState::DegradedMaster(_) if self.fault.is_some() => Mode::SafeStop,
            PhaseState::DegradedMaster(_) => Mode::DegradedL2,
            PhaseState::Standby(standby) => standby.mode(),
        }
    }

    /// Returns the term for control frames; [`Term::NONE`] unless the system has a mastership.
    #[must_use]
    pub fn term(&self) -> Term {
        self.phase
            .mastership()
            .map_or(Term::NONE, |driving| driving.term())
    }

    /// Returns the highest term seen or used, for the status frame.
    #[must_use]
    pub const fn highest_term(&self) -> Term {
        self.state.term
    }

    /// Returns whether this system drives only to stop the vehicle, because resets have not cured a
    /// wrong command. It then sends commands even if they differ a little from what the vehicle
    /// obeys: a stop with steering is better than one without.
    #[must_use]
    pub fn stops_for_its_command(&self) -> bool {
        self.state.sys_failure && self.state.wrong_in_a_row >= start_checks::WRONG_COMMANDS
    }

    /// Returns the current persistent state; it is in flash when the store is settled.
    #[must_use]
    pub const fn state(&self) -> &SystemState {
        &self.state
    }

    /// Returns whether each of the two heartbeat lines is silent.
    #[must_use]
    pub fn lines_silent(&self) -> [bool; 2] {
        self.witnesses.beats.silent()
    }

    /// Returns the heartbeats sent, and received on line 1 and 2; the counts wrap around. T-RED-3
    #[must_use]
    pub fn heartbeat_counts(&self) -> (u32, [u32; 2]) {
        (self.beats.sent(), self.witnesses.beats.received())
    }

    /// Returns whether this system may leave: it is standby, and the other system has driven
    /// without a fault for longer than the hold-down. All witnesses must confirm it. T-BOOT-1
    #[must_use]
    pub fn may_leave(&self, now: Instant) -> bool {
        let (config, witnesses) = (&self.config, &self.witnesses);
        matches!(&self.phase, PhaseState::Standby(standby)
            if standby.is_dispensable(config, now, witnesses))
    }

    /// Returns the report to send to the other system over the link now, every control cycle. Call
    /// this after [`Redundancy::may_transmit`]: a master whose frame was refused does not report
    /// that it drives.
    #[must_use]
    pub fn link_report(&mut self, now: Instant) -> LinkReport {
        let now_us = (now.as_ns() / 1_000) as u32;
        let is_later = now_us.wrapping_sub(self.reported_us) as i32 > 0;
        self.reported_us = if is_later {
            now_us
        } else {
            self.reported_us.wrapping_add(1)
        };
        LinkReport {
            report: self.report(),
            start: (self.state.total_resets & 0x7FF) as u16,
            sent_us: self.reported_us,
        }
    }

    /// Returns this system's report about itself, as in its status frame.
    #[must_use]
    pub fn report(&self) -> PeerReport {
        let drives = |driving: Driving| !driving.is_refused();
        let role = match self.role() {
            Role::Master if !self.phase.mastership().is_some_and(drives) => Role::Starting,
            role => role,
        };
        let mode = match &self.phase {
            // This report makes the standby take over; the control frames on CAN do not change.
            _ if self.offers_role() => Mode::SafeStop,
            _ => self.mode(),
        };
        PeerReport {
            role,
            mode,
            term: self.state.term,
            can_alive: self.witnesses.can.is_alive(),
            ability: self.witnesses.reports.abilities.own,
        }
    }

    /// Returns whether this master offers its role, because it was asked to or because the standby
    /// can drive better.
    #[must_use]
    pub fn offers_role(&self) -> bool {
        match self.phase {
            PhaseState::Master(_) => self.is_less_able || self.hands_over_until.is_some(),
            PhaseState::DegradedMaster(_) => self.is_less_able,
            _ => false,
        }
    }

    /// Returns how well this system can drive.
    #[must_use]
    pub const fn ability(&self) -> Ability {
        self.witnesses.reports.abilities.own
    }

    const fn reset_request(&self) -> Option<ResetRequest> {
        match self.phase {
            PhaseState::Resetting => Some(ResetRequest::CoreDead),
            PhaseState::Suspended => Some(ResetRequest::Suspend),
            _ => None,
        }
    }

    fn poll(&mut self, now: Instant, snapshot: &LineSnapshot, actions: &mut Actions) {
        let seen = self.polls.take(now, snapshot);
        let late = seen
            .since_last
            .is_none_or(|span| span > self.config.stall_limit());
        if late && self.witnesses.forgive(now) {
            // Only polled time counts as silence: a stall of this system is not evidence.
            if let PhaseState::Standby(standby) = &mut self.phase {
                standby.forgive(now);
            }
        }
        if let PhaseState::Starting(starting) = &mut self.phase {
            let span = seen.since_last.unwrap_or(Duration::ZERO);
            starting.forgive(span - self.config.stall_limit());
        }
        self.hands_over_until = self.hands_over_until.filter(|until| now < *until);
        self.witnesses.update(&self.config, now, &seen, actions);
        let reports = &mut self.witnesses.reports;
        let heard = reports.standby_within(now, self.config.status_limit);
        reports.abilities.compare(now, heard);
        self.is_less_able = reports.abilities.offers(now);
        self.note_start_line(now, &seen, actions);
        if self.can_is_open(now) {
            self.own_fault(now, FailureMode::CanOpenCircuit, actions);
        } else if self.fault == Some(FailureMode::CanOpenCircuit) && !self.state.sys_failure {
            self.fault = None;
        }
        if let PhaseState::Starting(starting) = &mut self.phase
            && starting.handshake_due(&self.config, now)
        {
            actions.push(HANDSHAKE);
        }
        if let Some(evidence) = self.judge(now, &seen) {
            self.apply(now, evidence, actions);
        }
        self.obey_fault(now, actions);
        if let Some(driving) = self.phase.driving() {
            if driving.take_refused() {
                actions.push(Action::Transmit);
            }
            if seen.handshakes > 0 {
                // The other system starts while this system drives: the sync edge makes it follow.
                // Send no handshake: another driving system would answer it, and so on without end.
                actions.push(SYNC);
            }
        }
        self.note_health(now);
        if let Some(edge) = self.beats.poll(now) {
            actions.push(Action::SendEdge(Line::Heartbeat1, edge));
            actions.push(Action::SendEdge(Line::Heartbeat2, edge));
        }
    }

    /// Returns the evidence of the witnesses in this phase.
    fn judge(&mut self, now: Instant, seen: &Seen) -> Option<Evidence> {
        let (config, witnesses) = (&self.config, &self.witnesses);
        if let Some(driving) = self.phase.driving()
            && seen.since_last.is_some_and(|span| span > config.lease())
            && driving.may_be_deposed(config, now, witnesses)
        {
            return Some(Evidence::Stalled);
        }
        match &mut self.phase {
            PhaseState::Starting(starting) => starting.judge(config, now, seen),
            PhaseState::Standby(standby) => {
                let sound = self.fault.is_none();
                standby.judge(config, now, witnesses, seen, sound)
            }
            PhaseState::Master(driving) => driving.judge_dual(config, now, witnesses),
            PhaseState::DegradedMaster(driving) => {
                let sound_for = now.since(self.peer_failed_at);
                driving.judge_alone(config, now, witnesses, &self.state, sound_for)
            }
            PhaseState::Thawed(thawed) => thawed.judge(config, now, witnesses),
            PhaseState::Resetting | PhaseState::Suspended => None,
        }
    }

    /// Returns whether this system's CAN connection is open: it hears no third party, but the other
    /// system does. If neither hears any, the whole bus may be dead, and both would suspend
    /// needlessly. Each reset without success doubles the limit. T-RED-6
    fn can_is_open(&self, now: Instant) -> bool {
        let attempts = u32::from(self.state.abn_in_a_row.min(3));
        let limit = self.config.can_open_limit.times(1 << attempts);
        self.witnesses.can.is_silent(now, limit)
            && self
                .witnesses
                .reports
                .fresh(now, self.config.report_limit)
                .is_some_and(|report| report.can_alive)
    }

    /// Handles a fault that this system found in itself. T-RED-5, T-RED-6
    fn own_fault(&mut self, now: Instant, mode: FailureMode, actions: &mut Actions) {
        if mode == FailureMode::None || self.phase() == Phase::Suspended {
            return;
        }
        let is_wrong = matches!(mode, FailureMode::WrongCommand | FailureMode::WrongScene);
        if is_wrong && !core::mem::replace(&mut self.wrong_counted, true) {
            self.state.wrong_in_a_row = self.state.wrong_in_a_row.saturating_add(1);
        }
        let stays = !mode.reset_may_cure();
        // The first fault counts; the first permanent one replaces it.
        if self.fault.is_none() || stays && !self.state.sys_failure {
            self.state.failure_mode = mode;
            self.fault = Some(mode);
        }
        self.state.sys_failure |= stays;
        self.obey_fault(now, actions);
    }

    /// Reacts to a fault of this system. The system leaves only when the other one drives; until
    /// then it stops the vehicle, or stays ready to do so.
    fn obey_fault(&mut self, now: Instant, actions: &mut Actions) {
        let Some(fault) = self.fault else {
            return;
        };
        let stays = self.state.sys_failure;
        let leave = if stays {
            Evidence::FaultSuspend
        } else {
            Evidence::FaultReset
        };
        let (config, witnesses) = (&self.config, &self.witnesses);
        let evidence = match &self.phase {
            _ if fault == FailureMode::TermsExhausted => Evidence::FaultSuspend,
            PhaseState::Master(_) => Evidence::FaultStop,
            PhaseState::Starting(_) if !stays => leave,
            PhaseState::Standby(standby) if standby.master_drives(config, now, witnesses) => {
                // Both systems have a permanent fault: the other one stops the vehicle, and this
                // one is its backup.
                if stays && witnesses.reports.resigns(now, config.report_limit) {
                    return;
                }
                leave
            }
            PhaseState::Resetting => leave,
            _ => return,
        };
        self.apply(now, evidence, actions);
    }

    /// Follows the transition table.
    fn apply(&mut self, now: Instant, on: Evidence, actions: &mut Actions) {
        let rule = rule(self.phase(), on);
        if let Some(effect) = rule.effect {
            self.do_effect(now, effect, actions);
        }
        if let Some(to) = rule.enter {
            self.enter(now, to, on, actions);
        }
    }

    fn do_effect(&mut self, now: Instant, effect: Effect, actions: &mut Actions) {
        match effect {
            Effect::LeadStart => {
                actions.push(HANDSHAKE);
                actions.push(SYNC);
                actions.push(Action::AlignControl);
            }
            Effect::FollowStart => actions.push(Action::AlignControl),
            Effect::MarkPeerFailed => self.set_peer_failed(now, true, actions),
            Effect::MarkPeerRecovered => self.set_peer_failed(now, false, actions),
            Effect::ReportLinesSplit => actions.record(RedundancyEvent::LinesSplit),
        }
    }

    fn set_peer_failed(&mut self, now: Instant, failed: bool, actions: &mut Actions) {
        if failed {
            self.peer_failed_at = now;
        }
        if self.state.cpsys_failure != failed {
            self.state.cpsys_failure = failed;
            actions.record(RedundancyEvent::PeerFailed(failed));
        }
    }

    /// Enters a phase. The phase changes only here.
    fn enter(&mut self, now: Instant, to: Phase, on: Evidence, actions: &mut Actions) {
        let from = self.phase();
        self.note_change(now, from, to);
        let Ok(entered) = self.prepare(now, to, on) else {
            self.own_fault(now, FailureMode::TermsExhausted, actions);
            return;
        };
        let left = core::mem::replace(&mut self.phase, entered);
        actions.record(RedundancyEvent::Phase { from, to, on });
        match (from.is_driving(), to.is_driving()) {
            (true, false) => actions.push(Action::DiscardUnsent),
            (false, true) => actions.push(Action::Transmit),
            _ => {}
        }
        if to.sends_heartbeats() {
            self.beats.start(now);
            self.running_since.get_or_insert(now);
        } else {
            self.beats.stop();
        }
        if let (PhaseState::Standby(standby), true) = (&left, to.is_driving()) {
            actions.record(RedundancyEvent::Takeover(Takeover {
                cause: on,
                since_heartbeat: self.witnesses.beats.silent_for(now),
                since_control: now.since(standby.last_control()),
                term: self.term(),
            }));
        }
        if from == Phase::Starting && matches!(to, Phase::Standby | Phase::Master) {
            let silent_limit = self.config.silent_limit();
            self.witnesses.beats.expect(now + silent_limit);
        }
        match to {
            Phase::Standby => {
                self.state.is_master = false;
                self.set_peer_failed(now, false, actions);
            }
            Phase::Master => {
                self.state.is_master = true;
                self.set_peer_failed(now, false, actions);
            }
            Phase::DegradedMaster => {
                self.state.is_master = true;
                // A fault of this system is not evidence against the other system.
                if on != Evidence::FaultStop {
                    self.set_peer_failed(now, true, actions);
                }
            }
            Phase::Suspended => self.state.sys_failure = true,
            Phase::Starting | Phase::Thawed | Phase::Resetting => {}
        }
    }

    /// Returns the phase `to` with its data. Fails if it needs a term and none is left.
    fn prepare(&mut self, now: Instant, to: Phase, on: Evidence) -> Result<PhaseState, NoTermLeft> {
        Ok(match to {
            Phase::Standby => {
                let mode = match on {
                    Evidence::SyncHeard => Mode::L3,
                    _ => Mode::DegradedL2,
                };
                let hold_until = now + self.config.hold_down_after(self.changes);
                let start = match &self.phase {
                    PhaseState::Starting(start) => Some(start.clone()),
                    _ => None,
                };
                let driven = self.last_driven(now);
                PhaseState::Standby(Standby::new(
                    self.system,
                    now,
                    driven,
                    mode,
                    hold_until,
                    start,
                ))
            }
            Phase::Master => PhaseState::Master(self.drive(now)?),
            Phase::DegradedMaster => PhaseState::DegradedMaster(self.drive(now)?),
            Phase::Thawed => PhaseState::Thawed(Thawed {
                driving: self.drive(now)?,
                dual: matches!(self.phase, PhaseState::Master(_)),
                since: now,
            }),
            Phase::Resetting => PhaseState::Resetting,
            Phase::Suspended => PhaseState::Suspended,
            Phase::Starting => match &self.phase {
                PhaseState::Standby(standby) => standby.interrupted_start(),
                _ => None,
            }
            .map_or(PhaseState::Suspended, PhaseState::Starting),
        })
    }

    /// Returns when this system last drove, if it drives: the frame or report that relieves it may
    /// be wrong, so the limit of the third witness begins with its own last frame. Else returns
    /// `now`.
    fn last_driven(&mut self, now: Instant) -> Instant {
        let period = self.config.control_period;
        let earliest = Instant::from_ns(now.as_ns().saturating_sub(period.as_ns()));
        let driving = self.phase.driving();
        driving.map_or(now, |driving| driving.last_permit().max(earliest))
    }

    /// Returns the mastership in which to drive: the current one, or a new one in a term above all
    /// known ones.
    fn drive(&mut self, now: Instant) -> Result<Driving, NoTermLeft> {
        if let Some(driving) = self.phase.mastership() {
            return Ok(driving);
        }
        let step = match self.phase {
            _ if !self.term_known => TERM_STEP_UNHEARD,
            PhaseState::Starting(_) => TERM_STEP_AT_START,
            _ => 1,
        };
        let term = self.next_term(step).or_else(|_| self.next_term(1))?;
        Ok(Driving::new(term, now))
    }

    /// Returns a term `step` masterships above the highest known one; it becomes the highest.
    fn next_term(&mut self, step: u32) -> Result<Term, NoTermLeft> {
        let term = self.state.term.above(step, self.system).ok_or(NoTermLeft)?;
        self.state.term = term;
        Ok(term)
    }

    /// Counts consecutive changes of the driver. The hold-down grows with them.
    fn note_change(&mut self, now: Instant, from: Phase, to: Phase) {
        if from.changes_driver(to) {
            let ago = now.since(self.changed_at);
            self.changes = self.config.changes_after(self.changes, ago);
            self.changed_at = now;
        }
    }

    /// Tests the start line: an edge of the other system must have arrived since the start. A
    /// missing edge is reported once, when both systems have run for long enough.
    fn note_start_line(&mut self, now: Instant, seen: &Seen, actions: &mut Actions) {
        self.start_line_tested |= seen.handshakes > 0 || seen.syncs > 0;
        let alive_for = self.witnesses.beats.alive_for(now);
        if !self.start_line_tested && alive_for >= self.config.recover_after {
            self.start_line_tested = true;
            actions.record(RedundancyEvent::StartLineSilent);
        }
    }

    /// A long time without a reset subtracts one from the counts of abnormal resets and of wrong
    /// commands. If crashes occur more often than this, the system eventually suspends, even if
    /// they are far apart. T-RED-5
    fn note_health(&mut self, now: Instant) {
        let healthy = self
            .running_since
            .is_some_and(|since| now.since(since) >= self.config.healthy_after);
        if healthy && self.fault.is_none() && self.phase().sends_heartbeats() {
            self.running_since = Some(now);
            self.state.abn_in_a_row = self.state.abn_in_a_row.saturating_sub(1);
            self.state.wrong_in_a_row = self.state.wrong_in_a_row.saturating_sub(1);
        }
    }
}

/// All terms are used up.
struct NoTermLeft;
