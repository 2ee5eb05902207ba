//! What the machine does with frames and reports of the other system, and with the vehicle's word.

use super::{PhaseState, Redundancy};
use crate::{Actions, ControlFrame, Event, Evidence, FailureMode, PeerReport, Role, Term};
use tandem_board::Instant;

impl Redundancy {
    pub(super) fn control_frame(
        &mut self,
        now: Instant,
        frame: ControlFrame,
        actions: &mut Actions,
    ) {
        let peer = self.system.peer();
        let plausible =
            frame.system == peer && frame.term.system() == peer && frame.role == Role::Master;
        if !plausible {
            actions.record(Event::Implausible);
            return;
        }
        self.witnesses.on_life(&self.config, now);
        self.term_known = true;
        if let PhaseState::Starting(starting) = &mut self.phase {
            starting.on_control_frame();
        }
        if frame.term < self.state.term {
            // The vehicle refuses it, so it drives nothing.
            if self.stale_told != frame.term {
                self.stale_told = frame.term;
                actions.record(Event::StaleTerm(frame.term));
            }
            return;
        }
        self.state.term = frame.term;
        match &mut self.phase {
            PhaseState::Standby(standby) => standby.on_control_frame(now, frame.mode),
            _ => self.peer_drives(now, actions),
        }
    }

    /// Its sender reaches the bus, since it was heard there.
    pub(super) fn status_frame(&mut self, now: Instant, report: PeerReport, actions: &mut Actions) {
        self.witnesses.reports.on_status(now, report);
        self.report(now, report, true, actions);
    }

    /// The other's claim to drive counts when it has held for long enough. A system that is cut off
    /// from the bus believes for a while that the bus is alive, and takes over because it hears no
    /// master.
    pub(super) fn link_report_of_peer(
        &mut self,
        now: Instant,
        report: PeerReport,
        actions: &mut Actions,
    ) {
        let own = self.term();
        let claimed_for = self.witnesses.reports.on_link(now, report, own);
        let reaches_bus = claimed_for.is_some_and(|span| span >= self.config.mute_limit());
        self.report(now, report, reaches_bus, actions);
    }

    /// The other's word about itself. `reaches_bus`: what it sends as a master reaches the vehicle.
    /// A master that closed for one which the vehicle cannot hear would leave the vehicle without
    /// control.
    fn report(
        &mut self,
        now: Instant,
        report: PeerReport,
        reaches_bus: bool,
        actions: &mut Actions,
    ) {
        self.witnesses.on_life(&self.config, now);
        self.term_known = true;
        self.state.term = self.state.term.max(report.term);
        if report.term <= self.term() {
            return;
        }
        if report.role == Role::Master && report.term.system() == self.system.peer() {
            if reaches_bus {
                self.peer_drives(now, actions);
            }
        } else if self.phase().is_driving() {
            // The vehicle may know that higher term too and refuse this one.
            self.raise_term(now, actions);
        }
    }

    /// The other drives in a term that is higher than this system's.
    fn peer_drives(&mut self, now: Instant, actions: &mut Actions) {
        self.witnesses.level.on_drive();
        self.apply(now, Evidence::HigherTerm, actions);
    }

    /// The highest term that the vehicle has accepted. If the other drove in it now, its control
    /// frames would have deposed this master before. So the term is raised only when the vehicle
    /// has said it twice.
    pub(super) fn vehicle_term(&mut self, now: Instant, term: Term, actions: &mut Actions) {
        self.term_known = true;
        self.state.term = self.state.term.max(term);
        let outvoted = self
            .phase
            .driving()
            .is_some_and(|driving| driving.is_outvoted(term));
        if outvoted {
            self.raise_term(now, actions);
        }
    }

    fn raise_term(&mut self, now: Instant, actions: &mut Actions) {
        match self.next_term(1) {
            Ok(term) => {
                if let Some(driving) = self.phase.driving() {
                    driving.raise(term);
                }
                actions.record(Event::TermRaised(term));
            }
            Err(_) => self.own_fault(now, FailureMode::TermsExhausted, actions),
        }
    }
}
