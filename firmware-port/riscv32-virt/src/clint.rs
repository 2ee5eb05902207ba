//! The CLINT: for each hart a software interrupt, which is its doorbell, and a timer.

use crate::hart::HARTS;
use core::arch::asm;
use core::ptr::{read_volatile, write_volatile};

const MSIP: usize = 0x0200_0000;
const MTIMECMP: usize = 0x0200_4000;
const MTIME: usize = 0x0200_BFF8;

/// Length of one tick in nanoseconds.
pub const TICK_NS: u64 = 100;
/// The doorbell's bit in `mie` and `mip`: the machine software interrupt.
pub(crate) const DOORBELL: usize = 1 << 3;
/// The timer's bit in `mie` and `mip`.
pub(crate) const TIMER: usize = 1 << 7;

/// Returns the time of the CLINT, in its ticks of 100 ns.
#[inline]
#[must_use]
pub fn time() -> u64 {
    loop {
        let (high, low, again): (u32, u32, u32);
        // SAFETY: reads counters.
        unsafe {
            asm!("rdtimeh {}", "rdtime {}", "rdtimeh {}",
                out(reg) high, out(reg) low, out(reg) again,
                options(nomem, nostack, preserves_flags));
        }
        if high == again {
            return u64::from(high) << 32 | u64::from(low);
        }
    }
}

/// Raises the software interrupt of a hart. The hart that takes it sees everything that this hart
/// wrote before.
#[inline]
pub fn post(hart: usize) {
    // SAFETY: one word for each hart; the machine ignores words of harts that it does not have.
    // The fence pairs with the one in `clear`: memory first, then the device. (A fence of the
    // memory model does not order devices.)
    unsafe {
        asm!("fence rw, ow");
        write_volatile((MSIP + 4 * (hart % HARTS)) as *mut u32, 1);
    }
}

/// Clears the software interrupt of this hart.
#[inline]
pub fn clear(hart: usize) {
    // SAFETY: as in `post`. The fence pairs with the one in `post`: the device first, then memory.
    unsafe {
        write_volatile((MSIP + 4 * (hart % HARTS)) as *mut u32, 0);
        asm!("fence iorw, iorw");
    }
}

/// Sets the time of the timer interrupt of this hart, in ticks of [`time`].
#[inline]
pub fn set_timer(hart: usize, ticks: u64) {
    let register = (MTIMECMP + 8 * (hart % HARTS)) as *mut u32;
    // SAFETY: the two words of this hart's register. The high word is set to its maximum first, so
    // that no intermediate value is in the past.
    unsafe {
        write_volatile(register.add(1), u32::MAX);
        write_volatile(register, ticks as u32);
        write_volatile(register.add(1), (ticks >> 32) as u32);
    }
}

/// Returns the time of a hart's timer interrupt, which may be in the past.
#[must_use]
pub fn timer(hart: usize) -> u64 {
    let register = (MTIMECMP + 8 * (hart % HARTS)) as *const u32;
    // SAFETY: the two words of the register. The hart that changes them does not run now, or the
    // caller accepts any value.
    unsafe { u64::from(read_volatile(register.add(1))) << 32 | u64::from(read_volatile(register)) }
}

/// Returns a time to which the clock can be set, `None` after 429 s: a write to the lower word
/// clears the upper word in the emulator.
pub(crate) fn settable(ticks: u64) -> Option<u32> {
    u32::try_from(ticks).ok()
}

/// Advances the clock of all harts to `ticks`.
pub(crate) fn jump_to(ticks: u32) {
    // SAFETY: the lower word of the clock; timers within the skipped time expire at once.
    unsafe { write_volatile(MTIME as *mut u32, ticks) };
}
