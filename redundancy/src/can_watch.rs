//! Whether anything is heard on CAN, and since when without a pause.

use tandem_board::{Duration, Instant};

/// Watches the count of received CAN frames.
#[derive(Clone, Debug)]
pub(crate) struct CanWatch {
    count: u32,
    last: Instant,
    since: Option<Instant>,
}

impl CanWatch {
    pub(crate) const fn new(count: u32, now: Instant) -> Self {
        Self {
            count,
            last: now,
            since: None,
        }
    }

    /// Takes the current count. A pause longer than `pause` begins a new time of traffic.
    pub(crate) fn update(&mut self, now: Instant, count: u32, pause: Duration) {
        let paused = now.since(self.last) > pause;
        if count != self.count {
            self.count = count;
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

    /// Time since the last frame, or since the beginning if none came.
    pub(crate) fn silent_for(&self, now: Instant) -> Duration {
        now.since(self.last)
    }
}
