//! Trace records for people, kept by the board: those of its cores, and those of the supplies,
//! which start and stop the cores.
//!
//! The driving functions never read a trace. The portable code that writes a core's records
//! defines their meaning.

use crate::{CoreId, Generation, Instant, ResetCause, SystemId};

/// One record: four words. The board adds the time and the core.
pub type TraceRecord = [u32; 4];

/// A core's record, as read from the board.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Traced {
    /// When the core wrote it.
    pub at: Instant,
    /// The core's system.
    pub system: SystemId,
    /// The core.
    pub core: CoreId,
    /// The record.
    pub record: TraceRecord,
}

/// An event of a supply: a start, a death or a reset, which a core cannot report itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SupplyEvent {
    /// The supply started a core.
    CoreStarted {
        /// The core.
        core: CoreId,
        /// Its incarnation.
        generation: Generation,
    },
    /// A core ended while the system was on: by itself or by a signal from outside.
    CoreDied {
        /// The core.
        core: CoreId,
        /// The signal; 0 if the core ended by itself or the signal is unknown.
        signal: u8,
    },
    /// The supply stopped the system and will restart it.
    Reset(ResetCause),
    /// The supply stopped the system until the next power-on: the system requested it, or a rail's
    /// voltage was too high.
    Suspended,
}

impl SupplyEvent {
    /// Encodes the event as a record.
    #[must_use]
    pub fn encode(self) -> TraceRecord {
        match self {
            Self::CoreStarted { core, generation } => [1, core.index() as u32, generation.0, 0],
            Self::CoreDied { core, signal } => [2, core.index() as u32, signal.into(), 0],
            Self::Reset(cause) => [3, cause.code(), 0, 0],
            Self::Suspended => [4, 0, 0, 0],
        }
    }

    /// Decodes a record; `None` if it is not a record of a supply.
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
            3 => Self::Reset(ResetCause::from_code(x)?),
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
        let causes = ResetCause::ALL;
        let others = [
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
        for event in causes.map(SupplyEvent::Reset).into_iter().chain(others) {
            assert_eq!(SupplyEvent::decode(event.encode()), Some(event));
        }
        for strange in [[0; 4], [1, 3, 0, 0], [2, 0, 999, 0], [3, 7, 0, 0], [5; 4]] {
            assert_eq!(SupplyEvent::decode(strange), None);
        }
    }
}
