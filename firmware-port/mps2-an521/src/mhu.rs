//! The message handling units: the interrupts between the two processors.
//!
//! Each unit has a register of interrupt bits for each processor. While a bit is set, the
//! processor's interrupt line is active; the receiver clears the bit.

use crate::cpu::{self, CPUS};
use core::ptr::{read_volatile, write_volatile};
use core::sync::atomic::{AtomicBool, Ordering};

/// A unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unit {
    /// Unit 0: the doorbell.
    Doorbell = 0,
    /// Unit 1: wires from outside the system, which are the lines and the CAN bus.
    Wires = 1,
}

const BASE: usize = 0x5000_3000;
const UNIT_BYTES: usize = 0x1000;
/// Offset from the registers of processor 0 to those of processor 1.
const CPU_BYTES: usize = 0x10;
const STATUS: usize = 0x0;
const SET: usize = 0x4;
const CLEAR: usize = 0x8;
/// Number of the interrupt of unit 0 on each processor; that of unit 1 is the next.
const FIRST_INTERRUPT: u32 = 6;

/// For each processor, whether an interrupt has arrived since the last `take_pending`.
static PENDING: [AtomicBool; CPUS] = [const { AtomicBool::new(false) }; CPUS];

fn register(unit: Unit, cpu: usize, offset: usize) -> *mut u32 {
    (BASE + unit as usize * UNIT_BYTES + cpu * CPU_BYTES + offset) as *mut u32
}

/// Enables the interrupts of both units on this processor.
pub fn enable() {
    cpu::enable_interrupt(FIRST_INTERRUPT);
    cpu::enable_interrupt(FIRST_INTERRUPT + 1);
}

/// Interrupts processor `to`, which may be this one. After it has taken the interrupt, it sees
/// everything that this processor wrote before. Never blocks.
pub fn interrupt(unit: Unit, to: usize) {
    // SeqCst is a `dmb` before the store to the device: pairs with the fence in `take_pending`.
    core::sync::atomic::fence(Ordering::SeqCst);
    // SAFETY: a set register: the write does not change other bits or other processors.
    unsafe { write_volatile(register(unit, to % CPUS, SET), 1) };
}

/// Returns whether an interrupt has arrived since the last call.
pub fn take_pending() -> bool {
    let pending = PENDING[cpu::number()].swap(false, Ordering::Relaxed);
    core::sync::atomic::fence(Ordering::SeqCst);
    pending
}

/// Handler of both units: clears the set bits and remembers them.
pub(crate) extern "C" fn on_interrupt() {
    let cpu = cpu::number();
    for unit in [Unit::Doorbell, Unit::Wires] {
        // SAFETY: this processor's own status and clear registers.
        unsafe {
            let set = read_volatile(register(unit, cpu, STATUS));
            if set != 0 {
                write_volatile(register(unit, cpu, CLEAR), set);
            }
        }
    }
    PENDING[cpu].store(true, Ordering::Relaxed);
}
