//! Sources of interrupts, their handlers, and the signals that carry them.
//!
//! A source is raised by setting its bit in `PENDING` and, from another thread, sending the core's
//! thread a signal: at most one is under way. The handler runs on the stack of the task that it
//! interrupts. The signal mask never changes: no signal blocks another (SA_NODEFER, empty mask), so
//! that a task which is left inside a handler and one which is not have the same mask, and the
//! switch need not know. Signals that come while interrupts are masked return at once; at most a
//! few frames lie on a stack.

use super::state::{self, PENDING};
use super::tick;
use crate::context::InterruptContext;
use crate::interrupt::{AttachError, Interrupt, InterruptPriority};
use crate::sys::{self, sink};
use core::cell::UnsafeCell;
use core::mem::MaybeUninit;
use core::ptr;
use core::sync::atomic::{AtomicBool, AtomicI32, AtomicU8, Ordering, fence};

/// A handler: `FnMut`, since an interrupt never interrupts itself.
pub(super) type Handler = dyn FnMut(&InterruptContext) + Send;

/// The number of the tick.
pub(super) const TICK: u32 = 63;
/// T-RTOS-2: 1 is the deferred reschedule, which is no handler here. Everything else is above the
/// tick.
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

/// The thread to signal; zero while no scheduler runs.
static CORE_THREAD: AtomicI32 = AtomicI32::new(0);
/// A signal is under way that did not look at `PENDING` yet.
static SIGNALLED: AtomicBool = AtomicBool::new(false);

/// Carries interrupts of other threads.
fn raise_signal() -> i32 {
    libc::SIGRTMIN() + 2
}

/// Carries the tick.
pub(super) fn tick_signal() -> i32 {
    libc::SIGRTMIN() + 3
}

pub(crate) fn attach(
    interrupt: Interrupt,
    priority: InterruptPriority,
    handler: &'static mut Handler,
) -> Result<(), AttachError> {
    let source = SOURCES
        .get(usize::from(interrupt.number()))
        .ok_or(AttachError::NoSuchSource)?;
    sys::critical(|| {
        if source.priority.load(Ordering::Relaxed) != 0 {
            return Err(AttachError::HasHandler);
        }
        // SAFETY: interrupts are masked, and no handler of this source was ever there to run.
        unsafe { *source.handler.get() = Some(handler) };
        source.priority.store(priority.level(), Ordering::Relaxed);
        Ok(())
    })
}

/// Forgets all handlers. No scheduler runs.
pub(super) fn detach_all() {
    for source in &SOURCES {
        source.priority.store(0, Ordering::Relaxed);
        // SAFETY: no interrupt runs, and none will until the next start. What a handler owned is
        // leaked: it was given for ever.
        unsafe { *source.handler.get() = None };
    }
}

/// Raises an interrupt of the core. Callable from any thread of this process, from tasks, and from
/// handlers of signals. Raising one that is pending already does nothing; one without a handler
/// waits for it.
///
/// What the caller wrote before is visible to the handler.
pub fn raise(interrupt: Interrupt) {
    // Release pairs with the Acquire of who takes the bit.
    PENDING.fetch_or(1 << interrupt.number(), Ordering::Release);
    if state::on_core() {
        state::poll();
        return;
    }
    // SeqCst pairs with the fence in `begin`: either the thread is seen here, or that thread sees
    // the bit when its first task begins.
    fence(Ordering::SeqCst);
    let thread = CORE_THREAD.load(Ordering::Acquire);
    // AcqRel pairs with the swap in `on_signal`: whichever of the two comes second sees the other.
    // So either that handler looks at `PENDING` after our bit, or a signal is sent here.
    if thread != 0 && !SIGNALLED.swap(true, Ordering::AcqRel) {
        // SAFETY: sends a signal to a thread of this process, or to none.
        let sent =
            unsafe { libc::syscall(libc::SYS_tgkill, libc::getpid(), thread, raise_signal()) };
        if sent != 0 {
            SIGNALLED.store(false, Ordering::Release);
        }
    }
}

/// The pending source with a handler that is more urgent than `level`, and its priority.
pub(super) fn most_urgent(level: u32) -> Option<(u32, u32)> {
    let mut pending = PENDING.load(Ordering::Acquire);
    let mut best = None;
    let mut best_priority = level;
    while pending != 0 {
        let number = pending.trailing_zeros();
        pending &= pending - 1;
        let source = SOURCES.get(number as usize);
        let priority = source.map_or(TICK_PRIORITY, |it| it.priority.load(Ordering::Relaxed));
        if u32::from(priority) > best_priority {
            best_priority = u32::from(priority);
            best = Some((number, best_priority));
        }
    }
    best
}

/// Runs the handler of a source. Entered with interrupts masked once and the source's level taken.
pub(super) fn run(number: u32) {
    sink::interrupt_entered(number);
    match SOURCES.get(number as usize) {
        // The tick works on the kernel's lists, so nothing may interrupt it.
        None => tick::interrupt(),
        Some(source) => {
            // SAFETY: a source of this level runs once at a time, and `attach` never replaces.
            if let Some(handler) = unsafe { (*source.handler.get()).as_mut() } {
                let context = InterruptContext::new();
                state::nested(|| handler(&context));
                if context.has_woken() {
                    state::yield_from_interrupt();
                }
            }
        }
    }
    sink::interrupt_left(number);
}

/// The handler of both signals. It may interrupt a task anywhere, also in a call of the operating
/// system, which is then restarted when the task goes on (SA_RESTART), or says EINTR.
extern "C" fn on_signal(signal: i32) {
    // A stray signal for a thread that is no core any more.
    if !state::on_core() {
        return;
    }
    // The interrupted code may be between a failed call and its look at errno.
    // SAFETY: the address of this thread's errno; all tasks are on this thread.
    let errno = unsafe { *libc::__errno_location() };
    if signal == tick_signal() {
        PENDING.fetch_or(1 << TICK, Ordering::Relaxed);
    } else {
        // AcqRel pairs with the swap in `raise`.
        SIGNALLED.swap(false, Ordering::AcqRel);
    }
    state::interrupt();
    // SAFETY: as above.
    unsafe { *libc::__errno_location() = errno };
}

/// Makes this thread the core: signals are handled, and `raise` finds it.
pub(super) fn begin() -> Result<(), i32> {
    let handler: extern "C" fn(i32) = on_signal;
    let mut unblocked = MaybeUninit::<libc::sigset_t>::uninit();
    // SAFETY: the set and the actions are valid places; the handler is async-signal-safe: it
    // touches atomics, the core's own state, and the stacks of tasks.
    unsafe {
        libc::sigemptyset(unblocked.as_mut_ptr());
        for signal in [raise_signal(), tick_signal()] {
            let mut action: libc::sigaction = core::mem::zeroed();
            action.sa_sigaction = handler as *const () as usize;
            action.sa_flags = libc::SA_NODEFER | libc::SA_RESTART;
            libc::sigemptyset(&mut action.sa_mask);
            if libc::sigaction(signal, &action, ptr::null_mut()) != 0 {
                return Err(super::errno());
            }
            libc::sigaddset(unblocked.as_mut_ptr(), signal);
        }
        let refused = libc::pthread_sigmask(libc::SIG_UNBLOCK, unblocked.as_ptr(), ptr::null_mut());
        if refused != 0 {
            return Err(refused);
        }
    }
    SIGNALLED.store(false, Ordering::Relaxed);
    // Release pairs with the Acquire in `raise`.
    CORE_THREAD.store(this_thread(), Ordering::Release);
    // SeqCst pairs with the fence in `raise`.
    fence(Ordering::SeqCst);
    Ok(())
}

/// This thread is the core no more. The handler stays and ignores what is still under way.
pub(super) fn end() {
    CORE_THREAD.store(0, Ordering::Release);
}

pub(super) fn this_thread() -> i32 {
    // SAFETY: takes nothing.
    unsafe { libc::gettid() }
}
