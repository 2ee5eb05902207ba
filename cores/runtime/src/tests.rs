//! Releases on ticks that move, with a model of the kernel.

use super::{TICK, ticks_until};
use chacha20::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use tandem_board::{Duration, Instant};
use tandem_cores::core0::Core0Task;
use tandem_cores::release::{Grid, TickGrid};
use tandem_rtos::{LONGEST_SHIFT_NS, Ticks};

/// A periodic task, as `run` treats it.
struct Periodic {
    task: Core0Task,
    grid: Grid,
    ticks: TickGrid,
    /// The number of the tick that wakes it.
    wakes: u32,
    /// The number of the tick in which its job ends.
    ends: Option<u32>,
}

impl Periodic {
    fn new(task: Core0Task, ticks: TickGrid) -> Self {
        Self {
            task,
            grid: Grid::new(ticks.origin, task.info().period),
            ticks,
            wakes: ticks.number,
            ends: None,
        }
    }

    /// The tick has woken it: it must be released, once and in time.
    fn wake(&mut self, now: Instant, ticks: TickGrid) {
        self.grid.shift(self.ticks.moved_ns(&ticks));
        self.ticks = ticks;
        let release = self.grid.release(now).expect("polled before its release");
        assert_eq!((release.at, release.missed), (ticks.origin, 0));
    }

    /// Its job has ended: it waits for the tick that is a period after its last one.
    fn end(&mut self, now: Instant, count: u32) {
        let deadline = self.grid.next();
        let left = ticks_until(self.task, &self.ticks, Ticks(count), now, deadline);
        let periods = (self.task.info().period.as_us() / TICK.as_us()) as u32;
        let due = self.wakes.wrapping_add(periods);
        assert_eq!(
            left,
            Some(Ticks(due.wrapping_sub(count))),
            "{:?}",
            self.task
        );
        (self.wakes, self.ends) = (due, None);
    }
}

/// S-5: however the ticks move, each task is polled at every tick of its period, and released by
/// that poll: none waits for a tick more, none is polled a tick too early. The next tick moves at
/// every tick, also while longer jobs run. The count wraps around.
#[test]
fn releases_stay_on_ticks_that_move() {
    let mut random = ChaCha8Rng::seed_from_u64(28);
    let mut ticks = TickGrid {
        number: u32::MAX - 500,
        origin: Instant::from_ns(5_000_300),
        period: TICK,
    };
    let tasks = [Core0Task::Monitoring, Core0Task::Control, Core0Task::Status];
    let mut tasks = tasks.map(|task| Periodic::new(task, ticks));
    for round in 0..20_000 {
        let late_ns = random.random_range(0..60_000);
        let now = ticks.origin + Duration::from_ns(late_ns);
        // Half a second in one direction, then in the other.
        let (most, drift) = (LONGEST_SHIFT_NS, round / 10_000 % 2);
        let by_ns = random.random_range(-most * (1 - drift)..=most * drift);
        for task in &mut tasks {
            if task.wakes == ticks.number && task.ends.is_none() {
                task.wake(now, ticks);
                let length = random.random_range(0..4) * u32::from(task.task == Core0Task::Control);
                task.ends = Some(ticks.number.wrapping_add(length));
            }
            if task.ends == Some(ticks.number) {
                task.end(now, ticks.number);
            }
        }
        let roles = ticks_until(
            Core0Task::Roles,
            &ticks,
            Ticks(ticks.number),
            now,
            now + TICK,
        );
        assert_eq!(roles, Some(Ticks(1)));
        // A deadline of another kind: the next tick or a later one, never the last one again.
        let deadline = now + Duration::from_ns(random.random_range(1..3_000_000));
        let other = ticks_until(
            Core0Task::Topics,
            &ticks,
            Ticks(ticks.number),
            now,
            deadline,
        );
        assert!(other >= Some(Ticks(1)), "{ticks:?} {now:?} {deadline:?}");
        let next_ns = (ticks.origin + TICK).as_ns();
        ticks = TickGrid {
            number: ticks.number.wrapping_add(1),
            origin: Instant::from_ns(next_ns.saturating_add_signed(by_ns.into())),
            period: TICK,
        };
    }
}

/// A task whose deadline has passed does not wait; one that sleeps looks again after a second.
#[test]
fn waits_are_limited() {
    let ticks = TickGrid {
        number: 7,
        origin: Instant::from_ns(3_000_000),
        period: TICK,
    };
    let now = Instant::from_ns(3_200_000);
    let left = |task, deadline_ns| {
        let deadline = Instant::from_ns(deadline_ns);
        ticks_until(task, &ticks, Ticks(7), now, deadline)
    };
    let control = [
        3_100_000,
        3_200_000,
        3_200_001,
        4_000_000,
        4_000_001,
        u64::MAX,
    ];
    let left_of_control = control.map(|at_ns| left(Core0Task::Control, at_ns));
    let expected = [None, None, Some(1), Some(1), Some(2), Some(1000)];
    assert_eq!(left_of_control, expected.map(|it| it.map(Ticks)));
    let roles = [3_100_000, 4_000_000, 4_999_999, 5_000_000, u64::MAX];
    let left_of_roles = roles.map(|at_ns| left(Core0Task::Roles, at_ns));
    assert_eq!(left_of_roles, [1, 1, 1, 2, 1000].map(|it| Some(Ticks(it))));
}
