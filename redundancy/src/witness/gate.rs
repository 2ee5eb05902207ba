//! The witness of the vehicle: its echo of the system that it obeys.

use crate::{Config, ObeyedTerm, Term};
use tandem_board::Instant;

/// The meaning of the vehicle's last echo.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum GateVerdict {
    /// The vehicle was never heard: it sends no echo, or this system does not hear it.
    Unknown,
    /// The vehicle was heard before, but no longer: it is off, or this system is deaf.
    Unheard,
    /// No system has reached it for the third witness's limit.
    Uncontrolled,
    /// It obeys this term.
    Obeys(Term),
}

/// The vehicle's last echo.
#[derive(Clone, Debug, Default)]
pub(crate) struct Gate {
    last: Option<(ObeyedTerm, Instant)>,
}

impl Gate {
    pub(crate) fn on_echo(&mut self, now: Instant, obeyed: ObeyedTerm) {
        self.last = Some((obeyed, now));
    }

    pub(crate) fn verdict(&self, config: &Config, now: Instant) -> GateVerdict {
        match self.last {
            None => GateVerdict::Unknown,
            // Two echoes may be lost.
            Some((_, at)) if now.since(at) > config.mute_limit() => GateVerdict::Unheard,
            Some((ObeyedTerm { term, age, .. }, _))
                if term == Term::NONE || age > config.witness_limit() =>
            {
                GateVerdict::Uncontrolled
            }
            Some((ObeyedTerm { term, .. }, _)) => GateVerdict::Obeys(term),
        }
    }
}
