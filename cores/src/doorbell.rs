//! How often the doorbell causes work: at most once in [`DOORBELL_DISTANCE`].

use core::sync::atomic::{AtomicBool, AtomicU32, Ordering::Relaxed};
use tandem_board::{Duration, Instant};

/// Least distance between two polls that doorbells cause. Doorbells that ring earlier are merged
/// into one at the end of the distance. A doorbell announces a trajectory every 50 ms, an edge of
/// the start protocol every 5 ms, or a change of the power level. None of these waits longer than
/// 1 ms for the roles, which the tick releases too.
pub const DOORBELL_DISTANCE: Duration = Duration::from_ms(5);

/// What a ring of the doorbell causes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RingOutcome {
    /// The tasks of the doorbell run now. A new distance begins.
    Passes,
    /// It is the first one within the distance: the tasks run at [`DoorbellThrottle::due`].
    HeldBack,
    /// Another ring is already held back: the tasks run once for both.
    Merged,
}

/// Passes rings of a doorbell on with at least [`DOORBELL_DISTANCE`] between two. None is lost.
///
/// An interrupt handler and a task of the same core may share it if no call interrupts another: the
/// task masks the interrupt during its calls.
#[derive(Debug, Default)]
pub struct DoorbellThrottle {
    /// When the next ring may pass, ns, as two words: 32-bit targets have no 64-bit atomics.
    opens: [AtomicU32; 2],
    pending: AtomicBool,
    held_back: AtomicU32,
}

impl DoorbellThrottle {
    /// Called when the doorbell has rung.
    pub fn ring(&self, now: Instant) -> RingOutcome {
        if now >= self.opens() {
            self.pass(now);
            return RingOutcome::Passes;
        }
        if self.pending.swap(true, Relaxed) {
            return RingOutcome::Merged;
        }
        let held_back = self.held_back.load(Relaxed);
        self.held_back.store(held_back.wrapping_add(1), Relaxed);
        RingOutcome::HeldBack
    }

    /// Called when the doorbell may have rung. Returns whether its tasks run now. Only a ring that
    /// was held back begins a new distance: a call without a ring does not delay later rings.
    pub fn may_have_rung(&self, now: Instant) -> bool {
        if now < self.opens() {
            self.pending.store(true, Relaxed);
            return false;
        }
        self.pass_if_due(now);
        true
    }

    /// Passes a ring that was held back, if its time has come. Returns whether there was one.
    pub fn pass_if_due(&self, now: Instant) -> bool {
        let is_due = now >= self.due();
        if is_due {
            self.pass(now);
        }
        is_due
    }

    fn pass(&self, now: Instant) {
        self.pending.store(false, Relaxed);
        let opens = (now + DOORBELL_DISTANCE).to_words();
        for (word, value) in self.opens.iter().zip(opens) {
            word.store(value, Relaxed);
        }
    }

    fn opens(&self) -> Instant {
        Instant::from_words([self.opens[0].load(Relaxed), self.opens[1].load(Relaxed)])
    }

    /// Returns the time at which the held-back ring passes; [`Instant::NEVER`] if there is none.
    pub fn due(&self) -> Instant {
        if self.pending.load(Relaxed) {
            self.opens()
        } else {
            Instant::NEVER
        }
    }

    /// Returns how many times rings were held back; wraps around.
    pub fn held_back(&self) -> u32 {
        self.held_back.load(Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    fn at_us(us: u64) -> Instant {
        Instant::from_ns(us * 1_000)
    }

    #[test]
    fn rings_pass_with_their_distance_and_none_is_lost() {
        let throttle = DoorbellThrottle::default();
        let mut passed = Vec::new();
        // A ring every 100 µs for 20 ms, and then none.
        for us in (0..40_000).step_by(100) {
            let rings = us < 20_000 && throttle.ring(at_us(us)) == RingOutcome::Passes;
            if rings || throttle.pass_if_due(at_us(us)) {
                passed.push(us);
            }
        }
        assert_eq!(passed, [0, 5_000, 10_000, 15_000, 20_000]);
        assert_eq!(throttle.held_back(), 4);
        assert_eq!(throttle.due(), Instant::NEVER);
    }

    /// The later start tests that the stored time uses both words.
    #[test]
    fn the_first_early_ring_is_held_back_and_others_are_merged() {
        for start in [100_000, 1 << 40] {
            let throttle = DoorbellThrottle::default();
            assert_eq!(throttle.ring(at_us(start)), RingOutcome::Passes);
            assert_eq!(throttle.ring(at_us(start + 2_000)), RingOutcome::HeldBack);
            assert_eq!(throttle.ring(at_us(start + 3_000)), RingOutcome::Merged);
            assert_eq!(throttle.due(), at_us(start + 5_000));
            assert!(!throttle.pass_if_due(at_us(start + 4_999)));
            assert!(throttle.pass_if_due(at_us(start + 5_000)));
            // Passing that ring began the next distance.
            assert_eq!(throttle.ring(at_us(start + 6_000)), RingOutcome::HeldBack);
            assert_eq!(throttle.ring(at_us(start + 10_000)), RingOutcome::Passes);
            assert!(!throttle.pass_if_due(at_us(start + 20_000)));
        }
    }

    #[test]
    fn a_call_for_a_deadline_does_not_delay_the_next_ring() {
        let throttle = DoorbellThrottle::default();
        assert!(throttle.may_have_rung(at_us(6_000)));
        assert_eq!(throttle.ring(at_us(6_100)), RingOutcome::Passes);
        assert!(!throttle.may_have_rung(at_us(6_200)));
        assert_eq!(throttle.due(), at_us(11_100));
        assert!(throttle.may_have_rung(at_us(11_100)));
        assert_eq!(throttle.ring(at_us(11_200)), RingOutcome::HeldBack);
    }
}
