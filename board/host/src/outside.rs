//! What is done to the systems of a run from outside, for its recording: injected faults, and their
//! ends.

use tandem_board::{Handled, HardwareFault, SystemId};
use tandem_peripherals::network::{BusFault, Conditions, Wire};

use crate::backplane::{Backplane, Deed};

/// The conditions that were last reported.
#[derive(Debug, Default)]
pub(crate) struct Outside {
    told: Conditions,
}

impl Outside {
    /// Passes on each change since the last call.
    pub(crate) fn follow(&mut self, backplane: Backplane, into: &mut dyn FnMut(Handled<'_>)) {
        let now = backplane.conditions();
        let before = core::mem::replace(&mut self.told, now);
        for system in SystemId::ALL {
            let (index, cuts) = (system.index(), now.cuts.of(system));
            let mut tell = |what: core::fmt::Arguments<'_>| into(Handled { system, what, cuts });
            for noted in backplane.take_noted(system) {
                tell(format_args!("{}", deed(noted)));
            }
            for wire in Wire::ALL {
                let is_cut = now.cuts.is_cut(wire, system);
                if is_cut != before.cuts.is_cut(wire, system) {
                    let what = if is_cut { "cut" } else { "mended" };
                    tell(format_args!("its wire {} is {what}", wire.name()));
                }
            }
            for fault in HardwareFault::ALL {
                let is_there = now.hardware[index].has(fault);
                if is_there != before.hardware[index].has(fault) {
                    let what = if is_there { "begins" } else { "ends" };
                    tell(format_args!("fault {what}: {}", words(fault)));
                }
            }
            if before.held_low[index] != now.held_low[index] {
                let what = if now.held_low[index] {
                    "held low"
                } else {
                    "free again"
                };
                tell(format_args!("its power level line is {what}"));
            }
            if before.bus[index] != now.bus[index] {
                let is_sound = now.bus[index] == BusFault::default();
                let what = if is_sound {
                    "is sound again"
                } else {
                    "is disturbed"
                };
                tell(format_args!("its connection to the CAN bus {what}"));
            }
        }
    }
}

const fn words(fault: HardwareFault) -> &'static str {
    match fault {
        HardwareFault::OpenLoad => "open load of an output driver",
        HardwareFault::ShortCircuit => "short circuit of an output driver",
        HardwareFault::CanTransmit => "the bus destroys what it sends on CAN",
        HardwareFault::CanReceive => "it finds an error in each CAN frame",
        HardwareFault::ErrorPin => "error pin",
        HardwareFault::Undervoltage => "undervoltage",
        HardwareFault::Overvoltage => "overvoltage",
        HardwareFault::Network => "the cable of its network is cut",
    }
}

/// Returns a deed in words.
const fn deed(it: Deed) -> &'static str {
    match it {
        Deed::PowerOff => "its power is switched off",
        Deed::PowerOn => "its power is switched on",
        Deed::Reset => "a reset is requested",
        Deed::Hang => "its core 0 is stopped for 100 ms",
        Deed::Scribble => "its LMU is overwritten",
        Deed::StrayEdge => "an edge that it did not send is on the start line",
    }
}
