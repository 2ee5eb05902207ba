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
    /// No control frame has reached the vehicle for the third witness's limit.
    Uncontrolled,
    /// The vehicle obeys this term.
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

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_board::Duration;

    /// An echo, and the frame that it reports, is valid exactly until its limit.
    #[test]
    fn an_echo_counts_up_to_its_limit() {
        use GateVerdict::{Obeys, Uncontrolled, Unheard, Unknown};
        let (rt, ns) = (Config::rt(), Duration::from_ns(1));
        let (mute, witness) = (rt.mute_limit(), rt.witness_limit());
        let (none, term) = (Term::NONE, Term::from_bits(16));
        let mut gate = Gate::default();
        let start = Instant::from_ns(1_000_000);
        assert_eq!(gate.verdict(&rt, start + mute + ns), Unknown);
        for (term, age, later, expected) in [
            (term, witness, mute, Obeys(term)),
            (term, witness + ns, mute, Uncontrolled),
            (none, Duration::ZERO, mute, Uncontrolled),
            (term, Duration::ZERO, mute + ns, Unheard),
            (none, witness + ns, mute + ns, Unheard),
        ] {
            let sent = None;
            gate.on_echo(start, ObeyedTerm { term, age, sent });
            assert_eq!(gate.verdict(&rt, start + later), expected);
        }
    }
}
