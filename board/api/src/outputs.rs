//! The low-side switches of a system's outputs, and what their diagnosis register says.

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

impl OutputDiagnosis {
    /// All of them, in the order of their codes.
    pub const ALL: [Self; 3] = [Self::Good, Self::OpenLoad, Self::ShortCircuit];

    /// The number by which a diagnosis is passed on.
    #[must_use]
    pub const fn code(self) -> u32 {
        self as u32
    }

    /// The inverse of [`OutputDiagnosis::code`].
    #[must_use]
    pub fn from_code(code: u32) -> Option<Self> {
        Self::ALL.get(code as usize).copied()
    }
}
