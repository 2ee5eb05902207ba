//! The reaction to frames and reports of the other system, and to the vehicle's echo.

use super::{NoTermLeft, PhaseState, Redundancy};
use crate::witness::{GateVerdict, Source};
use crate::{
    Actions, ClockOwner, ControlHeader, Evidence, FailureMode, LinkReport, Mode, ObeyedTerm,
    PeerReport, Phase, RedundancyEvent, Role, Term,
};
use tandem_board::{Duration, Instant};

/// So many echoes in a row with the same far term are believed without a second witness: by a
/// system that drives and whose frames the vehicle refuses, and by one that does not know the
/// highest term.
const ECHOES_TO_A_DRIVER: u8 = 10;
const ECHOES_TO_A_STARTED_SYSTEM: u8 = 2;

impl Redundancy {
    /// Returns whether a received term may be used. A term far above the highest known one must
    /// have a second witness. A lower one is harmless; if it is far below and has two witnesses,
    /// the known term was wrong, and the lower one replaces it.
    fn accepts(&mut self, now: Instant, term: Term, source: Source, actions: &mut Actions) -> bool {
        if term.is_far_from(self.state.term) && term != Term::NONE {
            let enough = match self.phase.driving() {
                _ if !self.term_known => Some(ECHOES_TO_A_STARTED_SYSTEM),
                Some(_) => Some(ECHOES_TO_A_DRIVER),
                None => None,
            };
            let claims = &mut self.witnesses.claims;
            if claims.on_far_term(now, term, source, enough) {
                self.state.term = term;
            }
        } else if source == Source::Vehicle {
            self.witnesses.claims.on_explained_echo();
        }
        self.is_usable(term, actions)
    }

    /// Returns whether a term is not far above the highest known one. Reports each other term once.
    fn is_usable(&mut self, term: Term, actions: &mut Actions) -> bool {
        let usable = term <= self.state.term || !term.is_far_from(self.state.term);
        if !usable && core::mem::replace(&mut self.ignored, term) != term {
            actions.record(RedundancyEvent::FarTerm(term));
        }
        usable
    }

    /// Returns whether a correct peer can have sent this frame.
    fn is_of_peer(&self, frame: ControlHeader) -> bool {
        let peer = self.system.peer();
        frame.system == peer && frame.term.system() == peer && frame.role == Role::Master
    }

    pub(super) fn control_frame(
        &mut self,
        now: Instant,
        frame: ControlHeader,
        actions: &mut Actions,
    ) {
        if !self.is_of_peer(frame) {
            actions.record(RedundancyEvent::Implausible);
            return;
        }
        self.witnesses.on_life(&self.config, now, actions);
        if let PhaseState::Starting(starting) = &mut self.phase {
            starting.on_control_frame();
        }
        if !self.accepts(now, frame.term, Source::Frame, actions) {
            return;
        }
        self.term_known = true;
        if frame.term < self.state.term {
            // The vehicle refuses this frame, so its sender does not drive.
            if core::mem::replace(&mut self.ignored, frame.term) != frame.term {
                actions.record(RedundancyEvent::StaleTerm(frame.term));
            }
            return;
        }
        self.state.term = frame.term;
        // The vehicle's echo says whether the frame that relieves this master acts.
        let driven = self.last_driven(now);
        if self.phase() != Phase::Standby {
            self.peer_drives(now, actions);
        }
        if let PhaseState::Standby(standby) = &mut self.phase {
            standby.on_control_frame(driven, frame.mode);
        }
    }

    /// A received status frame shows that its sender reaches the bus.
    pub(super) fn status_frame(&mut self, now: Instant, report: PeerReport, actions: &mut Actions) {
        self.witnesses.reports.on_status(now, report);
        self.report_of_peer(now, report, Source::Frame, true, actions);
    }

    /// Handles a report over the link. The other system's claim to drive counts only after it has
    /// lasted long enough: a system that is cut off from the bus assumes for some time that the bus
    /// is alive, and takes over because it hears no master.
    pub(super) fn link_report_of_peer(
        &mut self,
        now: Instant,
        link: LinkReport,
        actions: &mut Actions,
    ) {
        if !self.witnesses.is_new(&self.config, now, &link) {
            return;
        }
        let LinkReport { report, .. } = link;
        let own = self.term();
        let claimed_for = self.witnesses.reports.on_link(now, report, own);
        let reaches_bus = !self.is_obeyed(now)
            && claimed_for.is_some_and(|span| span >= self.config.mute_limit());
        self.report_of_peer(now, report, Source::Link, reaches_bus, actions);
        self.judge_clocks(now, actions);
    }

    /// Returns whether the vehicle has accepted this master's frames until now.
    fn is_obeyed(&self, now: Instant) -> bool {
        self.witnesses.gate.verdict(&self.config, now) == GateVerdict::Obeys(self.term())
    }

    /// Compares three clocks: the one that differs from both others is wrong. If that is this
    /// system's own clock, the system leaves, because all its time limits are wrong too.
    fn judge_clocks(&mut self, now: Instant, actions: &mut Actions) {
        if let Some(clock) = self.witnesses.clocks.judge(now) {
            actions.record(RedundancyEvent::ClockWrong(clock));
            if clock == ClockOwner::Own {
                self.own_fault(now, FailureMode::Clock, actions);
            }
        }
    }

    /// Takes a report of the other system about itself. `reaches_bus`: the vehicle would receive
    /// its control frames. A master must not close its output for a system that the vehicle cannot
    /// hear.
    fn report_of_peer(
        &mut self,
        now: Instant,
        report: PeerReport,
        source: Source,
        reaches_bus: bool,
        actions: &mut Actions,
    ) {
        self.witnesses.on_life(&self.config, now, actions);
        let drives = report.role == Role::Master && report.term.system() == self.system.peer();
        // A system that does not drive repeats a term that it has heard, and is no witness of it.
        let usable = match drives {
            true => self.accepts(now, report.term, source, actions),
            false => self.is_usable(report.term, actions),
        };
        if !usable {
            return;
        }
        // A system that has just started may not know the newest terms itself.
        self.term_known |= matches!(report.role, Role::Master | Role::Standby);
        self.state.term = self.state.term.max(report.term);
        if report.term <= self.term() {
            return;
        }
        if drives {
            if reaches_bus {
                self.peer_drives(now, actions);
            }
        } else if self.phase().is_driving() {
            // The vehicle may have seen that higher term too, and would then refuse this one.
            self.raise_term(actions);
        }
    }

    /// Handles evidence that the other system drives in a higher term.
    fn peer_drives(&mut self, now: Instant, actions: &mut Actions) {
        self.witnesses.on_drive(actions);
        self.apply(now, Evidence::HigherTerm, actions);
    }

    /// Handles a control frame with a right CRC and a wrong counter.
    pub(super) fn stale_frame(
        &mut self,
        now: Instant,
        frame: ControlHeader,
        actions: &mut Actions,
    ) {
        if !self.is_of_peer(frame) {
            actions.record(RedundancyEvent::Implausible);
            return;
        }
        let known = self.state.term;
        if !self.accepts(now, frame.term, Source::Frame, actions) {
            return;
        }
        self.term_known = true;
        if frame.term > known {
            self.state.term = frame.term;
            // The vehicle may refuse this frame, too, and obey this master until the next one.
            let is_relieved = self.report().mode == Mode::SafeStop;
            if is_relieved || !self.is_obeyed(now) {
                self.peer_drives(now, actions);
            }
        }
    }

    /// Handles the vehicle's echo. If the obeyed term is above this master's term, the vehicle
    /// refuses this master: it follows if the other system drives, and takes a higher term if no
    /// system drives in that term any more. For a standby the echo is a witness of the master.
    pub(super) fn vehicle_term(&mut self, now: Instant, obeyed: ObeyedTerm, actions: &mut Actions) {
        let ObeyedTerm { term, age, sent } = obeyed;
        let ago = |span: Duration| Instant::from_ns(now.as_ns().saturating_sub(span.as_ns()));
        let of_peer = term.system() == self.system.peer();
        let drives = of_peer && term != Term::NONE && age <= self.config.witness_limit();
        // A term below the known one replaces it only if the other system drives in it.
        let is_old = term < self.state.term && !drives;
        if is_old {
            self.witnesses.claims.on_explained_echo();
        } else if !self.accepts(now, term, Source::Vehicle, actions) {
            if let Some(driving) = self.phase.driving() {
                driving.note_refusal(true);
            }
            return;
        }
        if let Some((sent_ms, on_the_way)) = sent {
            self.witnesses.clocks.on_vehicle(ago(on_the_way), sent_ms);
            self.judge_clocks(now, actions);
        }
        self.term_known = true;
        self.state.term = self.state.term.max(term);
        self.witnesses.gate.on_echo(now, obeyed);
        if drives {
            self.witnesses.on_life(&self.config, ago(age), actions);
        }
        // After a fall of the known term the vehicle refuses this master's.
        let higher = term > self.term() || self.state.term < self.term();
        if let PhaseState::Thawed(thawed) = &self.phase
            && term == thawed.driving.term()
            && thawed.is_kept(&self.config, age)
        {
            let resumes = match thawed.dual {
                true => Evidence::PeerStable,
                false => Evidence::ListenOver,
            };
            self.apply(now, resumes, actions);
        } else if let PhaseState::Standby(standby) = &mut self.phase {
            if drives && term == self.state.term {
                standby.on_echo(&self.config, now, age);
            }
        } else if higher && drives {
            self.peer_drives(now, actions);
        } else if let Some(driving) = self.phase.driving()
            && (driving.note_refusal(higher) || higher && !of_peer)
        {
            // No other system drives in a term of this one: no second echo is needed.
            self.raise_term(actions);
        }
    }

    /// Handles an echo with a right CRC and a wrong counter.
    pub(super) fn stale_echo(&mut self, term: Term) {
        if !term.is_far_from(self.state.term) {
            self.witnesses.claims.on_disputed();
        }
    }

    fn raise_term(&mut self, actions: &mut Actions) {
        match self.next_term(1) {
            Ok(term) => {
                if let Some(driving) = self.phase.driving() {
                    driving.raise(term);
                }
                actions.record(RedundancyEvent::TermRaised(term));
            }
            // A system that drives continues: its frames may still act.
            Err(NoTermLeft) => actions.record(RedundancyEvent::FarTerm(self.state.term)),
        }
    }
}
