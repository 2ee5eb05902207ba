//! A dead man's switch: a timer that one process waits for and others postpone without waking it.

use std::io;
use std::os::fd::{AsFd, AsRawFd as _, BorrowedFd, OwnedFd, RawFd};

use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::{Errno, fcntl_dupfd_cloexec, read};
use rustix::time::{
    Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, timerfd_create, timerfd_gettime,
    timerfd_settime,
};
use tandem_board::{Duration, Instant};

use crate::clock::{self, timespec};

/// A period longer than any run. After a timer without a period has expired, the kernel no longer
/// reports when it was due; with a period, the due time is one period before the next expiry.
const AGAIN: Duration = Duration::from_ms(1_000_000_000);

/// A timer of CLOCK_MONOTONIC; processes share it by inheriting its descriptor.
///
/// Its expiry interrupts the CPU on which it was last set. Nothing in this module
/// allocates, and only [`Alarm::wait`] blocks; a signal handler may call [`Alarm::postpone`].
#[derive(Debug)]
pub struct Alarm(OwnedFd);

/// The end of a wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Expired {
    /// When the timer was due. The value may be too late, but never too early.
    pub due: Instant,
    /// When the wait ended.
    pub woken: Instant,
}

impl Alarm {
    /// Makes a timer that is not set. Processes that this process starts from now on inherit it.
    ///
    /// # Errors
    /// If the process may not open another descriptor.
    pub fn new() -> io::Result<Self> {
        let timer = timerfd_create(TimerfdClockId::Monotonic, TimerfdFlags::NONBLOCK)?;
        Ok(Self(timer))
    }

    /// Returns the number of the descriptor; it is the same in a process that inherits the timer.
    #[must_use]
    pub fn number(&self) -> RawFd {
        self.0.as_raw_fd()
    }

    /// Returns the timer that this process inherited under this number.
    ///
    /// # Errors
    /// If the number is not that of a timer.
    pub fn inherited(number: RawFd) -> io::Result<Self> {
        if number < 0 {
            return Err(Errno::BADF.into());
        }
        // SAFETY: used only for this call, which refuses a number that is not open.
        let inherited = unsafe { BorrowedFd::borrow_raw(number) };
        let timer = fcntl_dupfd_cloexec(inherited, 0)?;
        timerfd_gettime(&timer)?;
        Ok(Self(timer))
    }

    /// Sets the timer to expire at now + `by`, whether or not it was already set. The kernel reads
    /// the clock, so a delayed caller cannot set a time that has already passed.
    pub fn postpone(&self, by: Duration) {
        let setting = Itimerspec {
            it_interval: timespec(AGAIN.as_ns()),
            it_value: timespec(by.as_ns().max(1)),
        };
        // Cannot fail: the descriptor is a timer, and the setting is valid.
        let _ = timerfd_settime(&self.0, TimerfdTimerFlags::empty(), &setting);
    }

    /// Sleeps until the timer expires or `beside` is readable. Returns `None` if `beside` is
    /// readable, or if the timer was set again before its expiry was read (that expiry is lost).
    ///
    /// # Errors
    /// If the sleep was interrupted by a signal.
    pub fn wait(&self, beside: impl AsFd) -> io::Result<Option<Expired>> {
        let mut fds = [
            PollFd::new(&self.0, PollFlags::IN),
            PollFd::new(&beside, PollFlags::IN),
        ];
        poll(&mut fds, None)?;
        let woken = clock::now();
        if !fds[1].revents().is_empty() || read(&self.0, &mut [0; 8]) == Err(Errno::AGAIN) {
            return Ok(None);
        }
        let left = timerfd_gettime(&self.0)?.it_value;
        let left = Duration::from_ns(left.tv_sec as u64 * 1_000_000_000 + left.tv_nsec as u64);
        // Read the clock after the timer, so that `due` can be too late but never too early.
        Ok(last_due(clock::now(), left).map(|due| Expired { due, woken }))
    }
}

/// Returns the time at which a timer was last due; `left` is the time until its next expiry.
/// Returns `None` if the timer was set again and has not expired since.
fn last_due(now: Instant, left: Duration) -> Option<Instant> {
    let since = Duration::from_ns(AGAIN.as_ns().saturating_sub(left.as_ns()));
    (left.as_ns() > AGAIN.as_ns() / 2)
        .then(|| Instant::from_ns(now.as_ns().saturating_sub(since.as_ns())))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write as _;
    use std::os::unix::net::UnixStream;

    const SPAN: Duration = Duration::from_ms(5);

    /// A wait ends when the timer is due, and returns the due time even if the wait ends late.
    #[test]
    fn a_wait_knows_when_it_was_due() {
        let (alarm, (never, _kept)) = (Alarm::new().unwrap(), UnixStream::pair().unwrap());
        let due_and_woken = |late: Duration| {
            let before = clock::now();
            alarm.postpone(SPAN);
            clock::sleep_until(clock::now() + late);
            let Expired { due, woken } = alarm.wait(&never).unwrap().unwrap();
            assert!(before + SPAN <= due, "{before:?} {due:?}");
            assert!(before + SPAN.max(late) <= woken, "{before:?} {woken:?}");
            (due, woken)
        };
        let late = SPAN.times(4);
        for _ in 0..3 {
            due_and_woken(Duration::ZERO);
        }
        // Fails only if the machine stalls in every attempt.
        assert!((0..10).any(|_| {
            let (due, woken) = due_and_woken(late);
            due + SPAN < woken
        }));
    }

    /// If another owner postpones the same timer, a wait ends only after the last postponement.
    #[test]
    fn a_timer_that_is_postponed_does_not_expire() {
        let (alarm, (never, _kept)) = (Alarm::new().unwrap(), UnixStream::pair().unwrap());
        let other = Alarm::inherited(alarm.number()).unwrap();
        alarm.postpone(SPAN.times(1_000));
        let begin = clock::now();
        for _ in 0..5 {
            clock::sleep_until(clock::now() + SPAN);
            other.postpone(SPAN.times(1_000));
        }
        other.postpone(SPAN);
        let expired = alarm.wait(&never).unwrap().unwrap();
        assert!(expired.due >= begin + SPAN.times(6));
    }

    /// A timer that is set again while its expiry is read must not report a stall since time 0.
    #[test]
    fn a_timer_that_was_set_again_was_due_at_no_known_time() {
        let now = Instant::from_ns(50_000_000_000);
        for (left, due) in [
            (Duration::from_ms(2), None),
            (Duration::ZERO, None),
            (AGAIN, Some(now)),
            (
                Duration::from_ns(AGAIN.as_ns() - 7),
                Some(Instant::from_ns(49_999_999_993)),
            ),
        ] {
            assert_eq!(last_due(now, left), due, "{left:?}");
        }
    }

    #[test]
    fn what_is_readable_beside_it_ends_the_wait() {
        let (alarm, (beside, mut writes)) = (Alarm::new().unwrap(), UnixStream::pair().unwrap());
        alarm.postpone(SPAN.times(10_000));
        writes.write_all(&[0]).unwrap();
        assert_eq!(alarm.wait(&beside).unwrap(), None);
    }

    #[test]
    fn what_is_no_timer_is_not_inherited() {
        assert!(Alarm::inherited(-1).is_err());
        assert!(Alarm::inherited(RawFd::MAX).is_err());
        assert!(Alarm::inherited(0).is_err());
    }
}
