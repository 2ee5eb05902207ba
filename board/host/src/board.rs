//! The board of one core. The core is a process.

use core::sync::atomic::Ordering::Relaxed;
use core::sync::atomic::{AtomicBool, AtomicU32};
use std::sync::Arc;

use tandem_board::{
    Board, CoreId, FaultSource, HardwareFault, Identity, Instant, OutputDiagnosis, SystemId,
    TraceRecord, Wake,
};
use tandem_shm::FitError;

use crate::args::CoreArgs;
use crate::backplane::{Backplane, BackplaneError};
use crate::can::HostCan;
use crate::clock;
use crate::doorbell::{Doorbell, DoorbellError, Owner, Ringers};
use crate::flash_file::{FlashFileError, HostFlash};
use crate::lines::{HostLines, HostLink};
use crate::memory::{self, MemoryError};
use crate::segment::SegmentError;
use crate::spawn;
use crate::supply;
use crate::supply_client::HostSupply;
use crate::trace_ring::TraceRing;
use crate::udp_port::HostNetwork;

/// Why a core cannot start.
#[derive(Debug, thiserror::Error)]
pub enum AttachError {
    /// The backplane cannot be mapped.
    #[error(transparent)]
    Backplane(#[from] BackplaneError),
    /// The shared memory of the run cannot be created.
    #[error(transparent)]
    Memory(#[from] MemoryError),
    /// The LMU cannot be mapped.
    #[error("LMU: {0}")]
    Lmu(#[from] SegmentError),
    /// The doorbell cannot be made.
    #[error(transparent)]
    Doorbell(#[from] DoorbellError),
    /// The supply that started this core has died, or the core could not be bound to it.
    #[error("the supply of system {0} has died")]
    NoPower(SystemId),
    /// The data flash cannot be used.
    #[error(transparent)]
    Flash(#[from] FlashFileError),
    /// The backplane has a different layout from that of this build.
    #[error("the rings of the backplane do not fit: {0:?}")]
    Fit(FitError),
}

impl From<FitError> for AttachError {
    fn from(error: FitError) -> Self {
        Self::Fit(error)
    }
}

/// The machine as one core sees it. The core is this process.
#[derive(Debug)]
pub struct HostBoard {
    of: Identity,
    backplane: Backplane,
    lmu: &'static [AtomicU32],
    doorbell: Doorbell,
    /// Whether the first wait was done; it returns at once, because earlier rings may be lost.
    looked_around: AtomicBool,
    ringers: Arc<Ringers>,
    can: HostCan,
    lines: HostLines,
    link: HostLink,
    network: HostNetwork,
    flash: HostFlash,
    supply: HostSupply,
    trace_ring: TraceRing,
}

impl HostBoard {
    /// Attaches this process as the core and the incarnation in `args`.
    ///
    /// From then on the core's doorbell can be rung. A process attaches once, on its main thread.
    /// The memory stays mapped until the process ends, which is at the latest when its supply ends.
    ///
    /// # Errors
    /// [`AttachError`] if the run has ended, or a part of it cannot be mapped or opened.
    pub fn attach(args: &CoreArgs) -> Result<Self, AttachError> {
        let of = args.identity;
        let backplane = Backplane::open(&args.common.run)?;
        bind_to_supply(backplane, of.system)?;
        let lmu = memory::open_lmu(&args.common.run, of.system)?;
        let ringers = Arc::new(Ringers::new(&args.common.run));
        let trace_ring = backplane.trace_ring(of.address().index());
        trace_ring.begin_incarnation();
        let board = Self {
            of,
            backplane,
            lmu,
            doorbell: Doorbell::attach(&args.common.run, Owner::Core(of.address()))?,
            looked_around: AtomicBool::new(false),
            ringers: Arc::clone(&ringers),
            can: HostCan::attach(backplane, of, Arc::clone(&ringers))?,
            lines: HostLines::new(backplane, of, ringers),
            link: HostLink::attach(backplane, of)?,
            network: HostNetwork::open(backplane, of, args.common.network),
            flash: HostFlash::open(&args.flash)?,
            supply: HostSupply::attach(backplane, of)?,
            trace_ring,
        };
        Ok(board)
    }

    /// Returns the run's backplane, for code outside the board.
    #[must_use]
    pub const fn backplane(&self) -> Backplane {
        self.backplane
    }
}

impl Board for HostBoard {
    type Can = HostCan;
    type Lines = HostLines;
    type Link = HostLink;
    type Network = HostNetwork;
    type Flash = HostFlash;
    type Supply = HostSupply;

    fn identity(&self) -> Identity {
        self.of
    }

    fn now(&self) -> Instant {
        clock::now()
    }

    fn lmu(&self) -> &[AtomicU32] {
        self.lmu
    }

    fn ring(&self, to: CoreId) {
        self.ringers.ring(self.of.system, to);
    }

    fn release_core(&self, core: CoreId) {
        self.backplane.release_core(self.of.system, core);
        supply::poke(self.backplane, self.of.system);
    }

    fn output_diagnosis(&self) -> OutputDiagnosis {
        self.backplane.faults(self.of.system).outputs()
    }

    fn wait(&self, deadline: Instant) -> Wake {
        if !self.looked_around.swap(true, Relaxed) {
            return Wake::Interrupt;
        }
        if self.doorbell.wait(deadline) {
            Wake::Interrupt
        } else {
            Wake::Deadline
        }
    }

    fn can(&self) -> &HostCan {
        &self.can
    }

    fn lines(&self) -> &HostLines {
        &self.lines
    }

    fn link(&self) -> &HostLink {
        &self.link
    }

    fn network(&self) -> &HostNetwork {
        &self.network
    }

    fn flash(&self) -> &HostFlash {
        &self.flash
    }

    fn supply(&self) -> &HostSupply {
        &self.supply
    }

    fn trace(&self, record: TraceRecord) {
        if self.trace_ring.write(clock::now(), record).is_err() {
            self.backplane
                .count_lost_trace(self.of.system, self.of.core);
        }
    }
}

impl FaultSource for HostBoard {
    fn set_fault(&self, of: SystemId, fault: HardwareFault, present: bool) {
        self.backplane.set_fault(of, fault, present);
        supply::poke(self.backplane, of);
    }
}

/// Makes this core die with its supply. Fails if the supply is already dead.
fn bind_to_supply(backplane: Backplane, system: SystemId) -> Result<(), AttachError> {
    match backplane.supply_pid(system) {
        0 => Ok(()),
        supply => match spawn::bind_to_parent(supply) {
            Ok(true) => Ok(()),
            Ok(false) | Err(_) => Err(AttachError::NoPower(system)),
        },
    }
}
