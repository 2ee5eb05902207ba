//! The boundary between portable code and a machine: the interface of a board to a core.
//!
//! A board offers what a TC297 with its carrier offers: a monotonic clock, the LMU, doorbells to
//! the other cores of the system, lines and a link to the other system, CAN, data flash, the supply
//! with its watchdogs. Portable code is generic over one `B: Board` and uses nothing else of the
//! machine.
//!
//! A *task* runs in a core's main flow. A *handler* interrupts it, as a task of higher priority
//! does. Each method says from which context it may be called:
//!
//! - **Any context**: from tasks and handlers, also while another call on this core is not
//!   finished. It never blocks.
//! - **One at a time**: from tasks and handlers, but no two calls of the same part ([`Can`],
//!   [`Link`], [`DataFlash`], [`Supply`]) may overlap on one core. The caller ensures that, for
//!   instance by a lock between its tasks. A call that interrupts another one may deadlock or lose
//!   data. The call itself never blocks.
//! - **Task**: from one task of the core at a time, never from a handler. It may block.
//!
//! `tandem-board-conformance` tests the contracts written here.
#![no_std]
#![forbid(unsafe_code)]

mod can;
mod faults;
mod flash;
mod identity;
mod lines;
mod supply;
mod time;
mod trace;
mod vehicle;

pub use can::{Can, CanErrors, CanFrame, CanId, CanState, InvalidFrame, Received, TransmitFull};
pub use faults::{FaultSource, HardwareFault, HardwareFaults, OutputDiagnosis};
pub use flash::{DataFlash, FlashError, FlashStatus};
pub use identity::{CoreAddress, CoreId, Generation, Identity, SystemId};
pub use lines::{Edge, Line, Lines, Link, LinkFull};
pub use supply::{ResetCause, ResetRequest, RoleLamp, Supply, watchdog_answer};
pub use time::{Duration, Instant};
pub use trace::{SupplyEvent, TraceRecord, Traced};
pub use vehicle::{Carried, Pass, VehicleBus, VehiclePort};

/// A word of the LMU: the machine's atomic. In a build with `--cfg stepped` it is one at which a
/// test can stop a core, before each access.
#[cfg(not(stepped))]
pub use core::sync::atomic::AtomicU32 as LmuWord;
#[cfg(stepped)]
pub use tandem_shm::sync::AtomicU32 as LmuWord;

/// Why a [`Board::wait`] ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wake {
    /// A doorbell, a waking edge or a received CAN frame: something may be pending. May be
    /// spurious.
    Interrupt,
    /// The deadline has passed.
    Deadline,
}

/// One core's view of its machine.
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
    /// The data flash of the system. Only core 0 programs it.
    type Flash: DataFlash;
    /// The supply (TLF35584): watchdogs, reset, reset cause.
    type Supply: Supply;

    /// Which core of which system this is, and which of its incarnations. Any context.
    fn identity(&self) -> Identity;

    /// The monotonic clock of this system. Any context. Never goes back; the two systems' clocks
    /// are not synchronised and may have different origins.
    fn now(&self) -> Instant;

    /// The LMU: the memory that all cores of this system reach, as words from a boundary of 64
    /// bytes on. Any context. On the TC297 it has 32 KiB at 0xB000_0000. It is zero at power-on,
    /// and keeps its content over the reset of single cores. Any core may write any word at any
    /// time.
    fn lmu(&self) -> &[LmuWord];

    /// Rings the doorbell of another core of this system (the inter-core interrupt), or this core's
    /// own. Any context.
    ///
    /// Writes to the LMU before the call are visible to the receiver after its `wait` returns.
    /// Rings that arrive before the receiver waits are merged into one. Ringing a dead core has no
    /// effect.
    fn ring(&self, to: CoreId);

    /// Releases another core of this system from reset. One at a time; core 0 only.
    ///
    /// At each start of the system only core 0 runs; the others do not run until core 0 releases
    /// them. The core begins the incarnation of its system and sees everything that core 0 wrote to
    /// the LMU before the release. No effect on a core that was released in this incarnation.
    fn release_core(&self, core: CoreId);

    /// Sleeps until an interrupt is pending or `deadline` has passed, and consumes the pending
    /// interrupt. Task; blocks.
    ///
    /// Race-free: an interrupt raised before the call ends it at once. Interrupts are: this core's
    /// doorbell, an edge on [`Line::Start`], a change of [`Lines::peer_powered`] (both on core 0
    /// only), and a CAN frame if the core asked for it ([`Can::wake_on_receive`]). The caller polls
    /// all sources; `Wake::Interrupt` may be spurious.
    fn wait(&self, deadline: Instant) -> Wake;

    /// The CAN controller of this core. Any context.
    fn can(&self) -> &Self::Can;

    /// The lines to and from the other system. Any context.
    fn lines(&self) -> &Self::Lines;

    /// The data link to and from the other system. Any context.
    fn link(&self) -> &Self::Link;

    /// The data flash of this system. Any context.
    fn flash(&self) -> &Self::Flash;

    /// The supply of this system. Any context.
    fn supply(&self) -> &Self::Supply;

    /// The diagnosis of this system's output driver. Any context. A fault stays until it is
    /// repaired. A board whose driver has no diagnosis reports no fault.
    fn output_diagnosis(&self) -> OutputDiagnosis {
        OutputDiagnosis::Good
    }

    /// Writes one record to the trace. Any context. A full trace loses the record and counts it.
    fn trace(&self, record: TraceRecord);
}
