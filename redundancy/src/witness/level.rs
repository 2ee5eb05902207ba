//! The witness of the power level: what the line says, and whether it is believed.

use tandem_board::{Duration, Instant};

/// The other system's power level line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Level {
    /// The other system has power, or the line is cut.
    High,
    /// The other system has no power, so it cannot transmit.
    Low {
        /// Since when.
        since: Instant,
    },
    /// The line is low, but the other system was seen to live: the line is broken. It is not
    /// believed until it is high again.
    Broken,
}

impl Level {
    pub(crate) fn update(&mut self, now: Instant, powered: bool) {
        *self = match *self {
            _ if powered => Self::High,
            Self::High => Self::Low { since: now },
            low => low,
        };
    }

    /// The other system was seen to live. `under_way`: a sign of life that is seen later
    /// than this after the fall of the level was sent after the fall.
    pub(crate) fn on_incarnation(&mut self, now: Instant, under_way: Duration) {
        if let Self::Low { since } = *self
            && now.since(since) > under_way
        {
            *self = Self::Broken;
        }
    }

    /// The other system drives in a new term: it cannot do so without power.
    pub(crate) fn on_drive(&mut self) {
        if let Self::Low { .. } = self {
            *self = Self::Broken;
        }
    }

    /// Whether the other system is without power.
    pub(crate) const fn is_off(self) -> bool {
        matches!(self, Self::Low { .. })
    }
}
