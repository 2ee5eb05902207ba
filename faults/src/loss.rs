//! How long the vehicle may be without control under each fault.

use tandem_board::Duration;
use tandem_record::verdict::Limits;
use tandem_record::verdict::required_limits::{CONTROL_PERIOD, POLL};

/// How the vehicle loses its master. Each has a bound.
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
    /// Its clock is wrong: its control period is really this long, at least 10 ms.
    Clock(Duration),
    /// Its clock is wrong, and without the link it cannot detect this. The gate refuses its frames
    /// as late; after two of them it falls silent, and then it counts as mute.
    Refused(Duration),
}

impl Loss {
    /// Returns the longest time between two control frames that act.
    #[must_use]
    pub fn bound(self, limits: &Limits) -> Duration {
        match self {
            // A cycle begins at a poll.
            Self::None => CONTROL_PERIOD + POLL,
            // The master receives the echo, polls, and sends.
            Self::Stall(span) => CONTROL_PERIOD + span + POLL.times(3),
            Self::Power => limits.power(),
            Self::Silence => limits.silent(),
            Self::Mute => limits.mute(),
            Self::Refused(period) => period.times(2) + limits.mute(),
            Self::Clock(period) => (period + POLL).max(limits.silent()),
        }
    }

    /// Returns the loss caused by a clock error of `permille` (below 0: slow): until the system
    /// detects it, the control period is wrong too.
    #[must_use]
    pub const fn of_clock(permille: i32) -> Self {
        Self::Clock(period_of(permille))
    }

    /// Returns the loss caused by such a clock error if the system cannot detect it itself.
    pub(crate) const fn of_refused_clock(permille: i32) -> Self {
        Self::Refused(period_of(permille))
    }
}

/// Returns the real length of the control period under this clock error; 10 ms if it is not slow.
const fn period_of(permille: i32) -> Duration {
    let slow = if permille < 0 {
        permille.unsigned_abs()
    } else {
        0
    };
    Duration::from_us(10_000_000 / (1_000 - slow as u64))
}
