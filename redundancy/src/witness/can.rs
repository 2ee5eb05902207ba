//! The witness of the CAN bus: whether frames of third parties are received, and for how long
//! without a pause.
//!
//! Frames of the other system do not count. Two systems that hear only each other cannot judge the
//! bus: the rest of it may be off, or the fault may be between them.

use tandem_board::{Duration, Instant};

/// Watches the number of frames of third parties.
#[derive(Clone, Debug)]
pub(crate) struct CanWatch {
    last: Instant,
    since: Option<Instant>,
    heard: bool,
    reported_silent: bool,
}

impl CanWatch {
    pub(crate) const fn new(now: Instant) -> Self {
        Self {
            last: now,
            since: None,
            heard: false,
            reported_silent: false,
        }
    }

    /// Takes the number of new frames. After a pause longer than `pause`, a new period of traffic
    /// begins.
    pub(crate) fn update(&mut self, now: Instant, new: u32, pause: Duration) {
        let paused = now.since(self.last) > pause;
        if new > 0 {
            self.last = now;
            self.heard = true;
            if paused || self.since.is_none() {
                self.since = Some(now);
            }
        } else if paused {
            self.since = None;
        }
    }

    /// Restarts the time limit: a stall of the receiver is not a silence of the bus.
    pub(crate) fn forgive(&mut self, now: Instant) {
        self.last = now;
    }

    /// Returns how long frames have arrived without a pause; zero if none arrive.
    pub(crate) fn alive_for(&self, now: Instant) -> Duration {
        self.since.map_or(Duration::ZERO, |since| now.since(since))
    }

    /// Returns whether frames arrive.
    pub(crate) fn is_alive(&self) -> bool {
        self.since.is_some()
    }

    /// Returns whether no frame has arrived for longer than `limit`; the start counts as a frame.
    pub(crate) fn is_silent(&self, now: Instant, limit: Duration) -> bool {
        now.since(self.last) > limit
    }

    /// Returns whether frames arrived before, but none for `limit`: this system is deaf, or the bus
    /// is dead.
    pub(crate) fn is_deaf(&self, now: Instant, limit: Duration) -> bool {
        self.heard && self.is_silent(now, limit)
    }

    /// Returns whether `silent` differs from the last reported value, and replaces that value.
    pub(crate) fn is_news(&mut self, silent: bool) -> bool {
        core::mem::replace(&mut self.reported_silent, silent) != silent
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A new period of traffic begins after more than the pause, and counts from its first frame.
    #[test]
    fn a_pause_ends_the_traffic() {
        let at = |ms: u64| Instant::from_ns(ms * 1_000_000);
        let pause = Duration::from_ms(17);
        for (gap_ms, since_ms) in [(17, 5), (18, 23)] {
            let mut can = CanWatch::new(at(0));
            assert!(!can.is_alive() && !can.is_deaf(at(60), pause));
            can.update(at(5), 3, pause);
            can.update(at(5 + gap_ms), 1, pause);
            assert_eq!(can.alive_for(at(40)), at(40).since(at(since_ms)));
            let last = 5 + gap_ms;
            assert!(!can.is_silent(at(last + 17), pause) && can.is_silent(at(last + 18), pause));
            for (ms, alive) in [(17, true), (18, false)] {
                can.update(at(last + ms), 0, pause);
                assert_eq!(can.is_alive(), alive);
            }
            assert!(can.is_deaf(at(last + 18), pause));
            // A stall of the receiver, until now, is not a silence of the bus.
            can.forgive(at(last + 18));
            assert!(!can.is_deaf(at(last + 35), pause) && can.is_deaf(at(last + 36), pause));
        }
    }
}
