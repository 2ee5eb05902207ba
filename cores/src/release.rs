//! Releases of a periodic task on absolute time.
//!
//! A release happens at `start + n · period` exactly, never relative to when the last one ran, so
//! nothing drifts. The executor decides what runs the task and how it waits.

use tandem_board::{Duration, Instant};

/// One release of a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Release {
    /// When the task should run.
    pub at: Instant,
    /// Earlier releases of this task that are skipped because it did not run in time.
    pub missed: u32,
}

/// The points at which a timer can wake a task, as the task has last read them.
///
/// A kernel may move its later ticks. Then this copy tells wrong times, but right numbers for times
/// that were computed with it. So a task turns a deadline into a number with the copy that the
/// deadline is from, and reads the ticks anew when it wakes.
#[derive(Clone, Copy, Debug)]
pub struct TickGrid {
    /// The number of the tick at the origin; wraps around.
    pub number: u32,
    /// When that tick was due: the last one when the copy was made.
    pub origin: Instant,
    /// Time between two ticks.
    pub period: Duration,
}

impl TickGrid {
    /// A timer that is exact to the nanosecond.
    pub const EXACT: Self = Self {
        number: 0,
        origin: Instant::ORIGIN,
        period: Duration::from_ns(1),
    };

    /// Returns which tick after the origin is the first that is not before `at`.
    #[must_use]
    pub const fn after(&self, at: Instant) -> u64 {
        at.since(self.origin).as_ns().div_ceil(self.period.as_ns())
    }

    /// Returns which tick after the origin is the last that is not after `at`.
    #[must_use]
    pub const fn before(&self, at: Instant) -> u64 {
        at.since(self.origin).as_ns() / self.period.as_ns()
    }

    /// Returns the last tick that is not after `at`.
    #[must_use]
    pub fn floor(&self, at: Instant) -> Instant {
        self.origin + Duration::from_ns(self.before(at) * self.period.as_ns())
    }

    /// Returns by how much the ticks were moved between this copy and a later one, ns; positive if
    /// they are later now.
    #[must_use]
    pub fn moved_ns(&self, later: &Self) -> i64 {
        let ticks = later.number.wrapping_sub(self.number);
        let expected = self.origin + self.period.times(ticks);
        later.origin.as_ns().wrapping_sub(expected.as_ns()) as i64
    }
}

/// The releases of one task.
#[derive(Clone, Copy, Debug)]
pub struct Grid {
    period: Duration,
    next: Instant,
}

impl Grid {
    /// Releases every `period`, the first at `start`.
    ///
    /// # Panics
    /// If the period is zero.
    #[must_use]
    pub fn new(start: Instant, period: Duration) -> Self {
        assert!(period > Duration::ZERO, "a period is zero");
        Self {
            period,
            next: start,
        }
    }

    /// Returns the release that is due, if one is.
    ///
    /// A task that is late by whole periods runs once; the release says how many were missed.
    pub fn release(&mut self, now: Instant) -> Option<Release> {
        if now < self.next {
            return None;
        }
        let missed = now.since(self.next).as_ns() / self.period.as_ns();
        let missed = u32::try_from(missed).unwrap_or(u32::MAX);
        let at = self.next + self.period.times(missed);
        self.next = at + self.period;
        Some(Release { at, missed })
    }

    /// Moves the next release, and all after it, by `by_ns`: later if positive.
    pub fn shift(&mut self, by_ns: i64) {
        self.next = Instant::from_ns(self.next.as_ns().saturating_add_signed(by_ns));
    }

    /// Begins the grid anew: the next release is at `at`.
    pub fn restart(&mut self, at: Instant) {
        self.next = at;
    }

    /// Returns the time of the next release.
    #[must_use]
    pub const fn next(&self) -> Instant {
        self.next
    }
}

/// The number of the last cycle of another core that a task has used.
#[derive(Clone, Copy, Debug, Default)]
pub struct Cycles(Option<u32>);

impl Cycles {
    /// Records that the task works on this cycle. Returns how many earlier cycles were replaced
    /// before the task could read them. A number that decreases comes from a restarted core.
    pub fn missed(&mut self, cycle: u32) -> u32 {
        let last = self.0.replace(cycle);
        last.map_or(0, |last| cycle.saturating_sub(last).saturating_sub(1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> Instant {
        Instant::from_ns(ms * 1_000_000)
    }

    /// T-RTOS-3: three tasks with periods 60, 40 and 20 ms run with periods 60, 40 and 20 ms.
    #[test]
    fn cycles_that_were_replaced_are_missed() {
        let mut cycles = Cycles::default();
        let missed = [7, 8, 8, 11, 1, 2].map(|cycle| cycles.missed(cycle));
        assert_eq!(missed, [0, 0, 0, 2, 0, 0]);
    }

    #[test]
    fn releases_keep_their_grid_however_late_the_poll() {
        let periods = [60, 40, 20];
        let mut grids = periods.map(|ms| Grid::new(at(0), Duration::from_ms(ms)));
        let mut counts = [0; 3];
        for step in 0..240 {
            // Polled with a jitter of up to 3 ms.
            let now = at(step) + Duration::from_us(step * 769 % 3000);
            for (index, grid) in grids.iter_mut().enumerate() {
                let Some(release) = grid.release(now) else {
                    continue;
                };
                assert_eq!(release.at.as_ns() % (periods[index] * 1_000_000), 0);
                assert_eq!(release.missed, 0);
                counts[index] += 1;
            }
        }
        assert_eq!(counts, [4, 6, 12]);
    }

    #[test]
    fn ticks_are_counted_from_their_origin() {
        let ticks = TickGrid {
            number: u32::MAX,
            origin: at(5) + Duration::from_us(300),
            period: Duration::from_ms(1),
        };
        let exactly = at(7) + Duration::from_us(300);
        assert_eq!((ticks.before(exactly), ticks.after(exactly)), (2, 2));
        assert_eq!((ticks.before(at(8)), ticks.after(at(8))), (2, 3));
        assert_eq!(ticks.floor(at(8)), exactly);
        assert_eq!(TickGrid::EXACT.floor(at(8)), at(8));
        let moved = TickGrid {
            number: 1,
            origin: at(7) + Duration::from_us(280),
            ..ticks
        };
        assert_eq!(
            (ticks.moved_ns(&moved), moved.moved_ns(&moved)),
            (-20_000, 0)
        );
    }

    #[test]
    fn a_late_task_runs_once_and_is_told() {
        let mut grid = Grid::new(at(0), Duration::from_ms(10));
        let release = grid.release(at(35)).unwrap();
        assert_eq!((release.at, release.missed), (at(30), 3));
        assert_eq!(grid.release(at(35)), None);
        assert_eq!(grid.next(), at(40));
        grid.restart(at(37));
        let release = grid.release(at(37)).unwrap();
        assert_eq!((release.at, release.missed), (at(37), 0));
    }
}
