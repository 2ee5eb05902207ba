//! The hardware faults that each board can produce.

use crate::{Board, SystemId};

/// A fault of a system's hardware. It lasts until it is repaired, also over resets and power loss.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum HardwareFault {
    /// The load of a switch of the output driver, or its wire, is gone.
    OpenLoad,
    /// A switch of the output driver carries too much current.
    ShortCircuit,
    /// The bus destroys each frame that the system sends.
    CanTransmit,
    /// The system's CAN receiver finds an error in each frame on the bus.
    CanReceive,
    /// The chip's safety unit shows an error on the error pin to the supply.
    ErrorPin,
    /// A rail of the supply has too little voltage.
    Undervoltage,
    /// A rail of the supply has too much voltage.
    Overvoltage,
}

impl HardwareFault {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::OpenLoad,
        Self::ShortCircuit,
        Self::CanTransmit,
        Self::CanReceive,
        Self::ErrorPin,
        Self::Undervoltage,
        Self::Overvoltage,
    ];
}

/// Which faults a system has, one bit for each: a register.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct HardwareFaults(pub u32);

impl HardwareFaults {
    /// The bit of a fault.
    #[must_use]
    pub const fn bit(fault: HardwareFault) -> u32 {
        1 << fault as u32
    }

    /// Whether the system has this fault.
    #[must_use]
    pub const fn has(self, fault: HardwareFault) -> bool {
        self.0 & Self::bit(fault) != 0
    }

    /// Makes a fault or repairs it.
    pub const fn set(&mut self, fault: HardwareFault, present: bool) {
        if present {
            self.0 |= Self::bit(fault);
        } else {
            self.0 &= !Self::bit(fault);
        }
    }

    /// What the diagnosis register of the output driver says. A short circuit hides an open load.
    #[must_use]
    pub const fn outputs(self) -> OutputDiagnosis {
        if self.has(HardwareFault::ShortCircuit) {
            OutputDiagnosis::ShortCircuit
        } else if self.has(HardwareFault::OpenLoad) {
            OutputDiagnosis::OpenLoad
        } else {
            OutputDiagnosis::Good
        }
    }
}

/// What the diagnosis register of the output driver says.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum OutputDiagnosis {
    /// No fault.
    #[default]
    Good,
    /// A switch is closed and no current flows: the load or its wire is gone.
    OpenLoad,
    /// A switch is closed and too much current flows.
    ShortCircuit,
}

/// A board whose hardware can be made to fail, for tests. Product code has no use for it.
pub trait FaultSource: Board {
    /// Makes a fault of a system's hardware, or repairs it. Any context; also from the other
    /// system. The effect may be a few milliseconds late.
    fn set_fault(&self, of: SystemId, fault: HardwareFault, present: bool);
}
