//! The state of the simulated processor: masking, pending interrupts, and whether a switch is due.
//!
//! Only the core's thread uses this state: its tasks, and the handlers of signals that interrupt
//! them on the same thread. Between these, program order is enough: loads and stores are relaxed,
//! and a compiler fence keeps them in order. Other threads access only [`PENDING`].
//!
//! The one rule: code that finds `masked` at zero increments it, and then may run interrupts. A
//! signal that arrives while `masked` is above zero leaves its bit in [`PENDING`] and sets
//! `attention`. After `masked` has returned to zero, `attention` is read. This read sees any
//! earlier signal; a later signal finds `masked` at zero and is served at once. So no signal is
//! lost, and no system call is needed.

use core::sync::atomic::Ordering::{Relaxed, SeqCst};
use core::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, compiler_fence};
use std::cell::Cell;

/// Same layout as `struct TandemPort` in `kernel/host/portmacro.h`.
#[repr(C)]
struct Shared {
    /// How many times interrupts are masked. Always above zero while no scheduler runs.
    masked: AtomicU32,
    /// Not zero if pending interrupts or a switch must be served when interrupts are unmasked.
    attention: AtomicU32,
}

#[unsafe(no_mangle)]
static tandem_port: Shared = Shared {
    masked: AtomicU32::new(1),
    attention: AtomicU32::new(0),
};

/// Raised interrupts that have not run yet, by number.
pub(super) static PENDING: AtomicU64 = AtomicU64::new(0);
/// Priority of the running interrupt; zero in a task.
pub(super) static LEVEL: AtomicU32 = AtomicU32::new(0);
/// How many handlers are nested.
pub(super) static DEPTH: AtomicU32 = AtomicU32::new(0);
/// How many times pre-emption is deferred: interrupts run, and the switch waits.
pub(super) static DEFERRED: AtomicU32 = AtomicU32::new(0);
/// Whether a reschedule is due.
pub(super) static YIELD: AtomicBool = AtomicBool::new(false);
/// Counts the lives of the kernel: objects of an earlier life must not be used.
static EPOCH: AtomicU32 = AtomicU32::new(1);

std::thread_local! {
    /// Whether the scheduler runs on this thread. It is constant-initialised and has no destructor,
    /// because a handler of signals may read it.
    static ON_CORE: Cell<bool> = const { Cell::new(false) };
}

/// Returns whether the caller runs on the core's thread.
pub(super) fn on_core() -> bool {
    ON_CORE.get()
}

pub(super) fn set_on_core(on: bool) {
    ON_CORE.set(on);
}

pub(crate) fn epoch() -> u32 {
    EPOCH.load(Relaxed)
}

/// Masks interrupts. Calls nest.
pub(super) fn mask() {
    let masked = &tandem_port.masked;
    masked.store(masked.load(Relaxed) + 1, Relaxed);
    compiler_fence(SeqCst);
}

/// Ends one level of masking. Returns true if interrupts are now unmasked and `attention` is set:
/// the caller must then serve them.
#[must_use]
pub(super) fn unmask_once() -> bool {
    compiler_fence(SeqCst);
    let masked = &tandem_port.masked;
    set_masked(masked.load(Relaxed) - 1);
    masked.load(Relaxed) == 0 && needs_attention()
}

/// Returns whether interrupts are masked.
pub(super) fn is_masked() -> bool {
    tandem_port.masked.load(Relaxed) != 0
}

/// Sets how many times interrupts are masked: 1 to begin serving, 0 when all are served.
pub(super) fn set_masked(times: u32) {
    compiler_fence(SeqCst);
    tandem_port.masked.store(times, Relaxed);
    compiler_fence(SeqCst);
}

/// Returns whether interrupts or a switch must be served when interrupts are unmasked.
pub(super) fn needs_attention() -> bool {
    tandem_port.attention.load(Relaxed) != 0
}

/// Requests service when interrupts are next unmasked.
pub(super) fn want_attention() {
    tandem_port.attention.store(1, Relaxed);
}

/// Called before pending interrupts are read, so that a later signal sets `attention` again.
pub(super) fn clear_attention() {
    compiler_fence(SeqCst);
    tandem_port.attention.store(0, Relaxed);
    compiler_fence(SeqCst);
}

/// `portYIELD_FROM_ISR`: requests a switch at the end of the last interrupt.
#[unsafe(no_mangle)]
pub(super) extern "C" fn tandem_port_yield_from_interrupt() {
    YIELD.store(true, Relaxed);
    want_attention();
}

/// Masks interrupts until the process ends, so that they cannot interrupt its last message.
pub(super) fn mask_for_good() {
    if on_core() {
        mask();
    }
}

/// Panics if the caller must not block.
pub(crate) fn assert_may_block() {
    assert!(
        !is_masked() && may_switch(),
        "a call that may block, in a handler, in a critical section or with pre-emption deferred"
    );
}

/// Returns whether no handler runs and pre-emption is not deferred.
pub(super) fn may_switch() -> bool {
    DEPTH.load(Relaxed) == 0 && DEFERRED.load(Relaxed) == 0
}

/// Returns whether the caller is a task: on the core's thread, and not a handler.
pub(crate) fn in_task() -> bool {
    on_core() && !in_interrupt()
}

/// Returns whether a handler of an interrupt runs.
pub(super) fn in_interrupt() -> bool {
    DEPTH.load(Relaxed) != 0
}

/// Restores the state before the first task: interrupts masked, none pending.
pub(super) fn reset() {
    set_masked(1);
    tandem_port.attention.store(0, Relaxed);
    PENDING.store(0, Relaxed);
    LEVEL.store(0, Relaxed);
    DEPTH.store(0, Relaxed);
    DEFERRED.store(0, Relaxed);
    YIELD.store(false, Relaxed);
    EPOCH.store(EPOCH.load(Relaxed) + 1, Relaxed);
}
