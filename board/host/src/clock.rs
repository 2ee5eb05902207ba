//! The clock of the host board: CLOCK_MONOTONIC, which all processes of the machine share.

use std::io;
use std::os::fd::BorrowedFd;

use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::Errno;
use rustix::thread::{ClockId, clock_nanosleep_absolute};
use rustix::time::{Timespec, clock_gettime};
use tandem_board::{Duration, Instant};

/// Returns the time, in nanoseconds of CLOCK_MONOTONIC.
#[must_use]
pub fn now() -> Instant {
    let time = clock_gettime(rustix::time::ClockId::Monotonic);
    Instant::from_ns(time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64)
}

/// Reads the kernel's real-time clock (UTC since 1970, ns) between two times of this clock, which
/// are less than 2 µs apart; `None` if the process was interrupted each time, or that clock is
/// before 1970.
#[must_use]
pub fn with_utc() -> Option<([Instant; 2], u64)> {
    (0..8).find_map(|_| {
        let before = now();
        let utc = clock_gettime(rustix::time::ClockId::Realtime);
        let after = now();
        let utc_ns = u64::try_from(utc.tv_sec).ok()? * 1_000_000_000 + utc.tv_nsec as u64;
        (after.since(before) < Duration::from_us(2)).then_some(([before, after], utc_ns))
    })
}

/// Sleeps until the absolute time `deadline`, so that a late wake-up does not delay later ones.
pub fn sleep_until(deadline: Instant) {
    let at = timespec(deadline.as_ns());
    while clock_nanosleep_absolute(ClockId::Monotonic, &at) == Err(Errno::INTR) {}
}

/// Waits until one of these descriptors is readable or closed by its other end, but no longer than
/// this. Returns whether one is; `false` also after a signal.
///
/// # Errors
/// If the kernel has no memory for it, or a limit permits no poll of that many descriptors.
pub fn wait_for<'a>(
    fds: impl IntoIterator<Item = BorrowedFd<'a>>,
    span: Duration,
) -> io::Result<bool> {
    let fds = fds.into_iter();
    let mut fds: Vec<_> = fds
        .map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN))
        .collect();
    match poll(&mut fds, Some(&timespec(span.as_ns()))) {
        Err(Errno::INTR) => Ok(false),
        ready => Ok(ready? > 0),
    }
}

/// Waits until this is so, but no longer than this. Looks every 2 ms.
pub fn wait_until(within: Duration, mut is_so: impl FnMut() -> bool) {
    let deadline = now() + within;
    while !is_so() && now() < deadline {
        sleep_until(now() + Duration::from_ms(2));
    }
}

/// Converts nanoseconds for the kernel; cuts off values that are longer than it accepts.
#[must_use]
pub fn timespec(ns: u64) -> Timespec {
    const LIMIT_S: u64 = i32::MAX as u64;
    let seconds = (ns / 1_000_000_000).min(LIMIT_S);
    Timespec {
        tv_sec: seconds as i64,
        tv_nsec: (ns % 1_000_000_000) as i64,
    }
}

/// Wakes its owner at equal intervals.
#[derive(Debug)]
pub struct Ticker {
    period: Duration,
    next: Instant,
}

impl Ticker {
    /// Makes a ticker whose first tick is due one period from now.
    #[must_use]
    pub fn new(period: Duration) -> Self {
        Self {
            period,
            next: now() + period,
        }
    }

    /// Returns the time at which the next tick is due.
    #[must_use]
    pub const fn next(&self) -> Instant {
        self.next
    }

    /// Sleeps until the next tick is due, and returns its due time: consecutive ticks are exactly
    /// one period apart. Missed ticks are returned immediately, one by one, so that the owner can
    /// catch up.
    pub fn wait(&mut self) -> Instant {
        let due = self.next;
        self.next += self.period;
        if now() < due {
            sleep_until(due);
        }
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_one_period_apart_and_never_early() {
        let mut ticker = Ticker::new(Duration::from_us(500));
        let first = ticker.wait();
        for n in 1..20 {
            let tick = ticker.wait();
            assert_eq!(tick, first + Duration::from_us(500 * n));
            assert!(now() >= tick);
        }
    }

    #[test]
    fn a_far_deadline_is_cut_not_wrapped() {
        assert_eq!(timespec(u64::MAX).tv_sec, i64::from(i32::MAX));
        assert_eq!(
            timespec(1_500_000_000),
            Timespec {
                tv_sec: 1,
                tv_nsec: 500_000_000
            }
        );
    }
}
