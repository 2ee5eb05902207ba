//! Who a core is.

use core::fmt;

/// One of the two systems of the controller. T-CHIP-1
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum SystemId {
    /// System A, initialised as master.
    A,
    /// System B, initialised as standby.
    B,
}

impl SystemId {
    /// Both systems, A first.
    pub const ALL: [Self; 2] = [Self::A, Self::B];

    /// The other system of the pair.
    #[must_use]
    pub const fn peer(self) -> Self {
        match self {
            Self::A => Self::B,
            Self::B => Self::A,
        }
    }

    /// 0 for A, 1 for B.
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
pub struct CoreId(u8);

impl CoreId {
    /// How many cores a system has.
    pub const COUNT: usize = 3;
    /// The boot and control core.
    pub const CONTROL: Self = Self(0);
    /// The perception core.
    pub const PERCEPTION: Self = Self(1);
    /// The planning core.
    pub const PLANNING: Self = Self(2);
    /// All cores of a system, in order.
    pub const ALL: [Self; Self::COUNT] = [Self::CONTROL, Self::PERCEPTION, Self::PLANNING];

    /// The core with this number; `None` if a system has no such core.
    #[must_use]
    pub const fn new(number: u8) -> Option<Self> {
        if (number as usize) < Self::COUNT {
            Some(Self(number))
        } else {
            None
        }
    }

    /// 0, 1 or 2.
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

/// Which life of a core this is: 1 after power-on, one more after each reset of the core; 0 is "no
/// core".
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Generation(pub u32);

/// A core, in one of its lives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Identity {
    /// The system that the core belongs to.
    pub system: SystemId,
    /// The core's number within the system.
    pub core: CoreId,
    /// Which of its lives.
    pub generation: Generation,
}
