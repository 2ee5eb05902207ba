//! The wires between the two systems: ERU lines and the data link. T-CHIP-5, S-3

use crate::Instant;

/// A hard-wired line to the other system. Each line exists once in each direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Line {
    /// Start protocol: handshake on the rising edge, sync on the falling edge. Edges interrupt core
    /// 0.
    Start,
    /// First heartbeat line. Edges are counted and do not interrupt.
    Heartbeat1,
    /// Second heartbeat line, redundant to the first.
    Heartbeat2,
    /// Time synchronisation: the rising edge marks an instant, see [`Lines::time_edge`]. Edges do
    /// not interrupt: hardware captures their times, and the receiver needs a datagram to use one.
    Time,
}

impl Line {
    /// All lines.
    pub const ALL: [Self; 4] = [Self::Start, Self::Heartbeat1, Self::Heartbeat2, Self::Time];

    /// Returns whether an edge interrupts core 0 of the receiving system.
    #[must_use]
    pub const fn interrupts(self) -> bool {
        matches!(self, Self::Start)
    }

    /// Returns 0 ..= 3.
    #[must_use]
    pub const fn index(self) -> usize {
        self as usize
    }
}

/// The type of an edge.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Edge {
    /// Low to high.
    Rising,
    /// High to low.
    Falling,
}

/// A rising edge that was received on [`Line::Time`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TimeEdge {
    /// Its number since power-on, from 1: what [`Lines::received`] returned when it came. Wraps
    /// around.
    pub count: u32,
    /// When it came, on this system's clock.
    pub at: Instant,
}

/// This system's ends of the lines.
pub trait Lines {
    /// Sends one edge. Any context. It orders no memory accesses: the systems share no memory.
    fn send(&self, line: Line, edge: Edge);

    /// Returns how many edges of this type this line has received since this system's power-on. Any
    /// context. The count wraps around and survives the reset of a core, so take differences.
    fn received(&self, line: Line, edge: Edge) -> u32;

    /// Returns the newest rising edge on [`Line::Time`]; `None` before the first since this
    /// system's power-on. Any context. S-3
    ///
    /// Hardware stamps each edge when it comes, whatever the cores do: a capture unit, or on a
    /// board without one a handler that only reads the clock. `count` and `at` always belong to one
    /// edge, and survive the reset of a core. An edge may be counted a moment before its stamp can
    /// be read. `at` is not after the call, and a newer edge has no earlier time. A sender that
    /// dies in the middle of an edge may leave it counted but without a stamp.
    fn time_edge(&self) -> Option<TimeEdge>;

    /// Reads the level line of the other system's supply. Any context. High while that supply is on
    /// and its system is out of reset. Falls when that system loses power or its safety chip holds
    /// it in reset. Low means that the other system cannot transmit; high does not mean that its
    /// software works. A cut line reads as high.
    fn peer_powered(&self) -> bool;
}

/// The transmit buffer of the link is full; no part of the datagram was accepted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct LinkFull;

impl core::fmt::Display for LinkFull {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("the transmit buffer of the link is full")
    }
}

impl core::error::Error for LinkFull {}

/// The bulk data link to the other system (HSSL; SPI would work the same way): datagrams, in order,
/// not acknowledged. The receiver must check the content.
pub trait Link {
    /// The largest datagram in words.
    const MAX_WORDS: usize;

    /// Sends one datagram of up to [`Link::MAX_WORDS`] words. One at a time.
    ///
    /// # Errors
    /// [`LinkFull`] if the buffer is full.
    ///
    /// # Panics
    /// If the datagram is longer than [`Link::MAX_WORDS`].
    fn try_send(&self, words: &[u32]) -> Result<(), LinkFull>;

    /// Copies the next datagram into `words` and returns its length in words; `None` if there is
    /// none. One at a time. A datagram longer than `words` is cut off.
    fn try_receive(&self, words: &mut [u32]) -> Option<usize>;
}
