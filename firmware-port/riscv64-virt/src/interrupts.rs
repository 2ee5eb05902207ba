//! Doorbell, timer and clock: a message to the hart's interrupt file (IMSIC), and the MTIMER of the
//! ACLINT. Both have other registers than the CLINT of riscv32.

use core::arch::asm;
use core::ptr::{read_volatile, write_volatile};

use crate::hart::HARTS;

/// The interrupt files of machine mode, a page each.
const FILES: usize = 0x2400_0000;
const FILE_BYTES: usize = 0x1000;
/// The identity of the doorbell's message, as enabled in registers.S.
const BELL: u32 = 1;

/// The MTIMER: a register for each hart, and the clock behind them.
const MTIMECMP: usize = 0x0200_0000;
const MTIME: usize = 0x0200_7FF8;

/// Length of one tick in nanoseconds.
pub const TICK_NS: u64 = 100;
/// The doorbell's bit in `mie` and `mip`: the machine external interrupt.
pub(crate) const DOORBELL: usize = 1 << 11;
/// The timer's bit in `mie` and `mip`.
pub(crate) const TIMER: usize = 1 << 7;

/// The latest time to which the clock is set, in ticks: 28 years.
const LAST_JUMP: u64 = 1 << 53;

/// Returns the time of the MTIMER, in its ticks of 100 ns.
#[inline]
#[must_use]
pub fn time() -> u64 {
    let time: u64;
    // SAFETY: reads a counter.
    unsafe { asm!("rdtime {}", out(reg) time, options(nomem, nostack, preserves_flags)) };
    time
}

/// Raises the doorbell of a hart of this machine; of another hart it is an access fault. The hart
/// that takes it sees everything that this hart wrote before.
#[inline]
pub fn post(hart: usize) {
    let file = FILES + FILE_BYTES * (hart % HARTS);
    // SAFETY: the register that receives messages is the first word of a hart's file. The fence
    // pairs with the one in `clear`: memory first, then the device.
    unsafe {
        asm!("fence rw, ow");
        write_volatile(file as *mut u32, BELL);
    }
}

/// Clears the doorbell of this hart. `hart` must be its number: no other file can be cleared.
#[inline]
pub fn clear(hart: usize) {
    debug_assert!(hart == crate::hart::number());
    // SAFETY: a write to `mtopei` claims the pending message, if there is one. The fence pairs with
    // the one in `post`: the device first, then memory.
    unsafe {
        asm!("csrw 0x35C, zero", "fence iorw, iorw", options(nostack));
    }
}

/// Sets the time of the timer interrupt of this hart, in ticks of [`time`].
#[inline]
pub fn set_timer(hart: usize, ticks: u64) {
    // SAFETY: the register of a hart. One store of 64 bits has no intermediate value.
    unsafe { write_volatile(timer_of(hart), ticks) };
}

/// Returns the time of a hart's timer interrupt, which may be in the past.
#[must_use]
pub fn timer(hart: usize) -> u64 {
    // SAFETY: as in `set_timer`; a load of 64 bits is whole.
    unsafe { read_volatile(timer_of(hart)) }
}

fn timer_of(hart: usize) -> *mut u64 {
    (MTIMECMP + 8 * (hart % HARTS)) as *mut u64
}

/// Returns a time to which the clock can be set, `None` after [`LAST_JUMP`].
pub(crate) fn settable(ticks: u64) -> Option<u64> {
    (ticks <= LAST_JUMP).then_some(ticks)
}

/// Advances the clock of all harts to `ticks`.
pub(crate) fn jump_to(ticks: u64) {
    // SAFETY: the clock; timers within the skipped time expire at once.
    unsafe { write_volatile(MTIME as *mut u64, ticks) };
}
