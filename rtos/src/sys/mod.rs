//! The kernel's C interface, and the few wrappers around it that need `unsafe`.
#![allow(unsafe_code)]

pub(crate) mod ffi;
pub(crate) mod shared;
pub(crate) mod task;

/// Runs `body` with interrupts masked. Nests.
pub(crate) fn critical<R>(body: impl FnOnce() -> R) -> R {
    // SAFETY: callable from every task, and before the scheduler runs; the exit below pairs with
    // it.
    unsafe { ffi::tandem_enter_critical() };
    let result = body();
    // SAFETY: pairs with the entry above.
    unsafe { ffi::tandem_exit_critical() };
    result
}
