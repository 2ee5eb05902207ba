//! The sensors' round: what comes in within each period, and when all of it is there.
//!
//! The sensors are not synchronised with this core, and do not tell their phase. The end of a round
//! is where the longest pause begins: a cycle there has the freshest lists.

use tandem_board::{Duration, Instant};
use tandem_bus::SensorId;

/// The lists of all sensors by [`SensorId::index`], and the camera's lanes.
const MEMBERS: usize = SensorId::ALL.len() + 1;
/// The camera's lanes as a member.
pub(super) const LANES: usize = SensorId::ALL.len();

/// When the members of one round were there as a whole.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Round([Option<Instant>; MEMBERS]);

impl Round {
    pub(super) fn add(&mut self, member: usize, at: Instant) {
        self.0[member] = Some(at);
    }

    /// Whether the round has members, and `is_there` holds for each.
    pub(super) fn is_complete(&self, is_there: impl FnMut(usize) -> bool) -> bool {
        let mut members = (0..MEMBERS).filter(|member| self.0[*member].is_some());
        self.0.iter().any(Option::is_some) && members.all(is_there)
    }

    /// When the next round ends, the first time after `now`; `None` if this one has no members.
    pub(super) fn next_end(&self, now: Instant, period: Duration) -> Option<Instant> {
        let period = period.as_ns();
        let phase = |at: Instant| at.as_ns() % period;
        let arrivals = || self.0.iter().flatten().copied();
        // The pause after an arrival lasts until the next arrival of any member.
        let pause = |from: Instant| {
            let until = |to: Instant| match (phase(to) + period - phase(from)) % period {
                0 => period,
                pause => pause,
            };
            arrivals().map(until).min()
        };
        let end = arrivals().max_by_key(|at| pause(*at))?;
        let left = period - (now.as_ns() + period - phase(end)) % period;
        Some(now + Duration::from_ns(left))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Duration = Duration::from_ms(50);

    fn at(ms: u64) -> Instant {
        Instant::from_ns(ms * 1_000_000)
    }

    fn round(arrivals: &[u64]) -> Round {
        let mut round = Round::default();
        for (member, ms) in arrivals.iter().enumerate() {
            round.add(member, at(*ms));
        }
        round
    }

    #[test]
    fn a_round_ends_where_the_longest_pause_begins_wherever_the_cycle_began() {
        // Phases 0, 3 .. 15 and 16 ms, cut anywhere.
        for cut in 0..50 {
            let arrivals =
                [0, 3, 6, 9, 12, 15, 16].map(|ms| if ms > cut { ms + 100 } else { ms + 150 });
            let end = round(&arrivals).next_end(at(150 + cut), PERIOD);
            let expected = if cut < 16 { 166 } else { 216 };
            assert_eq!(end, Some(at(expected)), "cut at {cut} ms");
        }
    }

    #[test]
    fn one_member_is_a_round_and_none_is_no_round() {
        assert_eq!(round(&[7]).next_end(at(7), PERIOD), Some(at(57)));
        assert_eq!(Round::default().next_end(at(7), PERIOD), None);
        assert!(!Round::default().is_complete(|_| true));
    }

    #[test]
    fn who_missed_the_last_round_is_not_waited_for() {
        let mut last = Round::default();
        last.add(2, at(6));
        last.add(LANES, at(16));
        assert!(last.is_complete(|member| member == 2 || member == LANES));
        assert!(!last.is_complete(|member| member != LANES));
    }
}
