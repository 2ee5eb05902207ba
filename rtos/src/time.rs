//! Time in ticks of the kernel.

use core::time::Duration;

/// Ticks in a second.
pub(crate) const TICK_RATE_HZ: u32 = 1000;
/// Length of a tick that is not moved, ns.
pub(crate) const TICK_NS: u64 = 1_000_000_000 / TICK_RATE_HZ as u64;
/// The most by which one call moves the ticks, ns.
pub const LONGEST_SHIFT_NS: i32 = 100_000;

/// A tick that the kernel has counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TickTime {
    /// The kernel's count of ticks, this one included.
    pub count: Ticks,
    /// When it was due, in nanoseconds of the clock that times
    /// [`KernelEvent`](crate::KernelEvent)s. Its interrupt may have been later.
    pub due_ns: u64,
}

/// A time span or a point in time, in ticks of 1 ms. Points wrap after 49 days.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Ticks(pub u32);

impl Ticks {
    /// Does not wait.
    pub const NONE: Self = Self(0);
    /// Waits without a limit.
    pub const FOREVER: Self = Self(u32::MAX);

    /// Returns a span of `ms` milliseconds.
    #[must_use]
    pub const fn from_millis(ms: u32) -> Self {
        Self(ms)
    }

    /// Returns the ticks from `earlier` to this point. The count may wrap between them.
    #[must_use]
    pub const fn since(self, earlier: Self) -> Self {
        Self(self.0.wrapping_sub(earlier.0))
    }

    /// Returns the ticks from this point to `later`; zero if that point has passed. The count may
    /// wrap between them. They must be less than 24 days apart.
    #[must_use]
    pub const fn until(self, later: Self) -> Self {
        let left = later.since(self);
        if left.0 > i32::MAX as u32 {
            return Self::NONE;
        }
        left
    }

    /// Returns the point `span` after this one. The count may wrap between them.
    #[must_use]
    pub const fn after(self, span: Self) -> Self {
        Self(self.0.wrapping_add(span.0))
    }
}

/// Rounds up. A wait is shorter by the part of the current tick that has already passed. A span
/// that does not fit in 32 bits becomes the longest finite wait, about 49 days.
impl From<Duration> for Ticks {
    fn from(span: Duration) -> Self {
        let ticks = span.as_nanos().div_ceil(u128::from(TICK_NS));
        let longest = Self::FOREVER.0 - 1;
        Self(u32::try_from(ticks).map_or(longest, |ticks| ticks.min(longest)))
    }
}

impl From<Ticks> for Duration {
    fn from(span: Ticks) -> Self {
        Self::from_millis(u64::from(span.0) * 1000 / u64::from(TICK_RATE_HZ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_become_ticks_rounded_up_and_never_forever() {
        assert_eq!(Ticks::from(Duration::ZERO), Ticks::NONE);
        assert_eq!(Ticks::from(Duration::from_nanos(1)), Ticks(1));
        assert_eq!(Ticks::from(Duration::from_micros(2001)), Ticks(3));
        assert_eq!(Ticks::from(Duration::MAX), Ticks(u32::MAX - 1));
        assert_eq!(Duration::from(Ticks(7)), Duration::from_millis(7));
        assert_eq!(Ticks(2).since(Ticks(u32::MAX)), Ticks(3));
    }

    /// A task that is delayed between two reads of the time does not wait for a past point.
    #[test]
    fn a_point_that_has_passed_is_not_waited_for() {
        for due in [0, 7, u32::MAX] {
            let due = Ticks(due);
            assert_eq!(due.until(due), Ticks::NONE);
            assert_eq!(due.after(Ticks(1)).until(due), Ticks::NONE);
            assert_eq!(due.after(Ticks(60_000)).until(due), Ticks::NONE);
            assert_eq!(due.until(due.after(Ticks(3))), Ticks(3));
        }
    }
}
