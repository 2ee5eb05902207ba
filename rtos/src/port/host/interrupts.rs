//! Sources of interrupts, their handlers, and the signals that carry them.
//!
//! To raise a source, a caller sets its bit in `PENDING`. A caller on another thread also sends the
//! core's thread a signal; at most one is under way. The handler runs on the stack of the task that
//! it interrupts. The signal mask never changes: no signal blocks another (SA_NODEFER, empty mask).
//! So a task that is switched out inside a handler has the same mask as any other, and the switch
//! need not change it. Signals that arrive while interrupts are masked return at once, so at most a
//! few frames are on a stack.

use super::process::{fatal, keeping_errno};
use super::state::{self, DEFERRED, DEPTH, LEVEL, PENDING, YIELD, on_core};
use super::switch::tandem_switch;
use super::{fault, signals, tick};
use crate::context::InterruptContext;
use crate::ffi::{self, current_tcb};
use crate::interrupt::{HandlerError, Interrupt, InterruptPriority};
use crate::port::events::{self, KernelEventKind};
use core::cell::UnsafeCell;
use core::sync::atomic::Ordering::Relaxed;
use core::sync::atomic::{AtomicU8, AtomicUsize, Ordering, compiler_fence};

/// A handler. It may be `FnMut`, since an interrupt never interrupts itself.
pub(super) type Handler = dyn FnMut(&InterruptContext) + Send;

/// T-RTOS-2: priority 1 is the deferred reschedule, which has no handler here. All other interrupts
/// are above the tick.
const TICK_PRIORITY: u8 = 2;

struct Source {
    priority: AtomicU8,
    handler: UnsafeCell<Option<&'static mut Handler>>,
}

// SAFETY: a handler is written with interrupts masked and called with its source's level held, both
// on the core's thread; it is `Send`.
unsafe impl Sync for Source {}

static SOURCES: [Source; 63] = [const {
    Source {
        priority: AtomicU8::new(0),
        handler: UnsafeCell::new(None),
    }
}; 63];

/// Address of the context to which the last handler that ended with signals unblocked returns. That
/// handler's variables are below this address; those of the interrupted code are above it.
static LEAVING: AtomicUsize = AtomicUsize::new(0);
/// If a stack pointer is less than this many bytes below [`LEAVING`], the interrupted code may be
/// the end of that handler.
static NEAR: AtomicUsize = AtomicUsize::new(0);

pub(crate) fn attach(
    interrupt: Interrupt,
    priority: InterruptPriority,
    handler: &'static mut Handler,
) -> Result<(), HandlerError> {
    let source = SOURCES
        .get(usize::from(interrupt.number()))
        .ok_or(HandlerError::NoSuchSource)?;
    ffi::critical(|| {
        if source.priority.load(Ordering::Relaxed) != 0 {
            return Err(HandlerError::HasHandler);
        }
        // SAFETY: interrupts are masked, and this source had no handler that could run.
        unsafe { *source.handler.get() = Some(handler) };
        source.priority.store(priority.level(), Ordering::Relaxed);
        Ok(())
    })
}

/// Removes all handlers. No scheduler runs.
pub(super) fn detach_all() {
    for source in &SOURCES {
        source.priority.store(0, Ordering::Relaxed);
        // SAFETY: no interrupt runs, and none will until the next start. Objects that a handler
        // owned are leaked.
        unsafe { *source.handler.get() = None };
    }
}

/// Raises an interrupt of the core. Callable from any thread of this process, from tasks, and from
/// handlers of signals. Raising a pending interrupt has no effect. An interrupt without a handler
/// stays pending.
///
/// Everything that the caller wrote before is visible to the handler.
pub fn raise(interrupt: Interrupt) {
    // Release pairs with the Acquire of the core that takes the bit.
    PENDING.fetch_or(1 << interrupt.number(), Ordering::Release);
    if on_core() {
        poll();
    } else {
        signals::send();
    }
}

/// Ends one level of masking.
pub(super) fn unmask() {
    if state::unmask_once() {
        tandem_port_attend();
    }
}

/// Serves interrupts. Called when interrupts are unmasked and `attention` is set.
#[unsafe(no_mangle)]
extern "C" fn tandem_port_attend() {
    state::set_masked(1);
    // Keep errno: code that unmasks (to free memory, say) may still read it after a failed call.
    keeping_errno(serve_and_unmask);
}

/// Serves pending interrupts. Interrupts are masked once on entry and unmasked on return.
fn serve_and_unmask() {
    loop {
        state::clear_attention();
        signals::acknowledge();
        serve();
        state::set_masked(0);
        if !state::needs_attention() {
            return;
        }
        state::set_masked(1);
    }
}

/// Runs every pending interrupt above the current level, then switches if a switch is due and no
/// interrupt is left. Interrupts are masked once on entry and on return.
fn serve() {
    while let Some((number, priority)) = most_urgent(LEVEL.load(Relaxed)) {
        // Acquire pairs with the Release of the raising thread.
        PENDING.fetch_and(!(1 << number), Ordering::Acquire);
        let level = LEVEL.load(Relaxed);
        LEVEL.store(priority, Relaxed);
        DEPTH.store(DEPTH.load(Relaxed) + 1, Relaxed);
        run(number);
        DEPTH.store(DEPTH.load(Relaxed) - 1, Relaxed);
        LEVEL.store(level, Relaxed);
    }
    // T-RTOS-2: the switch waits until the last interrupt has ended.
    if state::may_switch() && YIELD.load(Relaxed) {
        switch();
    }
}

/// Returns the pending source with a handler that is more urgent than `level`, and its priority.
fn most_urgent(level: u32) -> Option<(u32, u32)> {
    // Acquire pairs with the Release in `raise`.
    let mut pending = PENDING.load(Ordering::Acquire);
    let mut best = None;
    let mut best_priority = level;
    while pending != 0 {
        let number = pending.trailing_zeros();
        pending &= pending - 1;
        let source = SOURCES.get(number as usize);
        let priority = source.map_or(TICK_PRIORITY, |it| it.priority.load(Relaxed));
        if u32::from(priority) > best_priority {
            best_priority = u32::from(priority);
            best = Some((number, best_priority));
        }
    }
    best
}

/// Runs the handler of a source. On entry interrupts are masked once and `LEVEL` is the source's.
fn run(number: u32) {
    events::record(
        KernelEventKind::InterruptEntered,
        number,
        tick::timestamp_ns,
    );
    match SOURCES.get(number as usize) {
        // The tick changes the kernel's lists, so nothing may interrupt it.
        None => tick::interrupt(),
        Some(source) => {
            // SAFETY: only one source of a level runs at a time; `attach` never replaces one.
            if let Some(handler) = unsafe { (*source.handler.get()).as_mut() } {
                let context = InterruptContext::new();
                nested(|| handler(&context));
                if context.has_woken() {
                    state::tandem_port_yield_from_interrupt();
                }
            }
        }
    }
    events::record(KernelEventKind::InterruptLeft, number, tick::timestamp_ns);
}

/// Unmasks more urgent interrupts while a handler runs.
fn nested<R>(handler: impl FnOnce() -> R) -> R {
    /// Ends the process if the handler unwinds: the interrupted code could not continue.
    struct Unwound;
    impl Drop for Unwound {
        fn drop(&mut self) {
            fatal(format_args!("a handler has unwound"));
        }
    }
    unmask();
    let unwound = Unwound;
    let result = handler();
    core::mem::forget(unwound);
    state::mask();
    result
}

/// Makes the kernel choose a task, and switches to it. Returns when this task is chosen again.
/// Interrupts are masked once on entry and on return.
fn switch() {
    YIELD.store(false, Relaxed);
    // SAFETY: interrupts are masked and no handler runs. Only the kernel changes its pointer to the
    // current task. Both control blocks are alive: one task is running, the other was chosen.
    unsafe {
        let from = current_tcb();
        ffi::vTaskSwitchContext();
        let to = current_tcb();
        if from != to {
            tandem_switch(&raw mut (*from).top_of_stack, (*to).top_of_stack);
        }
    }
}

/// `portYIELD`: switches as soon as interrupts are unmasked and pre-emption is not deferred.
#[unsafe(no_mangle)]
extern "C" fn tandem_port_yield() {
    if !state::is_masked() && state::may_switch() {
        state::set_masked(1);
        keeping_errno(switch);
        serve_if_asked_and_unmask();
    } else {
        state::tandem_port_yield_from_interrupt();
    }
}

/// Serves the interrupts that have become pending. Called after a switch back to a task.
pub(super) fn serve_if_asked_and_unmask() {
    state::set_masked(0);
    if state::needs_attention() {
        tandem_port_attend();
    }
}

/// Called when an interrupt was made pending on the core's own thread.
fn poll() {
    if state::is_masked() {
        state::want_attention();
    } else {
        state::set_masked(1);
        keeping_errno(serve_and_unmask);
    }
}

/// The handler of both signals. It may interrupt a task anywhere, even in a system call. When the
/// task continues, the call is restarted (SA_RESTART) or returns EINTR.
extern "C" fn on_signal(signal: i32, _: *mut libc::siginfo_t, context: *mut libc::ucontext_t) {
    // Ignores a late signal to a thread that is no longer the core.
    if !on_core() {
        return;
    }
    signals::arrived(signal);
    // SAFETY: the operating system passes the context that it put on this stack.
    let interrupted = unsafe { fault::stack_pointer(context) };
    // The interrupted code may be between a failed call and its read of errno.
    keeping_errno(|| interrupt(context.addr(), interrupted));
}

/// Handles a signal on the core's thread. The handler returns to the context at the address
/// `context`, whose stack pointer is `interrupted`.
///
/// A signal that arrives between the last read of `attention` and the end of the handler is served
/// in a separate frame below this one, and another signal may interrupt the end of that handler. To
/// bound the number of frames, a handler that may have interrupted such an end returns with both
/// signals blocked. The operating system unblocks them when it removes the frame, and then delivers
/// the pending ones.
fn interrupt(context: usize, interrupted: usize) {
    if state::is_masked() {
        state::want_attention();
        return;
    }
    state::set_masked(1);
    let leaving = LEAVING.load(Relaxed);
    let at_an_end = interrupted <= leaving && leaving - interrupted < NEAR.load(Relaxed);
    loop {
        state::clear_attention();
        signals::acknowledge();
        serve();
        if at_an_end {
            signals::block(true);
            // The interrupted handler has not returned yet.
            LEAVING.store(leaving, Relaxed);
        } else {
            LEAVING.store(context, Relaxed);
        }
        state::set_masked(0);
        if !state::needs_attention() {
            #[cfg(test)]
            tests::at_an_end(interrupted);
            return;
        }
        state::set_masked(1);
        if at_an_end {
            signals::block(false);
        }
    }
}

/// Makes this thread the core. First reads the size of the operating system's signal frames.
///
/// The doorbell's signal and those of both timers may arrive together at the end of a handler. Each
/// interrupts the previous one at its first instruction, so two more frames lie between the code
/// that the last one interrupts and that end.
pub(super) fn begin() -> Result<(), i32> {
    /// Bytes of stack that a handler uses below its frame.
    const BELOW: usize = 4 << 10;
    // SAFETY: reads a number; zero if it is not known.
    let frame = unsafe { libc::getauxval(libc::AT_MINSIGSTKSZ) } as usize;
    NEAR.store(2 * frame.max(8 << 10) + BELOW, Relaxed);
    signals::begin(on_signal)
}

/// Runs `body` while no other task of the core runs; interrupts still run. Calls nest. On other
/// threads it only calls `body`.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::port::host::scheduler;
    use std::mem::MaybeUninit;
    use std::ptr;
    use std::sync::atomic::AtomicU32;
    use std::thread;

    /// How many more times a handler's end is interrupted, and by how many ticks each time.
    static TO_COME: AtomicU32 = AtomicU32::new(0);
    static TICKS: AtomicU32 = AtomicU32::new(0);
    /// The lowest stack pointer of interrupted code.
    static DEEPEST: AtomicUsize = AtomicUsize::new(usize::MAX);

    /// Sends a doorbell and ticks to this thread at the same time, with nothing to serve. As in a
    /// run, at most one doorbell signal is under way. A timer sends no second signal before its
    /// first one is handled, so none arrives at a handler that has blocked them.
    fn signals_arrive() {
        let mut before = MaybeUninit::<libc::sigset_t>::uninit();
        // SAFETY: the first call fills the set. If the signals were not blocked before, the last
        // call unblocks them, and they are handled then.
        unsafe {
            libc::pthread_sigmask(libc::SIG_BLOCK, ptr::null(), before.as_mut_ptr());
            let blocked = libc::sigismember(before.as_ptr(), signals::tick_signal()) == 1;
            signals::block(true);
            for _ in (0..TICKS.load(Relaxed)).filter(|_| !blocked) {
                signals::send_tick();
            }
            signals::send();
            libc::pthread_sigmask(libc::SIG_SETMASK, before.as_ptr(), ptr::null_mut());
        }
    }

    /// Called by a handler that has served everything and can still be interrupted.
    pub(super) fn at_an_end(interrupted: usize) {
        DEEPEST.fetch_min(interrupted, Relaxed);
        let left = TO_COME.load(Relaxed);
        if left > 0 {
            TO_COME.store(left - 1, Relaxed);
            signals_arrive();
        }
    }

    /// T-RTOS-2: a handler's end is interrupted 5 or 30 times, by a doorbell alone or together with
    /// the signals of both timers. The stack is equally deep in both cases.
    #[test]
    fn frames_of_interrupts_do_not_pile_up() {
        // No tick is ever due.
        assert_eq!(tick::prepare(crate::port::TickSource::Virtual), Ok(()));
        assert_eq!(begin(), Ok(()));
        unmask();
        let deepest_of = |count| {
            DEEPEST.store(usize::MAX, Relaxed);
            TO_COME.store(count, Relaxed);
            signals_arrive();
            assert_eq!(TO_COME.load(Relaxed), 0);
            DEEPEST.load(Relaxed)
        };
        for ticks in 0..=2 {
            TICKS.store(ticks, Relaxed);
            let [seldom, often] = [5, 30].map(deepest_of);
            assert_eq!(often, seldom, "{ticks} ticks");
        }
        state::mask();
        signals::end();
        scheduler::reset();
    }

    fn doorbell_rings() {
        let rang = thread::spawn(|| raise(Interrupt::DOORBELL));
        rang.join().unwrap();
    }

    /// As [`doorbell_rings`], with the stack pointer 512 bytes lower.
    #[inline(never)]
    fn doorbell_rings_deeper() {
        let room = core::hint::black_box([0_u8; 512]);
        doorbell_rings();
        core::hint::black_box(room);
    }

    /// A handler that has ended is not mistaken for one that was interrupted at its end. The
    /// mistake would cost a system call in each later interrupt.
    #[test]
    fn interrupts_of_code_further_down_the_stack_block_nothing() {
        assert_eq!(begin(), Ok(()));
        unmask();
        doorbell_rings();
        let before = signals::BLOCKED.load(Relaxed);
        for _ in 0..10 {
            doorbell_rings_deeper();
        }
        let blocked = signals::BLOCKED.load(Relaxed) - before;
        state::mask();
        signals::end();
        scheduler::reset();
        assert_eq!(blocked, 0, "of 10 handlers");
    }

    /// A doorbell between `begin` and the first task is not lost and does not suppress later ones:
    /// the core sets `attention`.
    #[test]
    fn a_signal_while_the_core_starts_is_noted() {
        assert_eq!(begin(), Ok(()));
        assert!(!state::needs_attention());
        doorbell_rings();
        let noted = state::needs_attention();
        signals::end();
        scheduler::reset();
        assert!(noted);
    }
}
