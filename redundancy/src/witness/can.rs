//! The witness of the CAN bus: whether anything is heard, and since when without a pause.

use tandem_board::{Duration, Instant};

/// Watches the number of received CAN frames.
#[derive(Clone, Debug)]
pub(crate) struct CanWatch {
    last: Instant,
    since: Option<Instant>,
    told_silent: bool,
}

impl CanWatch {
    pub(crate) const fn new(now: Instant) -> Self {
        Self {
            last: now,
            since: None,
            told_silent: false,
        }
    }

    /// Takes the number of new frames. A pause longer than `pause` begins a new time of traffic.
    pub(crate) fn update(&mut self, now: Instant, new: u32, pause: Duration) {
        let paused = now.since(self.last) > pause;
        if new > 0 {
            self.last = now;
            if paused || self.since.is_none() {
                self.since = Some(now);
            }
        } else if paused {
            self.since = None;
        }
    }

    /// A stall of the receiver is no silence of the bus.
    pub(crate) fn forgive(&mut self, now: Instant) {
        self.last = now;
    }

    /// For how long frames have come without a pause; zero if none come.
    pub(crate) fn alive_for(&self, now: Instant) -> Duration {
        self.since.map_or(Duration::ZERO, |since| now.since(since))
    }

    /// Whether frames come.
    pub(crate) fn is_alive(&self) -> bool {
        self.since.is_some()
    }

    /// Whether the last frame, or the start, is longer ago than `limit`.
    pub(crate) fn is_silent(&self, now: Instant, limit: Duration) -> bool {
        now.since(self.last) > limit
    }

    /// Whether this differs from what was told last; takes note of it.
    pub(crate) fn is_news(&mut self, silent: bool) -> bool {
        core::mem::replace(&mut self.told_silent, silent) != silent
    }
}
