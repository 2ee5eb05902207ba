//! The doorbell's interrupt releases its tasks at most once in [`DOORBELL_DISTANCE`].

use core::sync::atomic::{AtomicBool, AtomicU32, Ordering::Relaxed};
use tandem_board::Instant;
use tandem_cores::core0::DOORBELL_DISTANCE;

/// The tasks that an interrupt of the doorbell releases.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Releases {
    /// All tasks of the doorbell.
    All,
    /// Too early, and the first such one: the task that waits for the end of the distance.
    Waiter,
    /// Too early: nothing.
    Nothing,
}

/// Touched by the handler and by one task of its core, which it interrupts.
#[derive(Default)]
pub(crate) struct Doorbell {
    /// From then on an interrupt is in time, ms; wraps around.
    opens_ms: AtomicU32,
    /// An interrupt was too early and is to be made up.
    pending: AtomicBool,
}

const fn ms(at: Instant) -> u32 {
    (at.as_ns() / 1_000_000) as u32
}

impl Doorbell {
    /// How long until the next one is in time, ms; 0 if it is already.
    fn left_ms(&self, now: Instant) -> u32 {
        let left = self.opens_ms.load(Relaxed).wrapping_sub(ms(now));
        // A longer time is one that has passed. After 49 quiet days one ring may seem early.
        if left > ms_of_distance() { 0 } else { left }
    }

    fn begin(&self, now: Instant) {
        let opens = ms(now).wrapping_add(ms_of_distance());
        self.opens_ms.store(opens, Relaxed);
    }

    /// The doorbell has rung.
    pub(crate) fn interrupt(&self, now: Instant) -> Releases {
        if self.left_ms(now) == 0 {
            self.begin(now);
            Releases::All
        } else if self.pending.swap(true, Relaxed) {
            Releases::Nothing
        } else {
            Releases::Waiter
        }
    }

    /// Until when the waiter has to wait; `None` if it is to run.
    pub(crate) fn waits_until(&self, now: Instant) -> Option<Instant> {
        if !self.pending.load(Relaxed) {
            return None;
        }
        match self.left_ms(now) {
            0 => {
                self.begin(now);
                self.pending.store(false, Relaxed);
                None
            }
            left => Some(now + tandem_board::Duration::from_ms(left.into())),
        }
    }
}

const fn ms_of_distance() -> u32 {
    (DOORBELL_DISTANCE.as_ns() / 1_000_000) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> Instant {
        Instant::from_ns(ms * 1_000_000)
    }

    #[test]
    fn a_flood_releases_once_in_a_distance_and_the_last_one_is_made_up() {
        for start in [100, u64::from(u32::MAX) - 3] {
            let doorbell = Doorbell::default();
            assert_eq!(doorbell.interrupt(at(start - 50)), Releases::All);
            assert_eq!(doorbell.interrupt(at(start)), Releases::All);
            assert_eq!(doorbell.waits_until(at(start)), None);
            assert_eq!(doorbell.interrupt(at(start + 2)), Releases::Waiter);
            assert_eq!(doorbell.interrupt(at(start + 3)), Releases::Nothing);
            assert_eq!(doorbell.waits_until(at(start + 3)), Some(at(start + 5)));
            assert_eq!(doorbell.waits_until(at(start + 5)), None);
            // That was a release: the next distance has begun.
            assert_eq!(doorbell.interrupt(at(start + 6)), Releases::Waiter);
            assert_eq!(doorbell.interrupt(at(start + 10)), Releases::All);
        }
    }
}
