//! The reaction to frames and reports of the other system, and to the vehicle's echo.

use super::{PhaseState, Redundancy};
use crate::witness::GateVerdict;
use crate::{
    Actions, ClockOwner, ControlHeader, Evidence, FailureMode, LinkReport, ObeyedTerm, PeerReport,
    Phase, RedundancyEvent, Role, Term,
};
use tandem_board::{Duration, Instant};

impl Redundancy {
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
        self.term_known = true;
        if let PhaseState::Starting(starting) = &mut self.phase {
            starting.on_control_frame();
        }
        if frame.term < self.state.term {
            // The vehicle refuses this frame, so its sender does not drive.
            if self.stale_reported != frame.term {
                self.stale_reported = frame.term;
                actions.record(RedundancyEvent::StaleTerm(frame.term));
            }
            return;
        }
        self.state.term = frame.term;
        if self.phase() != Phase::Standby {
            self.peer_drives(now, actions);
        }
        if let PhaseState::Standby(standby) = &mut self.phase {
            standby.on_control_frame(now, frame.mode);
        }
    }

    /// A received status frame shows that its sender reaches the bus.
    pub(super) fn status_frame(&mut self, now: Instant, report: PeerReport, actions: &mut Actions) {
        self.witnesses.reports.on_status(now, report);
        self.report_of_peer(now, report, true, actions);
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
        let obeyed = self.witnesses.gate.verdict(&self.config, now) == GateVerdict::Obeys(own);
        let reaches_bus =
            !obeyed && claimed_for.is_some_and(|span| span >= self.config.mute_limit());
        self.report_of_peer(now, report, reaches_bus, actions);
        self.judge_clocks(now, actions);
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
        reaches_bus: bool,
        actions: &mut Actions,
    ) {
        self.witnesses.on_life(&self.config, now, actions);
        // A system that has just started may not know the newest terms itself.
        self.term_known |= matches!(report.role, Role::Master | Role::Standby);
        self.state.term = self.state.term.max(report.term);
        if report.term <= self.term() {
            return;
        }
        if report.role == Role::Master && report.term.system() == self.system.peer() {
            if reaches_bus {
                self.peer_drives(now, actions);
            }
        } else if self.phase().is_driving() {
            // The vehicle may have seen that higher term too, and would then refuse this one.
            self.raise_term(now, actions);
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
        self.term_known = true;
        if frame.term > self.state.term {
            self.state.term = frame.term;
            self.peer_drives(now, actions);
        }
    }

    /// Handles the vehicle's echo. If the obeyed term is above this master's term, the vehicle
    /// refuses this master: it follows if the other system drives, and takes a higher term if no
    /// system drives in that term any more. For a standby the echo is a witness of the master.
    pub(super) fn vehicle_term(&mut self, now: Instant, obeyed: ObeyedTerm, actions: &mut Actions) {
        let ObeyedTerm { term, age, sent } = obeyed;
        let ago = |span: Duration| Instant::from_ns(now.as_ns().saturating_sub(span.as_ns()));
        if let Some((sent_ms, on_the_way)) = sent {
            self.witnesses.clocks.on_vehicle(ago(on_the_way), sent_ms);
            self.judge_clocks(now, actions);
        }
        self.term_known = true;
        self.state.term = self.state.term.max(term);
        self.witnesses.gate.on_echo(now, obeyed);
        let of_peer = term.system() == self.system.peer();
        let drives = of_peer && term != Term::NONE && age <= self.config.witness_limit();
        if drives {
            self.witnesses.on_life(&self.config, ago(age), actions);
        }
        let higher = term > self.term();
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
            && driving.note_refusal(higher)
        {
            self.raise_term(now, actions);
        }
    }

    fn raise_term(&mut self, now: Instant, actions: &mut Actions) {
        match self.next_term(1) {
            Ok(term) => {
                if let Some(driving) = self.phase.driving() {
                    driving.raise(term);
                }
                actions.record(RedundancyEvent::TermRaised(term));
            }
            Err(_) => self.own_fault(now, FailureMode::TermsExhausted, actions),
        }
    }
}
