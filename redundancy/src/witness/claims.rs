//! The witness of terms that no rule explains: such a term counts only if a second source reports
//! it too, because one word may be wrong although its protection is right.

use crate::Term;
use tandem_board::{Duration, Instant};

/// A claim is forgotten after this time: ten control periods.
const REMEMBERED: Duration = Duration::from_ms(100);

/// Who reports a term.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Source {
    /// The vehicle's echo.
    Vehicle = 0,
    /// The other system on CAN: a control frame, or a status frame as master.
    Frame = 1,
    /// The other system over the link, as master.
    Link = 2,
}

/// The last far term of each source.
#[derive(Clone, Debug, Default)]
pub(crate) struct Claims {
    last: [Option<(Term, Instant)>; 3],
    /// How many echoes in a row contain the same far term.
    echoes: u8,
    vehicle_heard: bool,
}

impl Claims {
    /// Notes that the vehicle sent an echo with a term that the rules explain.
    pub(crate) fn on_explained_echo(&mut self) {
        self.on_disputed();
        self.vehicle_heard = true;
    }

    /// Notes that another node may send in the vehicle's name.
    pub(crate) fn on_disputed(&mut self) {
        (self.last[Source::Vehicle as usize], self.echoes) = (None, 0);
    }

    /// Takes a far term. Returns whether it counts: the vehicle and the other system report it, or
    /// `enough` echoes in a row do. If the vehicle was never heard, CAN and link are two sources.
    pub(crate) fn on_far_term(
        &mut self,
        now: Instant,
        term: Term,
        source: Source,
        enough: Option<u8>,
    ) -> bool {
        let before = self.last[source as usize].replace((term, now));
        if source == Source::Vehicle {
            self.vehicle_heard = true;
            let again = before.is_some_and(|(last, _)| last == term);
            self.echoes = if again {
                self.echoes.saturating_add(1)
            } else {
                1
            };
        }
        let [vehicle, frame, link] = self.last.map(|claim| {
            claim.is_some_and(|(last, at)| last == term && now.since(at) <= REMEMBERED)
        });
        let two = match self.vehicle_heard {
            true => vehicle && (frame || link),
            false => frame && link,
        };
        let repeated = source == Source::Vehicle
            && term <= Term::LAST_UNEXPLAINED
            && enough.is_some_and(|enough| self.echoes >= enough);
        term <= Term::LAST && (two || repeated)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use Source::{Frame, Link, Vehicle};
    use std::vec::Vec;

    const TERM: Term = Term::from_bits(1_000_001);

    /// Returns which of these reports (ms, source, term) count.
    fn counted(reports: &[(u64, Source, Term)], enough: Option<u8>) -> Vec<bool> {
        let mut claims = Claims::default();
        let reports = reports.iter().map(|&(ms, source, term)| {
            let now = Instant::from_ns(ms * 1_000_000);
            claims.on_far_term(now, term, source, enough)
        });
        reports.collect()
    }

    /// T-RED-9: a far term counts if the vehicle and the other system report the same one within
    /// the time. Two reports of the other system do not replace a vehicle that was heard.
    #[test]
    fn a_far_term_needs_two_sources() {
        let other = Term::from_bits(1_000_003);
        let last = |reports: &[(u64, Source, Term)]| *counted(reports, None).last().unwrap();
        assert!(last(&[(0, Vehicle, TERM), (100, Frame, TERM)]));
        assert!(last(&[(0, Link, TERM), (100, Vehicle, TERM)]));
        assert!(!last(&[(0, Vehicle, TERM), (101, Frame, TERM)]));
        assert!(!last(&[(0, Vehicle, other), (1, Frame, TERM)]));
        assert!(!last(&[
            (0, Vehicle, other),
            (1, Frame, TERM),
            (2, Link, TERM)
        ]));
        assert!(last(&[(0, Frame, TERM), (1, Link, TERM)]), "no vehicle");
        let end = Term::from_bits(Term::LAST.bits() + 2);
        assert!(!last(&[(0, Vehicle, end), (1, Frame, end), (2, Link, end)]));
    }

    /// T-RED-9: echoes alone count if enough of them in a row agree, and leave terms for the
    /// future.
    #[test]
    fn echoes_in_a_row_count_together() {
        let echoes = |term| [(0, Vehicle, term), (10, Vehicle, term), (20, Vehicle, term)];
        assert_eq!(counted(&echoes(TERM), Some(3)), [false, false, true]);
        assert_eq!(counted(&echoes(TERM), None), [false; 3]);
        let high = Term::from_bits(Term::LAST_UNEXPLAINED.bits() + 1);
        assert_eq!(counted(&echoes(high), Some(2)), [false; 3]);
        let mut claims = Claims::default();
        for ms in 0..9 {
            let now = Instant::from_ns(ms * 1_000_000);
            assert!(!claims.on_far_term(now, TERM, Vehicle, Some(2)));
            claims.on_explained_echo();
        }
    }
}
