//! The board of one core, for one of its incarnations.

mod parts;

pub use parts::{VirtCan, VirtFlash, VirtLines, VirtLink, VirtNetwork, VirtSupply};

use crate::hart::CARRIER;
use crate::peripherals::{self, Peripherals, system};
use crate::{doorbell, hart, interrupts, memory, trap};
use core::sync::atomic::AtomicU32;
use core::sync::atomic::Ordering::{Relaxed, Release};
use tandem_board::{
    Board, CoreAddress, CoreId, FaultSource, Generation, HardwareFault, Identity, Instant,
    OutputDiagnosis, RoleLamp, SystemId, TraceRecord, Wake,
};
use tandem_peripherals::codec::encode_trace;

/// QEMU's `virt` machine as the board of one core.
///
/// [`run`] makes it at the start of each incarnation. Only core 0 may program the flash and service
/// the watchdog; on another core these calls panic.
#[derive(Clone, Debug)]
pub struct VirtBoard {
    identity: Identity,
    can: VirtCan,
    lines: VirtLines,
    link: VirtLink,
    network: VirtNetwork,
    flash: VirtFlash,
    supply: VirtSupply,
}

impl VirtBoard {
    fn new(place: CoreAddress) -> Self {
        Self {
            identity: Identity {
                system: place.system,
                core: place.core,
                generation: Generation(system(place.system).generation.load(Relaxed)),
            },
            can: VirtCan(place),
            lines: VirtLines(place),
            link: VirtLink(place),
            network: VirtNetwork(place),
            flash: VirtFlash(place),
            supply: VirtSupply(place),
        }
    }
}

/// Converts an instant to ticks of the clock, rounded up; `None` for [`Instant::NEVER`].
fn ticks(at: Instant) -> Option<u64> {
    (at != Instant::NEVER).then(|| at.as_ns().div_ceil(interrupts::TICK_NS))
}

impl Board for VirtBoard {
    type Can = VirtCan;
    type Lines = VirtLines;
    type Link = VirtLink;
    type Network = VirtNetwork;
    type Flash = VirtFlash;
    type Supply = VirtSupply;

    fn identity(&self) -> Identity {
        self.identity
    }

    fn now(&self) -> Instant {
        Instant::from_ns(hart::time() * interrupts::TICK_NS)
    }

    fn lmu(&self) -> &[AtomicU32] {
        memory::lmu(self.identity.system)
    }

    fn ring(&self, to: CoreId) {
        interrupts::post(CoreAddress::new(self.identity.system, to).index());
    }

    fn release_core(&self, core: CoreId) {
        let of = self.identity;
        assert!(of.core == CoreId::CONTROL, "only core 0 releases cores");
        // Release pairs with the Acquire in the carrier, which releases the core.
        system(of.system)
            .released
            .fetch_or(1 << core.index(), Release);
        peripherals::call();
    }

    fn wait(&self, deadline: Instant) -> Wake {
        match doorbell::wait(ticks(deadline)) {
            true => Wake::Interrupt,
            false => Wake::Deadline,
        }
    }

    fn output_diagnosis(&self) -> OutputDiagnosis {
        system(self.identity.system).has_faults().outputs()
    }

    fn can(&self) -> &VirtCan {
        &self.can
    }

    fn lines(&self) -> &VirtLines {
        &self.lines
    }

    fn link(&self) -> &VirtLink {
        &self.link
    }

    fn network(&self) -> &VirtNetwork {
        &self.network
    }

    fn flash(&self) -> &VirtFlash {
        &self.flash
    }

    fn supply(&self) -> &VirtSupply {
        &self.supply
    }

    fn trace(&self, record: TraceRecord) {
        let registers = peripherals::core(self.identity.address());
        // Handlers interrupt the tasks of a core, but the ring may have only one writer at a time.
        hart::without_interrupts(|| {
            if !registers.trace.put(&encode_trace(self.now(), record)) {
                registers.trace_lost.fetch_add(1, Relaxed);
            }
        });
    }
}

impl FaultSource for VirtBoard {
    fn set_fault(&self, of: SystemId, fault: HardwareFault, present: bool) {
        peripherals::set_fault(of, fault, present);
    }
}

/// Runs a program on all harts: `core` for each incarnation of each core, `outside` once on the
/// carrier. The main of every hart calls this.
///
/// Core 0 starts when the carrier switches its system on, another core when core 0 releases it.
/// When `core` returns, the core sleeps until a reset. `slice` is the length of its turns in ticks
/// (see [`hart::yield_turn`]).
pub fn run(hart: usize, slice: u32, core: fn(&VirtBoard), outside: fn(&mut Peripherals) -> !) -> ! {
    if hart == CARRIER {
        outside(&mut Peripherals::new());
    }
    let Some(address) = CoreAddress::from_index(hart) else {
        hart::park()
    };
    trap::begin_held(hart);
    trap::sleep_while_held(hart);
    begin(address, slice, core)
}

/// Runs `core` on the core of this hart, after a bootloader has started this image. The main of an
/// image in a slot calls it; see [`run`] for `slice`.
pub fn run_in_slot(hart: usize, slice: u32, core: fn(&VirtBoard)) -> ! {
    match CoreAddress::from_index(hart) {
        Some(address) => begin(address, slice, core),
        None => hart::park(),
    }
}

fn begin(address: CoreAddress, slice: u32, core: fn(&VirtBoard)) -> ! {
    hart::enable(hart::DOORBELL);
    doorbell::set_slice(slice);
    hart::interrupts_on();
    core(&VirtBoard::new(address));
    loop {
        doorbell::wait(None);
    }
}

impl VirtBoard {
    /// Returns the role that this system shows.
    #[must_use]
    pub fn lamp(&self) -> RoleLamp {
        let lamp = &system(self.identity.system).lamp;
        RoleLamp::from_code(lamp.load(Relaxed)).unwrap_or(RoleLamp::Starting)
    }
}
