//! The state of the simulated processor: masking, pending interrupts, and when to switch.
//!
//! Everything here belongs to the core's thread: its tasks, and the handlers of signals that
//! interrupt them on the same thread. Between these, program order is enough: loads and stores are
//! relaxed, and a compiler fence keeps them in place. Other threads access only [`PENDING`].
//!
//! The one rule: code that finds `masked` at zero may run interrupts, and raises it first. A signal
//! that arrives while it is above zero records its interrupt in [`PENDING`] and sets `attention`.
//! When `masked` returns to zero, `attention` is read *after* that. This read sees any earlier
//! signal; a later signal finds `masked` at zero and is served at once. So none is lost, and no
//! system call is needed.

use super::switch::{first_frame, tandem_switch};
use super::{interrupts, tick};
use crate::ffi::{self, Base, Tcb, current_tcb};
use core::ffi::c_void;
use core::ptr;
use core::sync::atomic::Ordering::Relaxed;
use core::sync::atomic::compiler_fence;
use core::sync::atomic::{AtomicBool, AtomicPtr, AtomicU32, AtomicU64, AtomicUsize, Ordering};
use std::cell::Cell;

/// Same layout as `struct TandemPort` in `kernel/host/portmacro.h`.
#[repr(C)]
struct Shared {
    /// How often interrupts are masked. Always above zero while no scheduler runs.
    masked: AtomicU32,
    /// Something must be served as soon as interrupts are unmasked.
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
static LEVEL: AtomicU32 = AtomicU32::new(0);
/// How many handlers are nested.
static DEPTH: AtomicU32 = AtomicU32::new(0);
/// How often pre-emption is deferred: interrupts run, and the switch waits.
static DEFERRED: AtomicU32 = AtomicU32::new(0);
/// A reschedule is due.
static YIELD: AtomicBool = AtomicBool::new(false);
/// Where the thread was when it started the scheduler.
static STARTER: AtomicPtr<usize> = AtomicPtr::new(ptr::null_mut());
/// Address of the context that the last handler that was left with signals unblocked returns to.
/// The handler's variables are below it, and those of the interrupted code above.
static LEAVING: AtomicUsize = AtomicUsize::new(0);
/// What is interrupted at the end of a handler has its stack pointer less than this below that
/// handler's context, bytes.
static NEAR: AtomicUsize = AtomicUsize::new(0);
/// Counts the lives of the kernel: objects of an earlier life must not be used.
static EPOCH: AtomicU32 = AtomicU32::new(1);

std::thread_local! {
    /// Whether the scheduler runs on this thread. Without a destructor and constant: a handler of
    /// signals may read it.
    static ON_CORE: Cell<bool> = const { Cell::new(false) };
}

/// Whether the caller is on the thread that the tasks share.
pub(super) fn on_core() -> bool {
    ON_CORE.get()
}

pub(super) fn set_on_core(on: bool) {
    ON_CORE.set(on);
}

pub(crate) fn epoch() -> u32 {
    EPOCH.load(Relaxed)
}

/// Masks interrupts; nests.
pub(super) fn mask() {
    let masked = &tandem_port.masked;
    masked.store(masked.load(Relaxed) + 1, Relaxed);
    compiler_fence(Ordering::SeqCst);
}

/// Ends one masking.
pub(super) fn unmask() {
    compiler_fence(Ordering::SeqCst);
    let masked = &tandem_port.masked;
    masked.store(masked.load(Relaxed) - 1, Relaxed);
    compiler_fence(Ordering::SeqCst);
    if masked.load(Relaxed) == 0 && tandem_port.attention.load(Relaxed) != 0 {
        tandem_port_attend();
    }
}

/// Interrupts are unmasked, and `attention` is set.
#[unsafe(no_mangle)]
extern "C" fn tandem_port_attend() {
    tandem_port.masked.store(1, Relaxed);
    // The code that unmasks (to free memory, say) may not have read errno of a failed call yet.
    super::keeping_errno(serve_and_unmask);
}

/// Entered with interrupts masked once; serves pending interrupts and returns with them unmasked.
fn serve_and_unmask() {
    loop {
        compiler_fence(Ordering::SeqCst);
        tandem_port.attention.store(0, Relaxed);
        compiler_fence(Ordering::SeqCst);
        interrupts::acknowledge();
        serve();
        compiler_fence(Ordering::SeqCst);
        tandem_port.masked.store(0, Relaxed);
        compiler_fence(Ordering::SeqCst);
        if tandem_port.attention.load(Relaxed) == 0 {
            return;
        }
        tandem_port.masked.store(1, Relaxed);
    }
}

/// Runs every pending interrupt above the current level, then switches if a switch is due and no
/// interrupt is left. Entered and left with interrupts masked once.
fn serve() {
    while let Some((number, priority)) = interrupts::most_urgent(LEVEL.load(Relaxed)) {
        // Acquire pairs with the Release of the raising thread.
        PENDING.fetch_and(!(1 << number), Ordering::Acquire);
        let level = LEVEL.load(Relaxed);
        LEVEL.store(priority, Relaxed);
        DEPTH.store(DEPTH.load(Relaxed) + 1, Relaxed);
        interrupts::run(number);
        DEPTH.store(DEPTH.load(Relaxed) - 1, Relaxed);
        LEVEL.store(level, Relaxed);
    }
    // T-RTOS-2: the switch waits until the last interrupt has ended.
    if DEPTH.load(Relaxed) == 0 && DEFERRED.load(Relaxed) == 0 && YIELD.load(Relaxed) {
        switch();
    }
}

/// Lets more urgent interrupts in while a handler runs.
pub(super) fn nested<R>(handler: impl FnOnce() -> R) -> R {
    /// The interrupted code cannot continue without the handler's end.
    struct Unwound;
    impl Drop for Unwound {
        fn drop(&mut self) {
            super::fatal(format_args!("a handler has unwound"));
        }
    }
    unmask();
    let unwound = Unwound;
    let result = handler();
    core::mem::forget(unwound);
    mask();
    result
}

/// Lets the kernel choose a task and switches to it. Returns when this task is chosen again,
/// with interrupts masked once as on entry.
fn switch() {
    YIELD.store(false, Relaxed);
    // SAFETY: interrupts are masked and none runs; the kernel's pointer to the current task is its
    // own, and both control blocks are alive: one is running, the other was chosen.
    unsafe {
        let from = current_tcb();
        ffi::vTaskSwitchContext();
        let to = current_tcb();
        if from != to {
            tandem_switch(&raw mut (*from).top_of_stack, (*to).top_of_stack);
        }
    }
}

/// `portYIELD`: at once, or as soon as interrupts are unmasked and pre-emption is not deferred.
#[unsafe(no_mangle)]
extern "C" fn tandem_port_yield() {
    let now = tandem_port.masked.load(Relaxed) == 0
        && DEPTH.load(Relaxed) == 0
        && DEFERRED.load(Relaxed) == 0;
    if now {
        tandem_port.masked.store(1, Relaxed);
        compiler_fence(Ordering::SeqCst);
        super::keeping_errno(switch);
        serve_if_asked_and_unmask();
    } else {
        tandem_port_yield_from_interrupt();
    }
}

/// After a switch back: serves the interrupts that have become pending.
fn serve_if_asked_and_unmask() {
    compiler_fence(Ordering::SeqCst);
    tandem_port.masked.store(0, Relaxed);
    compiler_fence(Ordering::SeqCst);
    if tandem_port.attention.load(Relaxed) != 0 {
        tandem_port_attend();
    }
}

/// `portYIELD_FROM_ISR`: when the last interrupt has ended.
#[unsafe(no_mangle)]
extern "C" fn tandem_port_yield_from_interrupt() {
    YIELD.store(true, Relaxed);
    tandem_port.attention.store(1, Relaxed);
}

/// An interrupt was made pending on the core's own thread.
pub(super) fn poll() {
    if tandem_port.masked.load(Relaxed) == 0 {
        tandem_port.masked.store(1, Relaxed);
        super::keeping_errno(serve_and_unmask);
    } else {
        tandem_port.attention.store(1, Relaxed);
    }
}

/// A signal arrived on the core's thread. Its handler returns to the context at the address
/// `context`, whose stack pointer is `interrupted`.
///
/// A signal that arrives between the last read of `attention` and the end of the handler is served
/// in its own frame, below this one; and another one may arrive at the end of that. So that frames
/// do not pile up while interrupts keep arriving, a handler that may have interrupted such an end
/// returns with both signals blocked. The operating system unblocks them when it removes the frame,
/// and then delivers the pending ones.
pub(super) fn interrupt(context: usize, interrupted: usize) {
    if tandem_port.masked.load(Relaxed) != 0 {
        tandem_port.attention.store(1, Relaxed);
        return;
    }
    tandem_port.masked.store(1, Relaxed);
    let leaving = LEAVING.load(Relaxed);
    let at_an_end = interrupted <= leaving && leaving - interrupted < NEAR.load(Relaxed);
    loop {
        compiler_fence(Ordering::SeqCst);
        tandem_port.attention.store(0, Relaxed);
        compiler_fence(Ordering::SeqCst);
        interrupts::acknowledge();
        serve();
        if at_an_end {
            interrupts::block(true);
            // The interrupted code is still at its end.
            LEAVING.store(leaving, Relaxed);
        } else {
            LEAVING.store(context, Relaxed);
        }
        compiler_fence(Ordering::SeqCst);
        tandem_port.masked.store(0, Relaxed);
        compiler_fence(Ordering::SeqCst);
        if tandem_port.attention.load(Relaxed) == 0 {
            #[cfg(test)]
            interrupts::tests::at_an_end(interrupted);
            return;
        }
        tandem_port.masked.store(1, Relaxed);
        if at_an_end {
            interrupts::block(false);
        }
    }
}

/// Called before the first signal: reads the size of the operating system's frames.
///
/// The doorbell's signal and those of both timers may arrive together. The last of them interrupts
/// the first instruction of the one before it, so two more frames are between it and that end.
pub(super) fn prepare_frames() {
    /// Bytes that a handler has on the stack below its frame.
    const BELOW: usize = 4 << 10;
    // SAFETY: asks for a number; zero if it is not known.
    let frame = unsafe { libc::getauxval(libc::AT_MINSIGSTKSZ) } as usize;
    NEAR.store(2 * frame.max(8 << 10) + BELOW, Relaxed);
}

/// As `portYIELD_FROM_ISR`, for the port's own interrupts.
pub(super) fn yield_from_interrupt() {
    tandem_port_yield_from_interrupt();
}

/// The process ends: nothing may interrupt its last message.
pub(super) fn mask_for_good() {
    if on_core() {
        mask();
    }
}

/// Runs `body` while no other task of the core runs; interrupts do. Nests. On other threads `body`
/// is just called.
pub(super) fn deferred<R>(body: impl FnOnce() -> R) -> R {
    struct End;
    impl Drop for End {
        fn drop(&mut self) {
            compiler_fence(Ordering::SeqCst);
            let deferred = DEFERRED.load(Relaxed) - 1;
            DEFERRED.store(deferred, Relaxed);
            compiler_fence(Ordering::SeqCst);
            let due = deferred == 0 && YIELD.load(Relaxed);
            if due && DEPTH.load(Relaxed) == 0 {
                tandem_port_yield();
            }
        }
    }
    if !on_core() {
        return body();
    }
    DEFERRED.store(DEFERRED.load(Relaxed) + 1, Relaxed);
    compiler_fence(Ordering::SeqCst);
    let _end = End;
    body()
}

/// Whether something must be served when interrupts are unmasked.
#[cfg(test)]
pub(super) fn needs_attention() -> bool {
    tandem_port.attention.load(Relaxed) != 0
}

/// The caller is about to block.
pub(crate) fn assert_may_block() {
    let may = tandem_port.masked.load(Relaxed) == 0 && DEFERRED.load(Relaxed) == 0;
    assert!(
        may && DEPTH.load(Relaxed) == 0,
        "a call that may block, in a handler, in a critical section or with pre-emption deferred"
    );
}

/// Whether the caller is a task: on the core's thread, and not a handler.
pub(crate) fn in_task() -> bool {
    on_core() && !in_interrupt()
}

/// Whether a handler of an interrupt runs.
pub(super) fn in_interrupt() -> bool {
    DEPTH.load(Relaxed) != 0
}

/// The first code of every task, called on its own stack by the first switch to it.
pub(super) extern "C" fn begin(code: extern "C" fn(*mut c_void), argument: *mut c_void) -> ! {
    serve_if_asked_and_unmask();
    code(argument);
    super::fatal(format_args!("a task returned"))
}

#[unsafe(no_mangle)]
extern "C" fn pxPortInitialiseStack(
    top: *mut usize,
    code: extern "C" fn(*mut c_void),
    argument: *mut c_void,
) -> *mut usize {
    // SAFETY: the kernel passes the top of the stack that `create` gave it.
    unsafe { first_frame(top, code, argument) }
}

/// Called by the kernel when it has chosen the first task; returns when the scheduler has stopped.
#[unsafe(no_mangle)]
extern "C" fn xPortStartScheduler() -> Base {
    tandem_port.masked.store(1, Relaxed);
    YIELD.store(false, Relaxed);
    // The first task serves interrupts that were raised before.
    tandem_port.attention.store(1, Relaxed);
    tick::begin();
    // SAFETY: the first task's context was made by `pxPortInitialiseStack`; this context goes to
    // STARTER, whence `leave` takes it.
    unsafe {
        let first: *mut Tcb = current_tcb();
        tandem_switch(STARTER.as_ptr(), (*first).top_of_stack);
    }
    0
}

/// Leaves the running task for good and returns to the start of the scheduler.
pub(super) fn leave() -> ! {
    mask();
    let mut abandoned = ptr::null_mut();
    // SAFETY: `xPortStartScheduler` saved this context on the thread's own stack, and has not
    // returned.
    unsafe { tandem_switch(&raw mut abandoned, STARTER.load(Relaxed)) };
    unreachable!("the abandoned task ran");
}

/// As before the first task: everything masked, nothing pending, no task known.
pub(super) fn reset() {
    tandem_port.masked.store(1, Relaxed);
    compiler_fence(Ordering::SeqCst);
    tandem_port.attention.store(0, Relaxed);
    PENDING.store(0, Relaxed);
    LEVEL.store(0, Relaxed);
    DEPTH.store(0, Relaxed);
    DEFERRED.store(0, Relaxed);
    YIELD.store(false, Relaxed);
    EPOCH.store(EPOCH.load(Relaxed) + 1, Relaxed);
    // SAFETY: no scheduler runs, and no task will run again.
    unsafe {
        ffi::vTaskResetState();
        ffi::vTimerResetState();
    }
}

/// The kernel requires this function; this port stops by `leave`.
#[unsafe(no_mangle)]
extern "C" fn vPortEndScheduler() {}
