//! The life of the scheduler: its start, the first code of each task, idling, and its end.

use super::process::fatal;
use super::switch::{first_frame, tandem_switch};
use super::{interrupts, state, tick};
use crate::ffi::{self, Base, Tcb, current_tcb};
use core::ffi::c_void;
use core::ptr;
use core::sync::atomic::AtomicPtr;
use core::sync::atomic::Ordering::Relaxed;

/// The saved context of the thread that started the scheduler.
static STARTER: AtomicPtr<usize> = AtomicPtr::new(ptr::null_mut());

/// The first code of every task. The first switch to the task calls it, on the task's stack.
extern "C" fn begin(code: extern "C" fn(*mut c_void), argument: *mut c_void) -> ! {
    interrupts::serve_if_asked_and_unmask();
    code(argument);
    fatal(format_args!("a task returned"))
}

#[unsafe(no_mangle)]
extern "C" fn pxPortInitialiseStack(
    top: *mut usize,
    code: extern "C" fn(*mut c_void),
    argument: *mut c_void,
) -> *mut usize {
    // SAFETY: the kernel passes the top of the stack that `create` gave it.
    unsafe { first_frame(top, begin, code, argument) }
}

/// Called by the kernel when it has chosen the first task; returns when the scheduler has stopped.
#[unsafe(no_mangle)]
extern "C" fn xPortStartScheduler() -> Base {
    state::set_masked(1);
    state::YIELD.store(false, Relaxed);
    // The first task serves interrupts that were raised before.
    state::want_attention();
    tick::begin();
    // SAFETY: the first task's context was made by `pxPortInitialiseStack`; this context is saved
    // in STARTER, where `leave` finds it.
    unsafe {
        let first: *mut Tcb = current_tcb();
        tandem_switch(STARTER.as_ptr(), (*first).top_of_stack);
    }
    0
}

/// Leaves the running task for good and returns to the start of the scheduler.
pub(super) fn leave() -> ! {
    state::mask();
    let mut abandoned = ptr::null_mut();
    // SAFETY: `xPortStartScheduler` saved this context on the thread's own stack, and has not
    // returned.
    unsafe { tandem_switch(&raw mut abandoned, STARTER.load(Relaxed)) };
    unreachable!("the abandoned task ran");
}

/// The idle task: ends the scheduler if `none_left` returns true, otherwise sleeps until a signal.
/// A signal before the call was already handled, and a task that it woke has already run; so the
/// sleep misses no signal.
pub(crate) fn idle(none_left: fn() -> bool) {
    if none_left() {
        leave();
    } else if tick::is_virtual() {
        tick::skip_to_next();
    } else {
        // SAFETY: has no arguments, and does not change the signal mask.
        unsafe { libc::pause() };
    }
}

/// Restores the state before the first task: interrupts masked, none pending, and no current task.
pub(super) fn reset() {
    state::reset();
    // SAFETY: no scheduler runs, and no task will run again.
    unsafe {
        ffi::vTaskResetState();
        ffi::vTimerResetState();
    }
}

/// The kernel requires this function, but this port stops in `leave`.
#[unsafe(no_mangle)]
extern "C" fn vPortEndScheduler() {}
