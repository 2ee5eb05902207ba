//! Evidence from frames and reports of the other system, and from the vehicle.

use super::Redundancy;
use crate::{
    Actions, ControlFrame, Event, Evidence, FailureMode, Mode, PeerReport, Phase, Role, Term,
};
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

    /// Whether the other has said for long enough that it drives and hears the bus. One that is cut
    /// off believes for a while that the bus is alive, and takes over because it hears nobody.
    pub(super) fn claim_holds(&mut self, now: Instant, report: PeerReport) -> bool {
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
    pub(super) fn report(
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

    /// The highest term that the vehicle has accepted. If the other drove in it now, its control
    /// frames would have deposed this master before; so the vehicle must say it twice before the
    /// term is raised.
    pub(super) fn vehicle_term(&mut self, now: Instant, term: Term, actions: &mut Actions) {
        self.term_known = true;
        self.state.term = self.state.term.max(term);
        let higher = self.phase.is_driving() && term > self.term;
        if higher && self.outvoted {
            self.raise_term(now, actions);
        }
        self.outvoted = higher && term > self.term;
    }

    pub(super) fn raise_term(&mut self, now: Instant, actions: &mut Actions) {
        match self.state.term.above(1, self.system) {
            Some(term) => {
                self.term = term;
                self.state.term = term;
                actions.events.push(Event::TermRaised(term));
            }
            None => self.own_fault(now, FailureMode::TermsExhausted, actions),
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
