//! The CAN bus: how many frames a core may put on it.

use tandem_board::Instant;

/// Frames that one core can send in a millisecond. A bus of 1 Mbit/s carries at most 20, and a core
/// without a fault sends 2 in 10 ms. A core that sends without a pause leaves the rest of the bus
/// to the others; its own frames wait in its transmit buffer until that is full.
pub const FRAMES_PER_MS: u32 = 8;

/// How much of its bus share one core has used.
#[derive(Clone, Copy, Debug, Default)]
pub struct TransmitLimit {
    /// Which millisecond.
    ms: u64,
    /// Frames sent in it.
    sent: u32,
}

impl TransmitLimit {
    /// Whether the core may send a frame at `now`.
    #[must_use]
    pub const fn allows(&self, now: Instant) -> bool {
        self.sent < FRAMES_PER_MS || self.ms != ms(now)
    }

    /// The core has sent a frame at `now`.
    pub const fn count(&mut self, now: Instant) {
        if self.ms != ms(now) {
            *self = Self {
                ms: ms(now),
                sent: 0,
            };
        }
        self.sent = self.sent.saturating_add(1);
    }
}

const fn ms(now: Instant) -> u64 {
    now.as_ns() / 1_000_000
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_core_sends_its_share_of_each_millisecond() {
        let mut limit = TransmitLimit::default();
        for ms in [0, 1, 7] {
            for us in [0, 999] {
                let now = Instant::from_ns(ms * 1_000_000 + us * 1_000);
                assert_eq!(limit.allows(now), us == 0, "{ms} ms {us} us");
                for sent in 0..FRAMES_PER_MS {
                    assert_eq!(limit.allows(now), us == 0, "{ms} ms, {sent} sent");
                    limit.count(now);
                }
            }
        }
    }
}
