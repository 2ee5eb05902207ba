//! One hart: its number, its interrupts, its counters, and how it yields the emulator's turn.

use core::arch::asm;

pub use crate::interrupts::time;
pub(crate) use crate::interrupts::{DOORBELL, TIMER};

/// Length of tables by hart: three for each system, the carrier, and one more, so that a mask
/// keeps a number in range.
pub const HARTS: usize = 8;

/// The hart that emulates the hardware outside the chips.
pub const CARRIER: usize = 6;

const MSTATUS_MIE: usize = 1 << 3;

/// Returns the number of this hart.
#[inline]
#[must_use]
pub fn number() -> usize {
    let hart: usize;
    // SAFETY: reads a constant register; no memory, no side effect.
    unsafe { asm!("csrr {}, mhartid", out(reg) hart, options(nomem, nostack, preserves_flags)) };
    hart
}

/// Returns the cycle counter. Under `-icount shift=0` one cycle is one instruction of any hart.
#[inline]
#[must_use]
pub fn cycles() -> u32 {
    let cycles: usize;
    // Without `nomem`, so that measured code does not move across the read.
    // SAFETY: reads a counter.
    unsafe { asm!("csrr {}, mcycle", out(reg) cycles, options(nostack, preserves_flags)) };
    cycles as u32
}

/// Switches the interrupts of this hart on.
#[inline]
pub fn interrupts_on() {
    // SAFETY: the handlers of this crate access only atomics, so they may run anywhere.
    // Without `nomem`, so that the compiler does not move an earlier write past this.
    unsafe { asm!("csrsi mstatus, {}", const MSTATUS_MIE, options(nostack)) };
}

/// Switches the interrupts of this hart off. Returns whether they were on.
#[inline]
pub fn interrupts_off() -> bool {
    let before: usize;
    // SAFETY: no handler runs after this; see `interrupts_on` for memory accesses.
    unsafe {
        asm!("csrrci {}, mstatus, {}", out(reg) before, const MSTATUS_MIE, options(nostack));
    }
    before & MSTATUS_MIE != 0
}

/// Runs `work` with interrupts off.
#[inline]
pub fn without_interrupts<R>(work: impl FnOnce() -> R) -> R {
    let were_on = interrupts_off();
    let result = work();
    if were_on {
        interrupts_on();
    }
    result
}

/// Enables these interrupts on this hart.
#[inline]
pub(crate) fn enable(which: usize) {
    // SAFETY: as in `interrupts_on`.
    unsafe { asm!("csrs mie, {}", in(reg) which, options(nostack)) };
}

/// Disables these interrupts on this hart.
#[inline]
pub(crate) fn disable(which: usize) {
    // SAFETY: as in `interrupts_off`.
    unsafe { asm!("csrc mie, {}", in(reg) which, options(nostack)) };
}

/// Returns the pending interrupts, enabled or not.
#[inline]
pub(crate) fn pending() -> usize {
    let pending: usize;
    // SAFETY: reads a register that devices change.
    unsafe { asm!("csrr {}, mip", out(reg) pending, options(nostack, preserves_flags)) };
    pending
}

/// Returns the code address that the current interrupt has interrupted.
#[inline]
pub(crate) fn interrupted_at() -> usize {
    let at: usize;
    // SAFETY: reads a register.
    unsafe { asm!("csrr {}, mepc", out(reg) at, options(nomem, nostack, preserves_flags)) };
    at
}

/// Sleeps until an enabled interrupt is pending. Its handler runs only if interrupts are on.
#[inline]
pub fn sleep() {
    // SAFETY: stops this hart until an interrupt; memory may change during the sleep.
    unsafe { asm!("wfi", options(nostack)) };
}

/// Sleeps forever: this hart has no more work. If interrupts are on, their handlers still run.
pub fn park() -> ! {
    loop {
        sleep();
    }
}

/// Yields the emulator's turn to the next hart, and continues after all others have had a turn.
///
/// The emulator runs the harts in turn. Under icount it changes the turn only when a hart sleeps,
/// when it interrupts another, or when a timer expires. So a hart that spins must yield, or the
/// hart that it waits for does not run. This is a sleep that ends at once: the supervisor's
/// software interrupt is always pending (see start.S) and enabled only here. On a chip with real
/// cores, use `spin_loop` instead.
#[inline]
pub fn yield_turn() {
    // SAFETY: the interrupt is delegated to supervisor mode, in which no code runs: it ends the
    // sleep and is never taken.
    unsafe { asm!("csrsi mie, 2", "wfi", "csrci mie, 2", options(nostack)) };
}

/// Yields the turn until `holds` returns true.
#[inline]
pub fn yield_until(mut holds: impl FnMut() -> bool) {
    while !holds() {
        yield_turn();
    }
}
