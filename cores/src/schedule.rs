//! A run-to-completion executor for the control core: periodic tasks on absolute time.
//!
//! Its place is the one that the RTOS takes over: tasks have a period and a priority, a release
//! happens at `start + n · period` exactly, never relative to when the last one ran, so nothing
//! drifts. Tasks run to completion; among those that are due the one with the highest priority runs
//! first.

use tandem_board::{Duration, Instant};

/// One release of a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Release<T> {
    /// Which task.
    pub task: T,
    /// When it was to run.
    pub at: Instant,
    /// Releases of this task that passed without a run and are skipped; 0 in time.
    pub missed: u32,
}

#[derive(Clone, Copy)]
struct Entry<T> {
    task: T,
    period: Duration,
    next: Instant,
}

/// Periodic tasks, highest priority first.
pub struct Schedule<T, const N: usize> {
    entries: [Entry<T>; N],
}

impl<T: Copy + PartialEq, const N: usize> Schedule<T, N> {
    /// Tasks with their periods, in falling order of priority, all first released at `start`.
    ///
    /// # Panics
    /// If a period is zero.
    #[must_use]
    pub fn new(start: Instant, tasks: [(T, Duration); N]) -> Self {
        assert!(
            tasks.iter().all(|(_, period)| *period > Duration::ZERO),
            "a period is zero"
        );
        Self {
            entries: tasks.map(|(task, period)| Entry {
                task,
                period,
                next: start,
            }),
        }
    }

    /// The due task with the highest priority, which is thereby released; `None` if none is due.
    ///
    /// A task that is late by whole periods runs once, and says how many releases it missed.
    pub fn release(&mut self, now: Instant) -> Option<Release<T>> {
        let entry = self.entries.iter_mut().find(|entry| entry.next <= now)?;
        let missed = now.since(entry.next).as_ns() / entry.period.as_ns();
        let missed = u32::try_from(missed).unwrap_or(u32::MAX);
        let at = entry.next + entry.period.times(missed);
        entry.next = at + entry.period;
        Some(Release {
            task: entry.task,
            at,
            missed,
        })
    }

    /// Begins the grid of one task anew: its next release is at `at`.
    pub fn restart(&mut self, task: T, at: Instant) {
        self.entries
            .iter_mut()
            .filter(|entry| entry.task == task)
            .for_each(|entry| entry.next = at);
    }

    /// The time of the next release.
    #[must_use]
    pub fn next(&self) -> Instant {
        self.entries
            .iter()
            .map(|entry| entry.next)
            .min()
            .unwrap_or(Instant::NEVER)
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
    fn releases_keep_their_grid_however_late_the_poll() {
        let tasks = [
            (60, Duration::from_ms(60)),
            (40, Duration::from_ms(40)),
            (20, Duration::from_ms(20)),
        ];
        let mut schedule = Schedule::new(at(0), tasks);
        let mut counts = [0; 61];
        for step in 0..240 {
            // Polled with a jitter of up to 3 ms.
            let now = at(step) + Duration::from_us(step * 769 % 3000);
            while let Some(release) = schedule.release(now) {
                assert_eq!(release.at.as_ns() % (release.task as u64 * 1_000_000), 0);
                assert_eq!(release.missed, 0);
                counts[release.task as usize] += 1;
            }
        }
        assert_eq!((counts[60], counts[40], counts[20]), (4, 6, 12));
    }

    #[test]
    fn the_highest_priority_runs_first_and_a_late_one_once() {
        let mut schedule = Schedule::new(
            at(0),
            [('h', Duration::from_ms(10)), ('l', Duration::from_ms(1))],
        );
        let late = at(35);
        let high = schedule.release(late).unwrap();
        assert_eq!((high.task, high.at, high.missed), ('h', at(30), 3));
        let low = schedule.release(late).unwrap();
        assert_eq!((low.task, low.at, low.missed), ('l', at(35), 35));
        assert_eq!(schedule.release(late), None);
        assert_eq!(schedule.next(), at(36));
    }
}
