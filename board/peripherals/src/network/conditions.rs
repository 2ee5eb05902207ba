//! Cut and disturbed connections between the systems, and the effect on each connection.

use tandem_board::{Duration, HardwareFaults, Line, SystemId};

/// Maximum number of datagrams in transit on the link, in each direction.
pub const LINK_DATAGRAMS: usize = 16;

/// A connection that a test can cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Wire {
    /// A line from one system to the other: its edges do not arrive.
    Line(Line),
    /// The level line that shows a system's power to the other: it reads as high.
    Level,
    /// The data link from one system to the other: its datagrams do not arrive.
    Link,
    /// A system's connection to the CAN bus: it neither sends nor receives.
    Can,
}

impl Wire {
    /// The wires that start at a system.
    pub const ALL: [Self; 7] = [
        Self::Line(Line::Start),
        Self::Line(Line::Heartbeat1),
        Self::Line(Line::Heartbeat2),
        Self::Line(Line::Time),
        Self::Level,
        Self::Link,
        Self::Can,
    ];

    /// Returns its name, as commands and fault files write it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Line(Line::Start) => "start",
            Self::Line(Line::Heartbeat1) => "heartbeat-1",
            Self::Line(Line::Heartbeat2) => "heartbeat-2",
            Self::Line(Line::Time) => "time",
            Self::Level => "level",
            Self::Link => "link",
            Self::Can => "can",
        }
    }
}

/// The cut wires as a register, one bit for each wire of each system.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Cuts(pub u32);

impl Cuts {
    /// Returns the bit of a wire that starts at system `from`.
    #[must_use]
    pub const fn bit(wire: Wire, from: SystemId) -> u32 {
        let number = match wire {
            Wire::Line(line) => line.index(),
            Wire::Level => 4,
            Wire::Link => 5,
            Wire::Can => 6,
        };
        1 << (8 * from.index() + number)
    }

    /// Returns whether this wire is cut.
    #[must_use]
    pub const fn is_cut(self, wire: Wire, from: SystemId) -> bool {
        self.0 & Self::bit(wire, from) != 0
    }

    /// Returns the cut wires that start at this system, one bit for each, in the order of
    /// [`Wire::ALL`].
    #[must_use]
    pub const fn of(self, from: SystemId) -> u8 {
        (self.0 >> (8 * from.index())) as u8
    }

    /// Cuts a wire, or restores it.
    pub const fn set(&mut self, wire: Wire, from: SystemId, is_cut: bool) {
        if is_cut {
            self.0 |= Self::bit(wire, from);
        } else {
            self.0 &= !Self::bit(wire, from);
        }
    }
}

/// The faults of a system's connection to the CAN bus. The default is none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BusFault {
    /// How many of a thousand frames that the system sends do not reach the bus. 1000: its
    /// transmitter is dead.
    pub lost_out: u16,
    /// How many of a thousand frames on the bus do not reach the system. 1000: its receiver is
    /// dead.
    pub lost_in: u16,
    /// Delay with which its frames reach the bus.
    pub late: Duration,
    /// The standard id of a frame that core 0, and one that core 1 does not hear.
    pub deaf_to: [Option<u16>; 2],
}

/// Everything that disturbs the network. By default nothing does.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Conditions {
    /// The cut wires.
    pub cuts: Cuts,
    /// Whether the level line of each system is held low.
    pub held_low: [bool; 2],
    /// The connection of each system to the bus.
    pub bus: [BusFault; 2],
    /// The hardware faults of each system; those of its CAN transceiver disturb the bus.
    pub hardware: [HardwareFaults; 2],
}

impl Conditions {
    /// Returns the level of a system's line as the other system reads it. High while the supply is
    /// on and no fault holds the line low. A cut line reads as high.
    #[must_use]
    pub const fn level(&self, of: SystemId, is_on: bool) -> bool {
        is_on && !self.held_low[of.index()] || self.cuts.is_cut(Wire::Level, of)
    }

    /// Returns whether a fault of a connection or of the hardware may disturb frames.
    #[must_use]
    pub fn disturb_bus(&self) -> bool {
        let clean = Self::default();
        (self.bus, self.hardware) != (clean.bus, clean.hardware)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_wire_is_cut_and_restored_by_itself() {
        for cut_from in SystemId::ALL {
            for cut in Wire::ALL {
                let mut cuts = Cuts::default();
                cuts.set(cut, cut_from, true);
                for from in SystemId::ALL {
                    for wire in Wire::ALL {
                        let expected = (wire, from) == (cut, cut_from);
                        assert_eq!(cuts.is_cut(wire, from), expected, "{wire:?} {from}");
                    }
                }
                cuts.set(cut, cut_from, false);
                assert_eq!(cuts, Cuts::default());
            }
        }
    }

    #[test]
    fn a_level_line_falls_with_the_power_or_when_held_unless_it_is_cut() {
        let mut conditions = Conditions::default();
        let a = SystemId::A;
        assert!(conditions.level(a, true) && !conditions.level(a, false));
        conditions.held_low[a.index()] = true;
        assert!(!conditions.level(a, true), "held low");
        assert!(conditions.level(SystemId::B, true), "the other line");
        conditions.cuts.set(Wire::Level, a, true);
        assert!(conditions.level(a, true) && conditions.level(a, false));
    }
}
