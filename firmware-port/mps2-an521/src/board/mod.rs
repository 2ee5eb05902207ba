//! The board: one of the controller's cores on one of the two processors.

mod wires;

pub use wires::{An521Can, An521Lines, An521Link};

use crate::cpu::{self, CPUS};
use crate::lmu::lmu;
use crate::mhu::{self, Unit};
use crate::timers;
use core::cell::Cell;
use core::sync::atomic::AtomicU32;
use tandem_board::{
    Board, CoreAddress, CoreId, DataFlash, FaultSource, FlashError, FlashStatus, Generation,
    HardwareFault, Identity, Instant, NoNetwork, ResetCause, ResetRequest, RoleLamp, Supply,
    SystemId, TraceRecord, Wake,
};

/// The core that each processor runs; `None` if the processor runs no core.
pub type Cast = [Option<CoreAddress>; CPUS];

/// Returns the processor that runs this core.
fn player(cast: &Cast, system: SystemId, core: CoreId) -> Option<usize> {
    cast.iter()
        .position(|part| *part == Some(CoreAddress { system, core }))
}

/// A core on this machine.
pub struct An521Board {
    identity: Identity,
    cast: Cast,
    can: An521Can,
    lines: An521Lines,
    link: An521Link,
    absent: Absent,
    /// The last records of the trace, and the number of all records.
    trace: [Cell<TraceRecord>; TRACED],
    traced: Cell<usize>,
}

const TRACED: usize = 16;

impl An521Board {
    /// Returns the board of this processor's core; `None` if it has none. Call it once, in task
    /// context.
    #[must_use]
    pub fn new(cast: Cast) -> Option<Self> {
        let own = cpu::number();
        let of = cast[own]?;
        let CoreAddress { system, core } = of;
        let second = cast[1].filter(|_| own == 0);
        if second.is_some_and(|second| second.core == CoreId::CONTROL) {
            // Core 0 of a powered system is never held in reset.
            crate::start::release_second();
        }
        Some(Self {
            identity: Identity {
                system,
                core,
                // Always 1: the machine resets only as a whole.
                generation: Generation(1),
            },
            cast,
            can: An521Can::new(of, own, &cast),
            lines: An521Lines::new(system, &cast),
            link: An521Link::new(system),
            absent: Absent,
            trace: [const { Cell::new([0; 4]) }; TRACED],
            traced: Cell::new(0),
        })
    }

    /// Returns the number of records that were written to the trace.
    #[must_use]
    pub fn traced(&self) -> usize {
        self.traced.get()
    }
}

/// The hardware of this machine cannot have faults: test cases that need a fault do not run on it.
impl FaultSource for An521Board {
    fn set_fault(&self, _: SystemId, _: HardwareFault, _: bool) {}
}

impl Board for An521Board {
    type Can = An521Can;
    type Lines = An521Lines;
    type Link = An521Link;
    type Network = NoNetwork;
    type Flash = Absent;
    type Supply = Absent;

    fn identity(&self) -> Identity {
        self.identity
    }

    fn now(&self) -> Instant {
        timers::now()
    }

    fn lmu(&self) -> &[AtomicU32] {
        lmu(self.identity.system)
    }

    fn ring(&self, to: CoreId) {
        if let Some(cpu) = player(&self.cast, self.identity.system, to) {
            mhu::interrupt(Unit::Doorbell, cpu);
        }
    }

    fn release_core(&self, core: CoreId) {
        if player(&self.cast, self.identity.system, core) == Some(1) {
            crate::start::release_second();
        }
    }

    fn wait(&self, deadline: Instant) -> Wake {
        loop {
            let ended = cpu::without_interrupts(|| {
                if mhu::take_pending() {
                    return Some(Wake::Interrupt);
                }
                if timers::now() >= deadline {
                    return Some(Wake::Deadline);
                }
                timers::set_alarm(deadline);
                cpu::sleep();
                // The interrupt that ended the sleep runs as soon as interrupts are enabled, before
                // the next poll.
                None
            });
            if let Some(wake) = ended {
                return wake;
            }
        }
    }

    fn can(&self) -> &An521Can {
        &self.can
    }

    fn lines(&self) -> &An521Lines {
        &self.lines
    }

    fn link(&self) -> &An521Link {
        &self.link
    }

    fn network(&self) -> &NoNetwork {
        &NoNetwork
    }

    fn flash(&self) -> &Absent {
        &self.absent
    }

    fn supply(&self) -> &Absent {
        &self.absent
    }

    fn trace(&self, record: TraceRecord) {
        // Without this, a handler could write to the slot that a task is writing.
        cpu::without_interrupts(|| {
            let count = self.traced.get();
            self.trace[count % TRACED].set(record);
            self.traced.set(count.wrapping_add(1));
        });
    }
}

/// The parts that this machine lacks: data flash, and a supply with a window watchdog. Programs
/// that need them do not run on it.
#[derive(Debug)]
pub struct Absent;

impl DataFlash for Absent {
    fn read(&self, _: u32, _: &mut [u8]) -> Result<(), FlashError> {
        Err(FlashError::Failed)
    }

    fn start_erase(&self, _: u32) -> Result<(), FlashError> {
        Err(FlashError::Failed)
    }

    fn start_program(&self, _: u32, _: &[u8]) -> Result<(), FlashError> {
        Err(FlashError::Failed)
    }

    fn status(&self) -> FlashStatus {
        FlashStatus::Failed
    }
}

/// The two lamps of the board: bit 0 is lit while the system drives, bit 1 after its start.
const LAMPS: *mut u32 = 0x5030_2000 as *mut u32;

impl Supply for Absent {
    const WINDOW_OPENS_US: u32 = 0;
    const WINDOW_CLOSES_US: u32 = u32::MAX;
    const FIRST_SERVICE_US: u32 = u32::MAX;

    /// Returns the only reset cause of this machine.
    fn reset_cause(&self) -> ResetCause {
        ResetCause::PowerOn
    }

    fn starts(&self) -> u8 {
        1
    }

    fn confirm_start(&self) {}

    fn watchdog_question(&self) -> u8 {
        0
    }

    fn service_watchdog(&self, _: u8) {}

    /// Does nothing, because there is no reset generator: the caller stops the core.
    fn request_reset(&self, _: ResetRequest) {}

    fn show_role(&self, lamp: RoleLamp) {
        let lit = match lamp {
            RoleLamp::Starting => 0b00,
            RoleLamp::Standby | RoleLamp::Suspended => 0b10,
            RoleLamp::Master | RoleLamp::DegradedMaster => 0b11,
        };
        // SAFETY: the register of the lamps; a race with the other processor affects only them.
        unsafe { core::ptr::write_volatile(LAMPS, lit) };
    }
}
