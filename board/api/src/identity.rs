//! The identity of a core: system, number, incarnation.

use core::fmt;

/// One of the two systems of the controller. T-CHIP-1
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SystemId {
    /// System A, initialised as master.
    A,
    /// System B, initialised as standby.
    B,
}

impl SystemId {
    /// Both systems, A first.
    pub const ALL: [Self; 2] = [Self::A, Self::B];

    /// Returns the other system of the pair.
    #[must_use]
    pub const fn peer(self) -> Self {
        match self {
            Self::A => Self::B,
            Self::B => Self::A,
        }
    }

    /// Returns 0 for A, 1 for B.
    #[must_use]
    pub const fn index(self) -> usize {
        self as usize
    }

    /// The inverse of [`SystemId::index`].
    #[must_use]
    pub const fn from_index(index: usize) -> Option<Self> {
        match index {
            0 => Some(Self::A),
            1 => Some(Self::B),
            _ => None,
        }
    }
}

impl fmt::Display for SystemId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::A => "A",
            Self::B => "B",
        })
    }
}

/// One of the three cores of a system: 0 control, 1 perception, 2 planning. T-CHIP-2
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct CoreId(u8);

impl CoreId {
    /// Number of cores in a system.
    pub const COUNT: usize = 3;
    /// The boot and control core.
    pub const CONTROL: Self = Self(0);
    /// The perception core.
    pub const PERCEPTION: Self = Self(1);
    /// The planning core.
    pub const PLANNING: Self = Self(2);
    /// All cores of a system, in order.
    pub const ALL: [Self; Self::COUNT] = [Self::CONTROL, Self::PERCEPTION, Self::PLANNING];

    /// Returns the core with this number; `None` if a system has no such core.
    #[must_use]
    pub const fn new(number: u8) -> Option<Self> {
        if (number as usize) < Self::COUNT {
            Some(Self(number))
        } else {
            None
        }
    }

    /// Returns 0, 1 or 2.
    #[must_use]
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

impl fmt::Display for CoreId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}

/// A core of the controller: its system and its number. Displayed as, for example, `A0`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct CoreAddress {
    /// The system that the core belongs to.
    pub system: SystemId,
    /// The core's number within the system.
    pub core: CoreId,
}

impl CoreAddress {
    /// Control core of system A.
    pub const A0: Self = Self::new(SystemId::A, CoreId::CONTROL);
    /// Perception core of system A.
    pub const A1: Self = Self::new(SystemId::A, CoreId::PERCEPTION);
    /// Planning core of system A.
    pub const A2: Self = Self::new(SystemId::A, CoreId::PLANNING);
    /// Control core of system B.
    pub const B0: Self = Self::new(SystemId::B, CoreId::CONTROL);
    /// Perception core of system B.
    pub const B1: Self = Self::new(SystemId::B, CoreId::PERCEPTION);
    /// Planning core of system B.
    pub const B2: Self = Self::new(SystemId::B, CoreId::PLANNING);
    /// Number of cores in both systems together.
    pub const COUNT: usize = SystemId::ALL.len() * CoreId::COUNT;
    /// All cores in the order of [`CoreAddress::index`].
    pub const ALL: [Self; Self::COUNT] =
        [Self::A0, Self::A1, Self::A2, Self::B0, Self::B1, Self::B2];

    /// Returns core `core` of system `system`.
    #[must_use]
    pub const fn new(system: SystemId, core: CoreId) -> Self {
        Self { system, core }
    }

    /// Returns 0 ..= 5: the index in [`CoreAddress::ALL`].
    #[must_use]
    pub const fn index(self) -> usize {
        self.system.index() * CoreId::COUNT + self.core.index()
    }

    /// The inverse of [`CoreAddress::index`]; `None` above 5.
    #[must_use]
    pub const fn from_index(index: usize) -> Option<Self> {
        if index < Self::COUNT {
            Some(Self::ALL[index])
        } else {
            None
        }
    }
}

impl fmt::Display for CoreAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", self.system, self.core)
    }
}

/// Number of a core's incarnation: 1 after power-on, then one more after each reset of the core. 0
/// means no core.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Generation(pub u32);

/// A core and one of its incarnations.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Identity {
    /// The system that the core belongs to.
    pub system: SystemId,
    /// The core's number within the system.
    pub core: CoreId,
    /// The incarnation.
    pub generation: Generation,
}

impl Identity {
    /// Returns the core, without its incarnation.
    #[must_use]
    pub const fn address(self) -> CoreAddress {
        CoreAddress::new(self.system, self.core)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_core_has_one_number_and_each_number_one_core() {
        for (index, address) in CoreAddress::ALL.into_iter().enumerate() {
            assert_eq!(address.index(), index);
            assert_eq!(CoreAddress::from_index(index), Some(address));
        }
        assert_eq!(CoreAddress::from_index(CoreAddress::COUNT), None);
        assert_eq!(CoreAddress::from_index(usize::MAX), None);
    }
}
