//! When the control task runs: a grid of absolute time that follows the trajectories, so that they
//! do not wait long for the control task.

use super::CONTROL_PERIOD;
use crate::release::{Grid, Release, TickGrid};
use tandem_board::{Duration, Instant};
use tandem_timesync::{Arbitrary, Conversion};

/// A trajectory waits no longer than this for the control task, once the grid has moved.
const LONGEST_WAIT: Duration = Duration::from_us(1_500);
/// The grid starts to move after this many trajectories in a row waited longer. A single one may be
/// late because the machine is busy. Moving the grid for it would put the grid just before all
/// others, which then wait for almost a whole period.
const LATE: u8 = 3;
/// The grid moves in steps of one tick of the kernel, because releases lie on ticks.
const GRID_STEP: Duration = Duration::from_ms(1);

/// By this much the cycles, or the ticks of an RTOS, move at most when they are moved to the
/// vehicle's time: 0.5 % of a tick, so no task notices.
const FINE_STEP_NS: i64 = 5_000;
const STEP_NS: i64 = GRID_STEP.as_ns() as i64;
const PERIOD_NS: i64 = CONTROL_PERIOD.as_ns() as i64;

/// The releases of the control task.
pub(super) struct ControlGrid {
    ticks: TickGrid,
    grid: Grid,
    follow: Follow,
    /// The next release was moved already: from one to the next, one tick at most.
    is_moved: bool,
    /// A control cycle that the degraded task has not run yet.
    for_degraded: Option<Release>,
}

impl ControlGrid {
    pub(super) fn new(started: Instant) -> Self {
        Self {
            ticks: TickGrid::EXACT,
            grid: Grid::new(started, CONTROL_PERIOD),
            follow: Follow::default(),
            is_moved: false,
            for_degraded: None,
        }
    }

    /// Makes all later releases lie on these ticks.
    pub(super) fn set_ticks(&mut self, ticks: TickGrid, now: Instant) {
        self.ticks = ticks;
        self.restart(now);
    }

    /// Moves all later releases by `by_ns`, as the ticks were moved since the task that runs at
    /// these releases last read them.
    pub(super) fn shift(&mut self, by_ns: i64) {
        let origin_ns = self.ticks.origin.as_ns().saturating_add_signed(by_ns);
        self.ticks.origin = Instant::from_ns(origin_ns);
        self.grid.shift(by_ns);
    }

    /// Begins a new grid: the next release is at the last tick.
    pub(super) fn restart(&mut self, now: Instant) {
        self.grid.restart(self.ticks.floor(now));
    }

    /// Called when a trajectory has arrived. While trajectories wait too long for the control task,
    /// the grid moves earlier, a tick at a time.
    pub(super) fn on_trajectory(&mut self, now: Instant) {
        self.follow.on_trajectory(self.grid.next().since(now));
    }

    /// Returns the release that is due at `now`.
    pub(super) fn release(&mut self, now: Instant) -> Option<Release> {
        let release = self.grid.release(now)?;
        // A system that follows another one has no part in this: that one follows the trajectories.
        let was_moved = core::mem::replace(&mut self.is_moved, false);
        if self.follow.moves() && !was_moved {
            self.is_moved = true;
            self.grid.shift(-(GRID_STEP.as_ns() as i64));
        }
        Some(release)
    }

    /// Returns the time of the next release.
    pub(super) const fn next(&self) -> Instant {
        self.grid.next()
    }

    /// Moves the next release, and all after it, towards a whole millisecond of the vehicle's time.
    /// Releases on the ticks of an RTOS stay there: the ticks themselves are moved.
    pub(super) fn align(&mut self, conversion: &Conversion<Arbitrary>) {
        let by = off_millisecond(conversion, self.grid.next());
        self.begin_at(conversion.local_of(conversion.at(self.grid.next()).moved(by)));
    }

    /// Moves the next release towards the cycle of another system, once and by a tick at most.
    /// `told`: the low word of its time, ns. Returns whether the release is earlier now.
    pub(super) fn follow(&mut self, told: u32, conversion: &Conversion<Arbitrary>) -> bool {
        if core::mem::replace(&mut self.is_moved, true) {
            return false;
        }
        let before = self.grid.next();
        let own = conversion.at(before);
        let apart = told.wrapping_sub(own.as_ns() as u32).cast_signed();
        let by = within(apart.into(), PERIOD_NS);
        self.begin_at(conversion.local_of(own.moved(by.clamp(-STEP_NS, STEP_NS))));
        self.grid.next() < before
    }

    /// Puts the next release on the tick nearest to `at`.
    fn begin_at(&mut self, at: Instant) {
        let half = Duration::from_ns(self.ticks.period.as_ns() / 2);
        self.grid.restart(self.ticks.floor(at + half));
    }

    /// Passes a release to the degraded task. An unused earlier release counts as missed.
    pub(super) fn pass_on(&mut self, release: Release) {
        let unused = self.for_degraded.map_or(0, |before| before.missed + 1);
        let missed = release.missed.saturating_add(unused);
        self.for_degraded = Some(Release { missed, ..release });
    }

    /// Returns the release for the degraded task.
    pub(super) fn take_passed_on(&mut self) -> Option<Release> {
        self.for_degraded.take()
    }
}

/// Returns by how much later a local time must be, ns, to move towards the next whole millisecond
/// of the vehicle's time.
pub(super) fn off_millisecond(conversion: &Conversion<Arbitrary>, at: Instant) -> i64 {
    let into = conversion.at(at).as_ns() % STEP_NS as u64;
    within(-(into as i64), STEP_NS).clamp(-FINE_STEP_NS, FINE_STEP_NS)
}

/// Returns the number nearest to 0 that differs from `ns` by a multiple of `period`.
const fn within(ns: i64, period: i64) -> i64 {
    (ns + period / 2).rem_euclid(period) - period / 2
}

/// Counts the trajectories that waited too long.
#[derive(Clone, Copy, Debug, Default)]
struct Follow {
    waited: u8,
}

impl Follow {
    /// Called when a trajectory has arrived that the control task will use after `wait`.
    fn on_trajectory(&mut self, wait: Duration) {
        if wait <= LONGEST_WAIT {
            self.waited = 0;
        } else {
            self.waited = self.waited.saturating_add(1);
        }
    }

    /// Returns whether the grid moves earlier by [`GRID_STEP`] now. Once it has moved, each further
    /// trajectory that waits too long moves it again, until one does not.
    fn moves(&mut self) -> bool {
        let moves = self.waited >= LATE;
        if moves {
            self.waited = LATE - 1;
        }
        moves
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_US: u64 = 10_000;

    /// Returns the waits of trajectories that arrive this long after the beginning of their round,
    /// µs, and the grid's last position. A round has five control periods.
    fn waits(mut grid_us: u64, arrivals_us: [u64; 20]) -> ([u64; 20], u64) {
        let mut follow = Follow::default();
        let waits = arrivals_us.map(|arrival_us| {
            let wait_us = (grid_us + PERIOD_US - arrival_us % PERIOD_US) % PERIOD_US;
            follow.on_trajectory(Duration::from_us(wait_us));
            for _ in 0..5 {
                if follow.moves() {
                    grid_us = (grid_us + PERIOD_US - GRID_STEP.as_us()) % PERIOD_US;
                }
            }
            wait_us
        });
        (waits, grid_us)
    }

    #[test]
    fn the_grid_follows_the_trajectory_by_a_tick_a_round() {
        let (waits, grid_us) = waits(2_700, [3_000; 20]);
        assert_eq!(waits[..3], [9_700; 3], "three begin the move");
        assert_eq!(
            waits[3..12],
            [8_700, 7_700, 6_700, 5_700, 4_700, 3_700, 2_700, 1_700, 700]
        );
        assert_eq!(waits[12..], [700; 8]);
        assert_eq!(grid_us, 3_700);
    }

    /// On a busy machine two trajectories in a row miss their control cycle. Only these are late.
    #[test]
    fn trajectories_that_are_held_back_move_nothing() {
        let mut arrivals_us = [3_000; 20];
        arrivals_us[5..7].fill(4_000);
        let (waits, grid_us) = waits(3_700, arrivals_us);
        let long = waits.iter().filter(|wait_us| **wait_us > 1_500).count();
        assert_eq!((long, grid_us), (2, 3_700), "{waits:?}");
    }
}
