//! Interrupts by number and priority, as in the TC297's interrupt router.

/// A source of interrupts of this core.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Interrupt(u8);

impl Interrupt {
    /// The inter-core interrupt. On riscv32 it is the machine software interrupt.
    pub const DOORBELL: Self = Self(0);
    /// On riscv32 the machine external interrupt; on the host an ordinary source.
    pub const EXTERNAL: Self = Self(1);
    /// The highest number of a source. The tick has the next number.
    pub const LAST: Self = Self(62);

    /// Returns source `number`, 0 to 62. The target has [`Self::DOORBELL`] and [`Self::EXTERNAL`].
    ///
    /// # Panics
    /// If `number` is above 62; in a constant, this is a compile error.
    #[must_use]
    pub const fn new(number: u8) -> Self {
        assert!(number <= Self::LAST.0, "interrupts end at 62");
        Self(number)
    }

    /// Returns the number.
    #[must_use]
    pub const fn number(self) -> u8 {
        self.0
    }
}

/// How urgent an interrupt is: a more urgent one interrupts the handler of a less urgent one. The
/// chip's numbers are used, 1 to 255: 1 is the reschedule (T-RTOS-2), 2 the tick.
///
/// On riscv32 handlers do not nest, and the number has no effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct InterruptPriority(u8);

impl InterruptPriority {
    /// One above the tick.
    pub const LOWEST: Self = Self(3);
    /// The most urgent.
    pub const HIGHEST: Self = Self(255);

    /// Returns the priority `level`, 3 to 255.
    ///
    /// # Panics
    /// If `level` is below 3; in a constant, this is a compile error.
    #[must_use]
    pub const fn new(level: u8) -> Self {
        assert!(
            level >= Self::LOWEST.0,
            "priorities 0 to 2 are the kernel's"
        );
        Self(level)
    }

    /// Returns the number.
    #[must_use]
    pub const fn level(self) -> u8 {
        self.0
    }
}

/// Why a handler cannot be registered.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum HandlerError {
    /// The source already has a handler, which stays until the scheduler stops.
    #[error("the interrupt has a handler already")]
    HasHandler,
    /// This machine has no such source.
    #[error("this machine has no such interrupt")]
    NoSuchSource,
}
