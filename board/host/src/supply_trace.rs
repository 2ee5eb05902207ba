//! What a supply writes to its trace: the deaths and resets that no core can report itself.

use tandem_board::{CoreId, Generation, ResetCause, TraceRecord};

/// One thing that a supply did or saw.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SupplyEvent {
    /// It started a core.
    CoreStarted {
        /// Which.
        core: CoreId,
        /// In which of its lives.
        generation: Generation,
    },
    /// A core ended while the system was on: by itself or by a signal from outside.
    CoreDied {
        /// Which.
        core: CoreId,
        /// The signal; 0 if it ended by itself or nobody knows.
        signal: u8,
    },
    /// It took the system down and will start it anew.
    Reset(ResetCause),
    /// It took the system down for good: the system asked for it.
    Suspended,
}

impl SupplyEvent {
    /// The event as a record.
    #[must_use]
    pub fn encode(self) -> TraceRecord {
        match self {
            Self::CoreStarted { core, generation } => [1, core.index() as u32, generation.0, 0],
            Self::CoreDied { core, signal } => [2, core.index() as u32, signal.into(), 0],
            Self::Reset(cause) => [3, cause as u32, 0, 0],
            Self::Suspended => [4, 0, 0, 0],
        }
    }

    /// The event in a record; `None` if no supply wrote it.
    #[must_use]
    pub fn decode([kind, x, y, _]: TraceRecord) -> Option<Self> {
        let core = || CoreId::new(u8::try_from(x).ok()?);
        Some(match kind {
            1 => Self::CoreStarted {
                core: core()?,
                generation: Generation(y),
            },
            2 => Self::CoreDied {
                core: core()?,
                signal: u8::try_from(y).ok()?,
            },
            3 => Self::Reset(match x {
                0 => ResetCause::PowerOn,
                1 => ResetCause::Software,
                2 => ResetCause::Watchdog,
                3 => ResetCause::Trap,
                _ => return None,
            }),
            4 => Self::Suspended,
            _ => return None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_event_of_a_supply_survives_its_trace() {
        let causes = [
            ResetCause::PowerOn,
            ResetCause::Software,
            ResetCause::Watchdog,
            ResetCause::Trap,
        ];
        let mut events = vec![
            SupplyEvent::CoreStarted {
                core: CoreId::PLANNING,
                generation: Generation(7),
            },
            SupplyEvent::CoreDied {
                core: CoreId::PERCEPTION,
                signal: 9,
            },
            SupplyEvent::Suspended,
        ];
        events.extend(causes.map(SupplyEvent::Reset));
        for event in events {
            assert_eq!(SupplyEvent::decode(event.encode()), Some(event));
        }
        for strange in [[0; 4], [1, 3, 0, 0], [2, 0, 999, 0], [3, 4, 0, 0], [5; 4]] {
            assert_eq!(SupplyEvent::decode(strange), None);
        }
    }
}
