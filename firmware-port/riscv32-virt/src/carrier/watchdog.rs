//! Window and functional watchdog of a supply. T-CHIP-6

use core::sync::atomic::{AtomicBool, AtomicU8, AtomicU32, Ordering::Relaxed};
use tandem_board::watchdog_answer;

pub(crate) const OPENS_US: u32 = 5_000;
pub(crate) const CLOSES_US: u32 = 20_000;
pub(crate) const FIRST_SERVICE_US: u32 = 100_000;
const TICKS_PER_US: u32 = 10;

/// The registers. Times are the low word of the clock: a window is far shorter than its round of
/// 429 s, and while a watchdog watches, nobody looks at it later than the window's end.
pub(crate) struct Registers {
    /// It resets the system.
    pub(crate) watches: AtomicBool,
    question: AtomicU8,
    served: AtomicU32,
    /// It was served since the start.
    was_served: AtomicBool,
}

impl Registers {
    pub(crate) const fn new() -> Self {
        Self {
            watches: AtomicBool::new(false),
            question: AtomicU8::new(0),
            served: AtomicU32::new(0),
            was_served: AtomicBool::new(false),
        }
    }

    /// Armed at the start of a system.
    pub(crate) fn start(&self, watches: bool, now: u32) {
        self.watches.store(watches, Relaxed);
        self.question.store(3, Relaxed);
        self.served.store(now, Relaxed);
        self.was_served.store(false, Relaxed);
    }

    pub(crate) fn question(&self) -> u8 {
        self.question.load(Relaxed)
    }

    /// Ticks until the window closes, or by how many it is closed.
    pub(crate) fn left(&self, now: u32) -> Result<u32, u32> {
        let closes = match self.was_served.load(Relaxed) {
            true => CLOSES_US * TICKS_PER_US,
            false => FIRST_SERVICE_US * TICKS_PER_US,
        };
        let since = now.wrapping_sub(self.served.load(Relaxed));
        if since <= closes {
            Ok(closes - since)
        } else {
            Err(since - closes)
        }
    }

    /// A service; whether it was one that the watchdog accepts.
    pub(crate) fn serve(&self, answer: u8, now: u32) -> bool {
        let since = now.wrapping_sub(self.served.load(Relaxed));
        let open = !self.was_served.load(Relaxed) || since >= OPENS_US * TICKS_PER_US;
        let question = self.question();
        if !open || self.left(now).is_err() || answer != watchdog_answer(question) {
            return false;
        }
        // A full-period generator over 0 ..= 15: each question differs from the one before.
        self.question
            .store(question.wrapping_mul(5).wrapping_add(3) & 0xF, Relaxed);
        self.served.store(now, Relaxed);
        self.was_served.store(true, Relaxed);
        true
    }
}
