//! The message handling units: the interrupts between the two processors.
//!
//! Each unit has a register of interrupt bits for each processor; any bit that is set holds the
//! processor's interrupt line, and the receiver clears it.

use crate::cpu::{self, CPUS};
use core::ptr::{read_volatile, write_volatile};
use core::sync::atomic::{AtomicBool, Ordering};

/// A unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unit {
    /// Unit 0: the doorbell.
    Doorbell = 0,
    /// Unit 1: wires from outside the system, lines and the CAN bus.
    Wires = 1,
}

const BASE: usize = 0x5000_3000;
const UNIT_BYTES: usize = 0x1000;
/// From the registers of processor 0 to those of processor 1.
const CPU_BYTES: usize = 0x10;
const STATUS: usize = 0x0;
const SET: usize = 0x4;
const CLEAR: usize = 0x8;
/// The line of unit 0 at each processor; that of unit 1 follows.
const FIRST_INTERRUPT: u32 = 6;

/// An interrupt of this processor that is not consumed yet.
static PENDING: [AtomicBool; CPUS] = [const { AtomicBool::new(false) }; CPUS];

fn register(unit: Unit, cpu: usize, offset: usize) -> *mut u32 {
    (BASE + unit as usize * UNIT_BYTES + cpu * CPU_BYTES + offset) as *mut u32
}

/// Enables the interrupts of both units on this processor.
pub fn enable() {
    cpu::enable_interrupt(FIRST_INTERRUPT);
    cpu::enable_interrupt(FIRST_INTERRUPT + 1);
}

/// Interrupts processor `to`, which may be this one. Everything written before is visible to it
/// when it has taken the interrupt. Never blocks.
pub fn interrupt(unit: Unit, to: usize) {
    // SeqCst is a `dmb` before the store to the device: pairs with the fence in `take_pending`.
    core::sync::atomic::fence(Ordering::SeqCst);
    // SAFETY: a set register: other bits and other processors are not touched.
    unsafe { write_volatile(register(unit, to % CPUS, SET), 1) };
}

/// Whether an interrupt arrived since the last call.
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
