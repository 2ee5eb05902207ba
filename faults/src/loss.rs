//! How long the vehicle may be without control under each fault.

use tandem_board::Duration;
use tandem_record::verdict::Limits;
use tandem_record::verdict::required_limits::{CONTROL_PERIOD, POLL};

/// How the vehicle loses its master. Each variant has its own bound.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Loss {
    /// No loss: the fault does not affect the master's frames.
    None,
    /// Both systems are stopped for this time.
    Stall(Duration),
    /// The power level falls.
    Power,
    /// The master falls silent, and its level line stays high.
    Silence,
    /// The master runs, but its frames do not arrive.
    Mute,
    /// The master's clock is wrong. Its control period really has this length, at least 10 ms.
    Clock(Duration),
    /// Like [`Self::Clock`], but without the link the master cannot detect it. The gate refuses its
    /// frames as late. After two refused frames the master stops sending, and then counts as mute.
    Refused(Duration),
}

impl Loss {
    /// Returns the longest permitted time between two control frames that take effect.
    #[must_use]
    pub fn bound(self, limits: &Limits) -> Duration {
        match self {
            // A control cycle can begin only at a poll.
            Self::None => CONTROL_PERIOD + POLL,
            // After the stall the master receives the echo, polls, and sends.
            Self::Stall(span) => CONTROL_PERIOD + span + POLL.times(3),
            Self::Power => limits.power(),
            Self::Silence => limits.silent(),
            Self::Mute => limits.mute(),
            Self::Refused(period) => period.times(2) + limits.mute(),
            Self::Clock(period) => (period + POLL).max(limits.silent()),
        }
    }

    /// Returns the loss caused by a clock error of `permille` (negative if the clock is slow). The
    /// control period is wrong until the system detects the error.
    #[must_use]
    pub const fn of_clock(permille: i32) -> Self {
        Self::Clock(period_of(permille))
    }

    /// Returns the loss caused by such a clock error if the system cannot detect it itself.
    pub(crate) const fn of_refused_clock(permille: i32) -> Self {
        Self::Refused(period_of(permille))
    }
}

/// Returns the real control period under this clock error: 10 ms, or more if the clock is slow.
const fn period_of(permille: i32) -> Duration {
    let slow = if permille < 0 {
        permille.unsigned_abs()
    } else {
        0
    };
    Duration::from_us(10_000_000 / (1_000 - slow as u64))
}
