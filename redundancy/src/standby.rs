//! The phase `Standby`: judges the master, whose control frames are the deciding witness.

use crate::input::Seen;
use crate::starting::Starting;
use crate::witness::{GateVerdict, Witnesses};
use crate::{Config, Evidence, Mode, Role};
use tandem_board::{Duration, Instant, SystemId};

/// What the lines say against the master, the stronger evidence last.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Suspicion {
    None,
    /// It sent a handshake, as a system that starts, or the line was disturbed.
    Handshake,
    /// It was silent on both heartbeat lines.
    Silent,
}

/// The phase `Standby`, with the state of the master as seen in its control frames.
#[derive(Clone, Debug)]
pub(crate) struct Standby {
    system: SystemId,
    /// When this system became standby.
    since: Instant,
    /// When the last valid control frame was heard, or when this system became standby.
    last_control: Instant,
    /// A control frame was heard in this phase.
    control_known: bool,
    /// What points to a failure of the master since its last control frame.
    suspicion: Suspicion,
    /// The lines were silent at the last poll.
    silent: bool,
    /// The start protocol that a sync edge has ended. Kept until there is another sign of a master,
    /// because the edge may have been a disturbance.
    start: Option<Starting>,
    /// The function that this system computes: the master's, as far as a standby can follow it.
    mode: Mode,
    /// After a change of the driver, this system takes over only if the vehicle's echo demands it,
    /// until this time.
    hold_until: Instant,
}

impl Standby {
    /// Creates a standby. `last_control`: when this system last drove, or now.
    pub(crate) const fn new(
        system: SystemId,
        since: Instant,
        last_control: Instant,
        mode: Mode,
        hold_until: Instant,
        start: Option<Starting>,
    ) -> Self {
        Self {
            system,
            since,
            last_control,
            control_known: false,
            suspicion: Suspicion::None,
            silent: false,
            start,
            mode,
            hold_until,
        }
    }

    pub(crate) const fn mode(&self) -> Mode {
        self.mode
    }

    pub(crate) const fn last_control(&self) -> Instant {
        self.last_control
    }

    /// Returns the start protocol that a stray sync edge interrupted, so that it can continue.
    pub(crate) fn interrupted_start(&self) -> Option<Starting> {
        self.start.clone()
    }

    /// Handles a valid control frame of the master, in the highest term.
    pub(crate) fn on_control_frame(&mut self, now: Instant, mode: Mode) {
        self.start = None;
        self.last_control = now;
        self.control_known = true;
        self.suspicion = Suspicion::None;
        self.mode = match mode {
            Mode::L3 => Mode::L3,
            Mode::None | Mode::DegradedL2 | Mode::SafeStop => Mode::DegradedL2,
        };
    }

    /// Handles an echo: the vehicle accepted a frame of the master `age` ago. If the last frame
    /// received here is older by more than the margin, frames were lost, and the master drives.
    pub(crate) fn on_echo(&mut self, config: &Config, now: Instant, age: Duration) {
        self.start = None;
        // This also holds if this system began to listen just before that frame.
        self.control_known = true;
        let unheard = now.since(self.last_control);
        if unheard > age + config.control_margin {
            self.last_control = Instant::from_ns(now.as_ns().saturating_sub(age.as_ns()));
            self.suspicion = Suspicion::None;
        }
    }

    /// Restarts the time limit: a stall of this system is not evidence against the master.
    pub(crate) fn forgive(&mut self, now: Instant) {
        self.last_control = self.last_control.max(now);
    }

    /// Returns whether the master drove within the third witness's limit: this system or the
    /// vehicle received its frame, or its link report says so. A new standby cannot assume it: a
    /// disturbance, or a system that has failed too, may have made it standby.
    pub(crate) fn master_drives(
        &self,
        config: &Config,
        now: Instant,
        witnesses: &Witnesses,
    ) -> bool {
        self.control_known && now.since(self.last_control) <= config.witness_limit()
            || witnesses.reports.drives(now, config.witness_limit())
    }

    /// Returns whether the master has driven without a fault for long enough. Its heartbeats and
    /// control frames, its link report and the vehicle's echo must show it; none may be late.
    pub(crate) fn is_dispensable(
        &self,
        config: &Config,
        now: Instant,
        witnesses: &Witnesses,
    ) -> bool {
        let peer = self.system.peer();
        let obeyed = matches!(witnesses.gate.verdict(config, now),
            GateVerdict::Obeys(term) if term.system() == peer);
        let report = witnesses.reports.fresh(now, config.report_limit);
        let sound = report
            .is_some_and(|report| report.role == Role::Master && report.mode != Mode::SafeStop);
        let late = config.heartbeat_period + config.heartbeat_jitter;
        let beats = witnesses.beats.silent_for(now) <= late;
        let heard = now.since(self.last_control) <= config.control_period + config.heartbeat_jitter;
        now >= self.hold_until
            && obeyed
            && sound
            && beats
            && heard
            && self.suspicion == Suspicion::None
    }

    /// Returns the evidence about the master. `sound`: this system has no fault.
    pub(crate) fn judge(
        &mut self,
        config: &Config,
        now: Instant,
        witnesses: &Witnesses,
        seen: &Seen,
        sound: bool,
    ) -> Option<Evidence> {
        if witnesses.reports.drives(now, config.report_limit) {
            self.start = None;
        }
        if self
            .start
            .as_mut()
            .is_some_and(|start| start.peer_runs(seen))
        {
            self.start = None;
        }
        let evidence = self.judge_master(config, now, witnesses, seen, sound)?;
        let starts = |start: &Starting| !start.is_over(config, now);
        Some(match evidence {
            Evidence::PeerOff | Evidence::PeerSilent | Evidence::MasterMute
                if self.start.as_ref().is_some_and(starts) =>
            {
                Evidence::SyncStray
            }
            // Heartbeats arrive, but no control frame ever did: the other system is a standby too.
            Evidence::PeerSilent | Evidence::MasterMute
                if !self.control_known && !witnesses.beats.both_silent() =>
            {
                Evidence::HandshakeDone
            }
            _ => evidence,
        })
    }

    fn judge_master(
        &mut self,
        config: &Config,
        now: Instant,
        witnesses: &Witnesses,
        seen: &Seen,
        sound: bool,
    ) -> Option<Evidence> {
        let silent = witnesses.beats.both_silent();
        let was_silent = core::mem::replace(&mut self.silent, silent);
        // A handshake alone: the other has just started. A leading system sends a sync edge too.
        let starts = seen.handshakes > 0 && seen.syncs == 0;
        // Remembered until control frames arrive again: a master that was reset may send heartbeats
        // again, as a standby, before the absence of its control frames is detected.
        let suspicion = match silent {
            true => Suspicion::Silent,
            false if starts => Suspicion::Handshake,
            false => Suspicion::None,
        };
        self.suspicion = self.suspicion.max(suspicion);
        // A stray edge made this system a standby. The other system is still starting.
        if starts && !self.control_known && self.no_system_drives(config, now, witnesses) {
            return Some(Evidence::HandshakeDone);
        }
        if witnesses.peer_is_off(config, now) && self.may_act(config, now, witnesses) {
            return Some(Evidence::PeerOff);
        }
        let ended = silent && witnesses.link_ended(config, now, self.last_control);
        let unheard = ended || now.since(self.last_control) > config.witness_limit();
        if unheard {
            let says_master = !ended && witnesses.reports.drives(now, config.witness_limit());
            // If heartbeats arrive again, the vehicle's echo can contradict the suspicion.
            let verdict = witnesses.gate.verdict(config, now);
            let obeyed = !silent && matches!(verdict, GateVerdict::Obeys(_));
            let contradicted = says_master || obeyed;
            let suspected = match self.suspicion {
                Suspicion::None => false,
                // A disturbed line and a lost input are not two signs of a failed master.
                Suspicion::Handshake => !witnesses.can.is_deaf(now, config.witness_limit()),
                Suspicion::Silent => true,
            };
            if suspected && !contradicted && self.may_act(config, now, witnesses) {
                return Some(Evidence::PeerSilent);
            }
            if self.master_is_mute(config, now, witnesses) {
                return Some(Evidence::MasterMute);
            }
        }
        // Only a recent report counts. The master sent it in a control cycle, so the master is
        // deposed before its next cycle.
        let resigns = witnesses.reports.resigns(now, config.stall_limit());
        if resigns && sound && now >= self.hold_until && !witnesses.is_deaf(config, now) {
            return Some(Evidence::MasterResigns);
        }
        (silent && !was_silent).then_some(Evidence::BeatsSilent)
    }

    /// Returns the end, after `now`, of the first limit at which [`Standby::judge`] may find that
    /// the master has failed, if nothing is heard of it until then.
    pub(crate) fn next_limit(
        &self,
        config: &Config,
        now: Instant,
        witnesses: &Witnesses,
    ) -> Instant {
        let control = self.last_control + config.witness_limit();
        let limits = witnesses.limits(config).into_iter().chain([control]);
        // A limit ends when it is exceeded, not when it is reached.
        let ends = limits.map(|limit| limit + Duration::from_ns(1));
        ends.filter(|end| *end > now)
            .min()
            .unwrap_or(Instant::NEVER)
    }

    /// Returns when to look again for the vehicle's echo that no frame arrives; [`Instant::NEVER`]
    /// if none is expected. It may come at any time from a poll after the control period on, and
    /// should not wait for a whole poll interval. `polled`: the last poll.
    pub(crate) fn next_look(&self, config: &Config, polled: Instant) -> Instant {
        let overdue = self.last_control + config.control_period + config.poll_interval;
        let next = overdue.max(polled + Duration::from_ns(config.poll_interval.as_ns() / 4));
        match self.control_known && next < overdue + config.control_period {
            true => next,
            false => Instant::NEVER,
        }
    }

    /// Returns whether neither the other system nor the vehicle has reported a driving system for
    /// long enough.
    fn no_system_drives(&self, config: &Config, now: Instant, witnesses: &Witnesses) -> bool {
        let obeys = matches!(witnesses.gate.verdict(config, now), GateVerdict::Obeys(_));
        let listened = now.since(self.last_control) > config.witness_limit();
        listened && !obeys && !witnesses.reports.drives(now, config.report_limit)
    }

    /// Returns whether the evidence of the lines is enough: the driver has not changed for long
    /// enough, or the vehicle's echo does not contradict it.
    fn may_act(&self, config: &Config, now: Instant, witnesses: &Witnesses) -> bool {
        let denied = match witnesses.gate.verdict(config, now) {
            GateVerdict::Uncontrolled => false,
            // A new standby has not listened for long enough to hear an echo.
            GateVerdict::Unknown => {
                now.since(self.since) <= config.witness_limit() + config.control_period
            }
            GateVerdict::Unheard | GateVerdict::Obeys(_) => true,
        };
        now >= self.hold_until || !denied
    }

    /// Returns whether the master runs, but its control frames do not reach the vehicle. The
    /// vehicle decides, because this system may be the one that does not hear.
    fn master_is_mute(&self, config: &Config, now: Instant, witnesses: &Witnesses) -> bool {
        let age = now.since(self.last_control);
        let verdict = witnesses.gate.verdict(config, now);
        let limit = match verdict {
            _ if !self.control_known => config.no_master_limit(self.system),
            GateVerdict::Uncontrolled => config.witness_limit(),
            _ => config.mute_limit(),
        };
        let no_system_drives = match verdict {
            // After an outage of the whole bus it takes up to a control period to hear the master.
            GateVerdict::Uncontrolled => {
                witnesses.can.alive_for(now) > config.control_period + config.poll_interval
            }
            // The vehicle sends no echo. After an outage of the whole bus it takes up to a control
            // period to hear the master.
            GateVerdict::Unknown => {
                witnesses.can.alive_for(now) > config.witness_limit()
                    || witnesses
                        .reports
                        .fresh(now, config.report_limit)
                        .is_some_and(|report| report.role != Role::Master)
            }
            GateVerdict::Unheard | GateVerdict::Obeys(_) => false,
        };
        age > limit && no_system_drives
    }
}
