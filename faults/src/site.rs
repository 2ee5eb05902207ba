//! The boards on which faults are injected.

use std::fmt;

/// A board that can suffer faults.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Site {
    /// The simulator: both systems in virtual time.
    Simulator,
    /// Processes on this machine.
    Processes,
    /// Emulated machines with firmware.
    Machines,
}

impl fmt::Display for Site {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Simulator => "the simulator",
            Self::Processes => "processes",
            Self::Machines => "emulated machines",
        })
    }
}
