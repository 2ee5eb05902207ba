//! The timeline on which perception computes: the vehicle's time, so that two systems that hear the
//! same frames compute the same bits.
//!
//! Before the first global time it is this system's clock. Without global time it continues at a
//! fixed distance from that clock.

use tandem_board::{Duration, Instant};

use super::GlobalClock;

/// Arrivals lie on whole multiples of it: each system reads another time for the same frame, some
/// microseconds apart. In half of it the vehicle changes its speed by 2 mm/s at 4 m/s².
const GRID: Duration = Duration::from_ms(1);
/// If the timeline deviates by more from the global time, one of both has leapt, ns.
const LEAP_NS: u64 = 500_000;
/// A stamp that says this time or a time no farther from it, µs, is right: a time base is better
/// than that, and 0.1 ms move nothing.
const STAMP_US: u32 = 100;

/// How this system's clock becomes the shared timeline.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Timeline {
    /// How far it is ahead of this system's clock, ns.
    ahead_ns: i64,
    is_shared: bool,
}

impl Timeline {
    /// Takes the global time; `None` if there is none. If the timeline leaps, returns by how much,
    /// ns: stored times must leap with it.
    pub(super) fn follow(&mut self, global: Option<&GlobalClock>) -> Option<i64> {
        self.is_shared = global.is_some();
        let ahead_ns = global?.ahead_ns();
        let by_ns = ahead_ns.wrapping_sub(self.ahead_ns);
        self.ahead_ns = ahead_ns;
        (by_ns.unsigned_abs() > LEAP_NS).then_some(by_ns)
    }

    /// Returns whether it is the vehicle's time.
    pub(super) const fn is_shared(&self) -> bool {
        self.is_shared
    }

    /// Returns a moment of this system's clock on the timeline; on its grid if it is shared.
    pub(super) fn of(&self, local: Instant) -> Instant {
        if !self.is_shared {
            return local.moved(self.ahead_ns);
        }
        let middle = local.moved(self.ahead_ns) + Duration::from_ns(GRID.as_ns() / 2);
        Instant::from_ns(middle.as_ns() / GRID.as_ns() * GRID.as_ns())
    }

    /// Returns when a measurement was that lies at `local` on this system's clock: its stamp, µs of
    /// global time, if that is where it lies.
    pub(super) fn of_stamp(&self, local: Instant, stamp_us: u32) -> Instant {
        let at = local.moved(self.ahead_ns);
        let us = at.as_ns() / 1_000;
        let off_us = stamp_us.wrapping_sub(us as u32).cast_signed();
        match self.is_shared && off_us.unsigned_abs() <= STAMP_US {
            true => Instant::from_ns(
                us.saturating_add_signed(off_us.into())
                    .saturating_mul(1_000),
            ),
            false => at,
        }
    }

    /// Returns a moment of the timeline on this system's clock.
    pub(super) fn local(&self, at: Instant) -> Instant {
        at.moved(self.ahead_ns.wrapping_neg())
    }
}
