//! Alive supervision: core 0 notices when core 1 or 2 no longer completes its cycles.

use tandem_board::{CoreId, Duration, Instant};

/// The state of one supervised core.
#[derive(Clone, Copy)]
struct Watched {
    core: CoreId,
    cycles: u32,
    since: Instant,
    limit: Duration,
    seen: bool,
}

/// Polls are 5 ms apart. If two are further apart than this, core 0 was held up, and most likely
/// cores 1 and 2 with it: time in which core 0 did not poll does not count as silence.
const HELD_UP: Duration = Duration::from_ms(20);
/// This much of the time between two such polls does count as silence, so that core 0 finds a
/// dead core even if core 0 is always late.
const COUNTS: Duration = Duration::from_ms(5);

/// Watches the cycle counters of cores 1 and 2.
pub(crate) struct Alive {
    watched: [Watched; 2],
    polled: Instant,
}

impl Alive {
    /// `limit`: a core is silent if it completes no cycle for longer than this. `first`: the same
    /// limit for the first cycle after the start. `cycles`: the present counters; they may be those
    /// of an earlier incarnation.
    pub(crate) fn new(now: Instant, first: Duration, cycles: impl Fn(CoreId) -> u32) -> Self {
        let watch = |core| Watched {
            core,
            cycles: cycles(core),
            since: now,
            limit: first,
            seen: false,
        };
        Self {
            watched: [watch(CoreId::PERCEPTION), watch(CoreId::PLANNING)],
            polled: now,
        }
    }

    /// Reads the counters; returns the first core that is silent.
    ///
    /// Core 1 wakes core 2, so if both are silent, the fault is core 1's.
    pub(crate) fn silent(
        &mut self,
        now: Instant,
        limit: Duration,
        cycles: impl Fn(CoreId) -> u32,
    ) -> Option<CoreId> {
        let unwatched = now.since(core::mem::replace(&mut self.polled, now));
        let excused = if unwatched > HELD_UP {
            unwatched - COUNTS
        } else {
            Duration::ZERO
        };
        for watched in &mut self.watched {
            watched.since += excused;
            let count = cycles(watched.core);
            if count != watched.cycles {
                *watched = Watched {
                    cycles: count,
                    since: now,
                    limit,
                    seen: true,
                    ..*watched
                };
            }
        }
        let silent = |watched: &&Watched| now.since(watched.since) > watched.limit;
        self.watched.iter().find(silent).map(|watched| watched.core)
    }

    /// Whether both cores have completed a cycle in this incarnation: the chain can then drive.
    pub(crate) fn all_seen(&self) -> bool {
        self.watched.iter().all(|watched| watched.seen)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMIT: Duration = Duration::from_ms(75);
    const FIRST: Duration = Duration::from_ms(1000);

    fn at(ms: u64) -> Instant {
        Instant::from_ns(ms * 1_000_000)
    }

    /// T-CHIP-3: a core that stops is noticed within one period after its next cycle was due.
    #[test]
    fn a_core_that_stops_is_named_and_core_1_first() {
        let mut alive = Alive::new(at(0), FIRST, |_| 7);
        assert!(!alive.all_seen());
        let both = |n: u32| move |_: CoreId| n;
        for cycle in 0..10u32 {
            let begin = u64::from(cycle) * 50;
            assert_eq!(poll(&mut alive, begin..begin + 50, both(8 + cycle)), None);
        }
        assert!(alive.all_seen());
        let planning_stops = |core| if core == CoreId::PLANNING { 17 } else { 18 };
        assert_eq!(poll(&mut alive, 500..526, planning_stops), None);
        assert_eq!(
            poll(&mut alive, 526..600, planning_stops),
            Some((526, CoreId::PLANNING))
        );
        let both_stop = (527..=600).map(|ms| alive.silent(at(ms), LIMIT, planning_stops));
        assert_eq!(both_stop.last().flatten(), Some(CoreId::PERCEPTION));
    }

    /// Polls every millisecond. Returns the time at which the first core was silent, and its id.
    fn poll(
        alive: &mut Alive,
        mut ms: core::ops::Range<u64>,
        cycles: impl Fn(CoreId) -> u32 + Copy,
    ) -> Option<(u64, CoreId)> {
        ms.find_map(|ms| Some((ms, alive.silent(at(ms), LIMIT, cycles)?)))
    }

    /// T-CHIP-3: cores that were held up together with core 0 may run before they are judged. A
    /// dead one is found after that, even if core 0 is always late.
    #[test]
    fn time_without_polls_is_no_silence() {
        let mut alive = Alive::new(at(0), FIRST, |_| 0);
        assert_eq!(poll(&mut alive, 0..50, |_| 1), None);
        assert_eq!(alive.silent(at(5_000), LIMIT, |_| 1), None);
        let dead = poll(&mut alive, 5_000..6_000, |_| 1);
        assert_eq!(dead, Some((5_022, CoreId::PERCEPTION)));

        let mut late = Alive::new(at(0), FIRST, |_| 0);
        assert_eq!(late.silent(at(10), LIMIT, |_| 1), None);
        let polls = (1..1_000).map(|n| at(10 + n * 60));
        let found = polls
            .filter_map(|now| late.silent(now, LIMIT, |_| 1))
            .next();
        assert_eq!(found, Some(CoreId::PERCEPTION));
    }

    #[test]
    fn the_first_cycle_may_take_longer() {
        let mut alive = Alive::new(at(0), FIRST, |_| 0);
        assert_eq!(poll(&mut alive, 0..1_001, |_| 0), None);
        assert_eq!(
            poll(&mut alive, 1_001..2_000, |_| 0),
            Some((1_001, CoreId::PERCEPTION))
        );
    }
}
