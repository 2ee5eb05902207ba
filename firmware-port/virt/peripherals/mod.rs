//! The emulated peripherals: CAN bus, lines, link, Ethernet, data flash, and the two supplies.
//!
//! The machine has none of these, so a separate hart emulates them: the *carrier*, named after the
//! carrier board of a TC297. Cores access registers, which are atomics in the carrier's memory; the
//! doorbell interrupts them. Effects without delay (edges, flash) happen on the core that accesses
//! the register. Effects that need a third party (the bus, the supplies) happen on the carrier's
//! hart. The models of `tandem-peripherals` decide the effects.
//!
//! A vehicle process may run on the host. The carrier then exchanges messages with it once in each
//! millisecond of virtual time: see [`Peripherals::connect`]. Edges and datagrams to a system that
//! is not in this machine collect in its registers here, and are sent with the next exchange. An
//! edge on the time line keeps the stamp that it got when it was sent: all machines have one time.
//! A frame is stamped when it is on the bus of the sender's machine. Another machine receives both
//! up to two exchanges later.

pub(crate) mod data_flash;
mod ethernet;
mod host;
pub(crate) mod ring;
pub(crate) mod run;

pub use run::Peripherals;

use crate::hart::{self, CARRIER};
use crate::interrupts;
use core::sync::atomic::{AtomicBool, AtomicU8, AtomicU32, Ordering};
use ring::Ring;
use tandem_board::{
    CoreAddress, CoreId, Edge, HardwareFault, HardwareFaults, Instant, Line, SystemId, TimeEdge,
};
use tandem_peripherals::codec::{DATAGRAM_WORDS, FRAME_WORDS, SERVICE_WORDS, TRACE_WORDS};
use tandem_peripherals::network::LINK_DATAGRAMS;
use tandem_peripherals::stamp::{CAPTURE_WORDS, Capture, STAMP_WORDS, TimeStamp};

/// The carrier's registers for one core.
#[repr(C)]
pub(crate) struct CoreRegisters {
    /// Frames that the core has sent and that are not yet on the bus.
    pub(crate) transmit: Ring<32, FRAME_WORDS>,
    /// Frames received from the bus.
    pub(crate) receive: Ring<256, FRAME_WORDS>,
    pub(crate) overruns: AtomicU32,
    /// The error counters of the CAN controller, packed in one word.
    pub(crate) can_errors: AtomicU32,
    /// The mark of the newest frame that the core wants stamped. Goes on over its incarnations.
    pub(crate) marks: AtomicU32,
    /// When that frame was on the bus.
    pub(crate) stamp: [AtomicU32; STAMP_WORDS],
    pub(crate) wake_on_receive: AtomicBool,
    /// Trace records: 2 words of time and 4 words of record.
    pub(crate) trace: Ring<512, TRACE_WORDS>,
    pub(crate) trace_lost: AtomicU32,
}

/// The carrier's registers for one system.
#[repr(C)]
pub(crate) struct SystemRegisters {
    pub(crate) cores: [CoreRegisters; CoreId::COUNT],
    /// Number of received edges, by line and type.
    pub(crate) edges: [[AtomicU32; 2]; Line::ALL.len()],
    /// How many rising edges of the time line came before power-on: they number the stamps, so a
    /// power-on does not clear their count.
    pub(crate) time_edges_before: AtomicU32,
    /// Stamps of the newest rising edges of the time line.
    pub(crate) captured: [AtomicU32; CAPTURE_WORDS],
    /// Datagrams received over the link, each with its length.
    pub(crate) link: Ring<LINK_DATAGRAMS, DATAGRAM_WORDS>,
    pub(crate) network: ethernet::Registers,
    pub(crate) flash: data_flash::Registers,
    /// Services of the watchdog that the supply has not read yet.
    pub(crate) services: Ring<4, SERVICE_WORDS>,
    /// Number of services of core 0 in this incarnation; wraps around.
    pub(crate) service_count: AtomicU32,
    /// Whether the supply is on and the system is not held in reset.
    pub(crate) powered: AtomicBool,
    /// Whether the level line to the other system is cut: then it reads as high.
    pub(crate) level_cut: AtomicBool,
    pub(crate) generation: AtomicU32,
    pub(crate) cause: AtomicU32,
    /// Starts since power-on, or since one of them was confirmed.
    pub(crate) starts: AtomicU8,
    /// The system's request to its reset generator.
    pub(crate) request: AtomicU32,
    pub(crate) lamp: AtomicU32,
    /// The faults of the system's hardware, one bit each.
    pub(crate) faults: AtomicU32,
    /// The cores that core 0 has released and that have not started yet, one bit each.
    pub(crate) released: AtomicU32,
}

impl CoreRegisters {
    /// Clears the registers to their state at power-on. The core must be stopped.
    fn clear(&self) {
        self.transmit.clear();
        self.receive.clear();
        self.overruns.store(0, Ordering::Relaxed);
        self.wake_on_receive.store(false, Ordering::Relaxed);
        self.begin_stamp();
    }

    /// Begins the record of the next stamped frame, and returns the frame's mark.
    pub(crate) fn begin_stamp(&self) -> u32 {
        let mark = self.marks.load(Ordering::Relaxed).wrapping_add(1);
        self.marks.store(mark, Ordering::Relaxed);
        TimeStamp(&self.stamp).forget(mark);
        mark
    }
}

// The linker scripts place it outside the RAM of the cores, at the same address in all images.
// SAFETY: registers are atomics, for which zero is a valid value.
#[unsafe(link_section = ".bss.carrier.systems")]
static SYSTEMS: [SystemRegisters; 2] = unsafe { core::mem::zeroed() };

/// Returns the registers of a system.
pub(crate) fn system(system: SystemId) -> &'static SystemRegisters {
    &SYSTEMS[system.index()]
}

/// Returns the registers of a core. Its hart has the number [`CoreAddress::index`].
pub(crate) fn core(address: CoreAddress) -> &'static CoreRegisters {
    &system(address.system).cores[address.core.index()]
}

impl SystemRegisters {
    /// Counts edges that arrive at the system, and stamps the last one on the time line with `at`.
    /// In one machine the hart of the sender does this: all harts have one clock.
    pub(crate) fn count_edges(
        &self,
        (line, edge): (Line, Edge),
        count: u32,
        at: impl Fn() -> Instant,
    ) {
        let edges = &self.edges[line.index()][edge as usize];
        if (line, edge) == (Line::Time, Edge::Rising) {
            edges.fetch_add(count.saturating_sub(1), Ordering::Relaxed);
            self.capture().edge(at);
        } else {
            edges.fetch_add(count, Ordering::Relaxed);
        }
    }

    /// Returns the number of edges since power-on.
    pub(crate) fn received(&self, line: Line, edge: Edge) -> u32 {
        let count = self.edges[line.index()][edge as usize].load(Ordering::Relaxed);
        match (line, edge) {
            (Line::Time, Edge::Rising) => {
                count.wrapping_sub(self.time_edges_before.load(Ordering::Relaxed))
            }
            _ => count,
        }
    }

    pub(crate) fn time_edge(&self) -> Option<TimeEdge> {
        let before = self.time_edges_before.load(Ordering::Relaxed);
        self.capture().newest(before)
    }

    fn capture(&self) -> Capture<'_> {
        Capture {
            count: &self.edges[Line::Time.index()][Edge::Rising as usize],
            stamps: &self.captured,
        }
    }

    /// Begins to count edges anew.
    pub(crate) fn forget_edges(&self) {
        let before = self.capture().count.load(Ordering::Relaxed);
        self.time_edges_before.store(before, Ordering::Relaxed);
        for line in Line::ALL {
            for edge in [Edge::Rising, Edge::Falling] {
                if (line, edge) != (Line::Time, Edge::Rising) {
                    self.edges[line.index()][edge as usize].store(0, Ordering::Relaxed);
                }
            }
        }
    }

    pub(crate) fn has_faults(&self) -> HardwareFaults {
        HardwareFaults(self.faults.load(Ordering::Relaxed))
    }
}

/// Sets or clears a fault of a system's hardware.
pub(crate) fn set_fault(of: SystemId, fault: HardwareFault, present: bool) {
    let bit = HardwareFaults::bit(fault);
    if present {
        system(of).faults.fetch_or(bit, Ordering::Relaxed);
    } else {
        system(of).faults.fetch_and(!bit, Ordering::Relaxed);
    }
    call();
}

/// Returns the current time.
pub(crate) fn now() -> Instant {
    Instant::from_ns(hart::time() * interrupts::TICK_NS)
}

/// Notifies the carrier of new work.
pub(crate) fn call() {
    interrupts::post(CARRIER);
}

/// Interrupts core 0 of a system.
pub(crate) fn interrupt(system: SystemId) {
    interrupts::post(CoreAddress::new(system, CoreId::CONTROL).index());
}
