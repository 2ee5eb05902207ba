//! One processor: its number, its interrupts, and how it sleeps.

use core::arch::asm;
use core::ptr::{read_volatile, write_volatile};

/// Number of processors of the machine.
pub const CPUS: usize = 2;

/// The register in which each processor reads its own number.
const CPUID: usize = 0x5001_F000;
const NVIC_ENABLE: usize = 0xE000_E100;

/// Returns the number of this processor, 0 or 1.
#[must_use]
pub fn number() -> usize {
    // SAFETY: a register that can be read at any time, without a side effect.
    unsafe { read_volatile(CPUID as *const u32) as usize % CPUS }
}

/// Enables interrupt `number` (0 ..= 31) on this processor.
pub fn enable_interrupt(number: u32) {
    // SAFETY: this processor's own interrupt controller; writing ones enables, zeros do nothing.
    unsafe { write_volatile(NVIC_ENABLE as *mut u32, 1 << number) };
}

/// Runs `f` without interrupts on this processor.
pub fn without_interrupts<R>(f: impl FnOnce() -> R) -> R {
    let masked: u32;
    // SAFETY: reads and sets this processor's interrupt mask, and restores it below. Memory
    // accesses stay between the two, because `asm!` without `nomem` is a compiler barrier.
    unsafe { asm!("mrs {0}, PRIMASK", "cpsid i", out(reg) masked) };
    let result = f();
    if masked & 1 == 0 {
        // SAFETY: interrupts were enabled before.
        unsafe { asm!("cpsie i") };
    }
    result
}

/// Sleeps until an interrupt is pending. If interrupts are disabled, the pending interrupt ends the
/// sleep but is not taken yet, so none is missed between a poll and the sleep.
pub fn sleep() {
    // SAFETY: only waits.
    unsafe { asm!("dsb", "wfi") };
}
