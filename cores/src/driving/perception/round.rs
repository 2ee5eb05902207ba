//! The sensors' round: what arrives in each period, and when it is complete.
//!
//! The sensors are not synchronised with this core, and do not report their phase. A round ends
//! where the longest pause begins: a cycle at that time has the freshest lists.

use tandem_board::{Duration, Instant};
use tandem_bus::SensorId;

/// The lists of all sensors by [`SensorId::index`], and the camera's lanes.
const MEMBERS: usize = SensorId::ALL.len() + 1;
/// The camera's lanes as a member.
pub(super) const LANES: usize = SensorId::ALL.len();

/// When each member of one round was complete.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Round {
    members: [Option<Instant>; MEMBERS],
    /// Members that were complete before this time are not part of the next round.
    next_since: Instant,
}

impl Round {
    pub(super) fn add(&mut self, member: usize, at: Instant) {
        self.members[member] = Some(at);
    }

    /// Moves all times by this many nanoseconds.
    pub(super) fn shift(&mut self, by_ns: i64) {
        let times = self.members.iter_mut().flatten();
        for at in times.chain([&mut self.next_since]) {
            *at = at.moved(by_ns);
        }
    }

    /// Returns whether this round has members and all are complete again. `arrived`: when each was
    /// complete.
    pub(super) fn is_next_complete(
        &self,
        mut arrived: impl FnMut(usize) -> Option<Instant>,
    ) -> bool {
        let mut members = (0..MEMBERS).filter(|member| self.members[*member].is_some());
        self.members.iter().any(Option::is_some)
            && members.all(|member| arrived(member).is_some_and(|at| at > self.next_since))
    }

    /// Returns the first end of a round after `now`; `None` if this round has no members.
    ///
    /// The next round begins in the middle of the pause. A member that arrives before that is late
    /// and belongs to the old round; else it would count as punctual and be a period old each time.
    /// If a member is early by more than half of the pause, one cycle waits until its time-out.
    pub(super) fn next_end(&mut self, now: Instant, period: Duration) -> Option<Instant> {
        let period = period.as_ns();
        let phase = |at: Instant| at.as_ns() % period;
        let arrivals = || self.members.iter().flatten().copied();
        // The pause after an arrival lasts until the next arrival of any member.
        let pause = |from: Instant| {
            let until = |to: Instant| match (phase(to) + period - phase(from)) % period {
                0 => period,
                pause => pause,
            };
            arrivals().map(until).min()
        };
        let end = arrivals().max_by_key(|at| pause(*at))?;
        let pause = pause(end).unwrap_or(period);
        let left = period - (now.as_ns() + period - phase(end)) % period;
        let next_end = now + Duration::from_ns(left);
        let since = (next_end.as_ns() + pause / 2).saturating_sub(period);
        self.next_since = Instant::from_ns(since);
        Some(next_end)
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
        // Phases of 0, 3 .. 15 and 16 ms; the observed round may begin at any of them.
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
        assert!(!Round::default().is_next_complete(|_| Some(at(7))));
    }

    #[test]
    fn who_missed_the_last_round_is_not_waited_for() {
        let mut last = Round::default();
        last.add(2, at(6));
        last.add(LANES, at(16));
        let there = |member: usize| (member == 2 || member == LANES).then_some(at(60));
        assert!(last.is_next_complete(there));
        assert!(!last.is_next_complete(|member| there(member).filter(|_| member != LANES)));
    }

    /// The lanes of phase 16 ms arrive just after the cycle at 15 ms has begun.
    #[test]
    fn what_came_after_the_last_cycle_had_begun_is_waited_for_again() {
        let mut last = round(&[100, 103, 106, 109, 112, 115]);
        last.add(LANES, at(66));
        let end = last.next_end(at(115 + 12), PERIOD);
        assert_eq!(end, Some(at(166)));
        let again = |lanes| move |member| Some(at(if member == LANES { lanes } else { 165 }));
        assert!(!last.is_next_complete(again(116)));
        assert!(last.is_next_complete(again(166)));
    }
}
