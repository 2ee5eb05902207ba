//! The boundary between portable code and a machine: the interface between a board and a core.
//!
//! A board offers what a TC297 with its carrier offers: a monotonic clock, the LMU, doorbells to
//! the other cores of the system, lines and a link to the other system, CAN, an Ethernet port, data
//! flash, and the supply with its watchdogs. Portable code is generic over one `B: Board` and uses
//! nothing else of the machine.
//!
//! A *task* runs in a core's main flow. A *handler* interrupts it, as a task of higher priority
//! does. Each method says from which context it may be called:
//!
//! - **Any context**: from tasks and handlers, also while another call on this core is not
//!   finished. It never blocks.
//! - **One at a time**: from tasks and handlers, but no two calls of the same part ([`Can`],
//!   [`Link`], [`DataFlash`], [`Supply`], a channel of [`Network`]) may overlap on one core. The
//!   caller ensures that, for instance by a lock between its tasks. A call that interrupts another
//!   one may deadlock or lose data. The call itself never blocks.
//! - **Task**: from one task of the core at a time, never from a handler. It may block.
//!
//! `tandem-board-conformance` tests the contracts written here.
//!
//! # Example
//!
//! ```
#![doc = include_str!("../examples/can_controller.rs")]
//! ```
#![no_std]
#![forbid(unsafe_code)]

mod can;
mod faults;
mod flash;
#[cfg(feature = "embedded-can")]
mod hal_can;
mod identity;
mod lines;
mod monotonic;
mod network;
#[cfg(feature = "embedded-storage")]
mod nor_flash;
mod supply;
pub mod tester_desk;
mod time;
mod trace;
mod vehicle;

pub use can::{Can, CanErrors, CanFrame, CanId, CanState, InvalidFrame, Received, TransmitFull};
pub use faults::{FaultSource, HardwareFault, HardwareFaults, OutputDiagnosis};
pub use flash::{DataFlash, FlashError, FlashStatus};
pub use identity::{CoreAddress, CoreId, Generation, Identity, SystemId};
pub use lines::{Edge, Line, Lines, Link, LinkFull, TimeEdge};
pub use monotonic::{MonotonicCounter, NoCounter};
pub use network::{Channel, Datagram, Network, NetworkAddress, NetworkFull, NoNetwork, Recipient};
#[cfg(feature = "embedded-storage")]
pub use nor_flash::NorDataFlash;
pub use supply::{ResetCause, ResetRequest, RoleLamp, Supply, watchdog_answer};
pub use tester_desk::{DeskAction, TesterDesk};
pub use time::{Duration, Instant};
pub use trace::{SupplyEvent, TraceRecord, Traced};
pub use vehicle::{Carried, Forgery, Handled, Pass, VehicleBus, VehiclePort};

/// A word of the LMU: the standard 32-bit atomic. In a build with `--cfg stepped`, a test can stop
/// a core before each access to the word.
#[cfg(not(stepped))]
pub use core::sync::atomic::AtomicU32 as LmuWord;
#[cfg(stepped)]
pub use tandem_shm::sync::AtomicU32 as LmuWord;

/// Why a [`Board::wait`] ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Wake {
    /// A doorbell, a waking edge or a received CAN frame: something may be pending. May be
    /// spurious.
    Interrupt,
    /// The deadline has passed.
    Deadline,
}

/// One core's interface to its machine.
///
/// All methods take `&self`: a board is shared between the tasks and handlers of one core, never
/// between cores. No method panics because of another core or the other system.
pub trait Board {
    /// The CAN controller of this core.
    type Can: Can;
    /// The lines to the other system.
    type Lines: Lines;
    /// The data link to the other system (HSSL / SPI).
    type Link: Link;
    /// The Ethernet port of the system, connected to core 0.
    type Network: Network;
    /// The data flash of the system. Only core 0 programs it.
    type Flash: DataFlash;
    /// The supply (TLF35584): watchdogs, reset, reset cause.
    type Supply: Supply;

    /// Returns which core of which system this is, and in which incarnation. Any context.
    fn identity(&self) -> Identity;

    /// Reads the monotonic clock of this system. Any context. It never goes back; the clocks of the
    /// two systems are not synchronised and may have different origins.
    fn now(&self) -> Instant;

    /// Returns the LMU, the memory that all cores of this system can access, as words; it starts at
    /// a multiple of 64 bytes. Any context. On the TC297 it has 32 KiB at 0xB000_0000. It is zero
    /// at power-on, and keeps its content when single cores are reset. Any core may write any word
    /// at any time.
    fn lmu(&self) -> &[LmuWord];

    /// Rings the doorbell (the inter-core interrupt) of a core of this system, which may be this
    /// core. Any context.
    ///
    /// Writes to the LMU before the call are visible to the receiver after its `wait` returns.
    /// Rings that arrive before the receiver waits are merged into one. Ringing a dead core has no
    /// effect.
    fn ring(&self, to: CoreId);

    /// Releases another core of this system from reset. One at a time; only core 0 may call it.
    ///
    /// At each start of the system only core 0 runs; the others start when core 0 releases them.
    /// The core starts in the system's current incarnation and sees everything that core 0 wrote to
    /// the LMU before the release. A core already released in this incarnation is not affected.
    fn release_core(&self, core: CoreId);

    /// Sleeps until an interrupt is pending or `deadline` has passed, and clears the pending
    /// interrupt. Task; blocks.
    ///
    /// Race-free: an interrupt raised before the call ends it at once. The interrupts are this
    /// core's doorbell, an edge on [`Line::Start`], a change of [`Lines::peer_powered`] (both on
    /// core 0 only), and a CAN frame if the core enabled that ([`Can::wake_on_receive`]). The
    /// caller polls all sources; `Wake::Interrupt` may be spurious.
    fn wait(&self, deadline: Instant) -> Wake;

    /// Returns the CAN controller of this core. Any context.
    fn can(&self) -> &Self::Can;

    /// Returns the lines to and from the other system. Any context.
    fn lines(&self) -> &Self::Lines;

    /// Returns the data link to and from the other system. Any context.
    fn link(&self) -> &Self::Link;

    /// Returns the Ethernet port of this system. Any context.
    fn network(&self) -> &Self::Network;

    /// Returns the data flash of this system. Any context.
    fn flash(&self) -> &Self::Flash;

    /// Returns the supply of this system. Any context.
    fn supply(&self) -> &Self::Supply;

    /// Reads the diagnosis of this system's output driver. Any context. A fault stays until it is
    /// repaired. A board whose driver has no diagnosis reports no fault.
    fn output_diagnosis(&self) -> OutputDiagnosis {
        OutputDiagnosis::Good
    }

    /// Writes one record to the trace. Any context. A full trace loses and counts the record.
    fn trace(&self, record: TraceRecord);
}
