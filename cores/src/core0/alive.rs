//! Alive supervision: core 0 notices when core 1 or 2 no longer passes through its cycles.

use tandem_board::{CoreId, Duration, Instant};

/// What is known of one supervised core.
#[derive(Clone, Copy)]
struct Watched {
    core: CoreId,
    cycles: u32,
    since: Instant,
    limit: Duration,
    seen: bool,
}

/// Watches the cycle counters of cores 1 and 2.
pub(crate) struct Alive {
    watched: [Watched; 2],
}

impl Alive {
    /// `limit`: without a new cycle for longer than this a core is silent. `first`: so long may the
    /// first cycle take after the start. `cycles`: the counters now; an earlier life may have left
    /// them.
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
        }
    }

    /// Looks at the counters; the first core that is silent, and whether all have run at least
    /// once.
    ///
    /// Core 2 is woken by core 1, so with both silent the fault is core 1's.
    pub(crate) fn silent(
        &mut self,
        now: Instant,
        limit: Duration,
        cycles: impl Fn(CoreId) -> u32,
    ) -> Option<CoreId> {
        for watched in &mut self.watched {
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

    /// Whether both cores have passed through a cycle in this life: the chain can carry a drive.
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
            assert_eq!(
                alive.silent(at(u64::from(cycle) * 50), LIMIT, both(8 + cycle)),
                None
            );
        }
        assert!(alive.all_seen());
        let planning_stops = |core| if core == CoreId::PLANNING { 17 } else { 18 };
        assert_eq!(alive.silent(at(500), LIMIT, planning_stops), None);
        assert_eq!(
            alive.silent(at(526), LIMIT, planning_stops),
            Some(CoreId::PLANNING)
        );
        assert_eq!(
            alive.silent(at(600), LIMIT, planning_stops),
            Some(CoreId::PERCEPTION)
        );
    }

    #[test]
    fn the_first_cycle_may_take_longer() {
        let mut alive = Alive::new(at(0), FIRST, |_| 0);
        assert_eq!(alive.silent(at(999), LIMIT, |_| 0), None);
        assert_eq!(
            alive.silent(at(1001), LIMIT, |_| 0),
            Some(CoreId::PERCEPTION)
        );
    }
}
