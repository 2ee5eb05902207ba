//! The hardware faults that each board can produce.

use crate::{Board, SystemId};

/// A hardware fault of a system. It lasts until it is repaired, even across resets and power loss.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum HardwareFault {
    /// The load of an output driver's switch, or the wire to it, is disconnected.
    OpenLoad,
    /// A switch of the output driver carries too much current.
    ShortCircuit,
    /// The bus destroys each frame that the system sends.
    CanTransmit,
    /// The system's CAN receiver finds an error in each frame on the bus.
    CanReceive,
    /// The chip's safety unit signals an error to the supply on the error pin.
    ErrorPin,
    /// A supply rail's voltage is too low.
    Undervoltage,
    /// A supply rail's voltage is too high.
    Overvoltage,
    /// The cable of the Ethernet port is cut: no datagram leaves or arrives.
    Network,
}

impl HardwareFault {
    /// All faults.
    pub const ALL: [Self; 8] = [
        Self::OpenLoad,
        Self::ShortCircuit,
        Self::CanTransmit,
        Self::CanReceive,
        Self::ErrorPin,
        Self::Undervoltage,
        Self::Overvoltage,
        Self::Network,
    ];
}

/// The faults of a system as a register, one bit for each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct HardwareFaults(pub u32);

impl HardwareFaults {
    /// Returns the bit of a fault.
    #[must_use]
    pub const fn bit(fault: HardwareFault) -> u32 {
        1 << fault as u32
    }

    /// Returns whether the system has this fault.
    #[must_use]
    pub const fn has(self, fault: HardwareFault) -> bool {
        self.0 & Self::bit(fault) != 0
    }

    /// Sets or clears a fault.
    pub const fn set(&mut self, fault: HardwareFault, present: bool) {
        if present {
            self.0 |= Self::bit(fault);
        } else {
            self.0 &= !Self::bit(fault);
        }
    }

    /// Reads the output driver's diagnosis register. A short circuit hides an open load.
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

/// Content of the output driver's diagnosis register.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum OutputDiagnosis {
    /// No fault.
    #[default]
    Good,
    /// A switch is closed and no current flows: the load or its wire is disconnected.
    OpenLoad,
    /// A switch is closed and too much current flows.
    ShortCircuit,
}

/// A board whose hardware can be made to fail, for tests. Product code does not use it.
pub trait FaultSource: Board {
    /// Injects or repairs a hardware fault of a system. Any context; also from the other system.
    /// The effect may be a few milliseconds late.
    fn set_fault(&self, of: SystemId, fault: HardwareFault, present: bool);
}
