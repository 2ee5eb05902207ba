//! Sources of interrupts, their handlers, and the signals that carry them.
//!
//! A source is raised by setting its bit in `PENDING` and, from another thread, sending the core's
//! thread a signal: at most one is under way. The handler runs on the stack of the task that it
//! interrupts. The signal mask never changes: no signal blocks another (SA_NODEFER, empty mask), so
//! a task that is left inside a handler has the same mask as any other, and the switch need not
//! handle it. Signals that arrive while interrupts are masked return at once; at most a few frames
//! are on a stack.

use super::state::{self, PENDING};
use super::{fault, tick};
use crate::context::InterruptContext;
use crate::ffi;
use crate::interrupt::{AttachError, Interrupt, InterruptPriority};
use crate::port::trace;
use core::cell::UnsafeCell;
use core::mem::MaybeUninit;
use core::ptr;
use core::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering};

/// A handler of a signal: its number, what sent it, and the interrupted code.
type Action = extern "C" fn(i32, *mut libc::siginfo_t, *mut libc::ucontext_t);
/// A handler: `FnMut`, since an interrupt never interrupts itself.
pub(super) type Handler = dyn FnMut(&InterruptContext) + Send;

/// The number of the tick.
pub(super) const TICK: u32 = 63;
/// T-RTOS-2: 1 is the deferred reschedule, which has no handler here. Everything else is above the
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

/// The number of the thread to signal, zero while no scheduler runs; and [`SIGNALLED`]. In one
/// word, so that a thread that sets the bit knows to which core it belongs.
static CORE: AtomicU64 = AtomicU64::new(0);
/// A signal to that thread is under way, or has arrived and `PENDING` was not read since.
const SIGNALLED: u64 = 1 << 32;

/// The signal has arrived, and `PENDING` was not read since. Only for the core's thread.
static ARRIVED: AtomicBool = AtomicBool::new(false);

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
    ffi::critical(|| {
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
/// handlers of signals. Raising a pending interrupt has no effect; without a handler it stays
/// pending.
///
/// Everything that the caller wrote before is visible to the handler.
pub fn raise(interrupt: Interrupt) {
    // Release pairs with the Acquire of the core that takes the bit.
    PENDING.fetch_or(1 << interrupt.number(), Ordering::Release);
    if state::on_core() {
        state::poll();
        return;
    }
    // AcqRel pairs with the exchanges in `acknowledge` and `begin`: the second of the two sees the
    // first. So either the core reads `PENDING` after our bit, or a signal is sent.
    let core = CORE.fetch_or(SIGNALLED, Ordering::AcqRel);
    let thread = core as u32;
    if thread != 0 && core & SIGNALLED == 0 {
        // SAFETY: sends a signal to a thread of this process, or to none.
        let sent =
            unsafe { libc::syscall(libc::SYS_tgkill, libc::getpid(), thread, raise_signal()) };
        if sent != 0 {
            // The next one tries again, if this life of the kernel is still the same.
            let _ =
                CORE.compare_exchange(core | SIGNALLED, core, Ordering::Release, Ordering::Relaxed);
        }
    }
}

/// Called before the core reads `PENDING`: later interrupts send a signal again. Not called
/// earlier, so that no signals pile up on the stack while interrupts are masked.
pub(super) fn acknowledge() {
    // One signal at a time: a signal that is still under way would add a frame to the next one's.
    if ARRIVED.load(Ordering::Relaxed) {
        ARRIVED.store(false, Ordering::Relaxed);
        // AcqRel pairs with the exchange in `raise`.
        CORE.fetch_and(!SIGNALLED, Ordering::AcqRel);
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
    trace::interrupt_entered(number);
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
    trace::interrupt_left(number);
}

/// The handler of both signals. It may interrupt a task anywhere, even in a system call, which is
/// restarted when the task continues (SA_RESTART) or returns EINTR.
extern "C" fn on_signal(signal: i32, _: *mut libc::siginfo_t, context: *mut libc::ucontext_t) {
    // A stray signal for a thread that is no longer a core.
    if !state::on_core() {
        return;
    }
    if signal == tick_signal() {
        PENDING.fetch_or(1 << TICK, Ordering::Relaxed);
    } else {
        ARRIVED.store(true, Ordering::Relaxed);
    }
    // SAFETY: the operating system passes the context that it put on this stack.
    let interrupted = unsafe { fault::stack_pointer(context) };
    // The interrupted code may be between a failed call and its read of errno.
    super::keeping_errno(|| state::interrupt(context.addr(), interrupted));
}

/// Blocks or unblocks both signals, on the core's thread.
pub(super) fn block(on: bool) {
    #[cfg(test)]
    tests::BLOCKED.fetch_add(u32::from(on), Ordering::Relaxed);
    let how = if on {
        libc::SIG_BLOCK
    } else {
        libc::SIG_UNBLOCK
    };
    let mut signals = MaybeUninit::<libc::sigset_t>::uninit();
    // SAFETY: the set is a valid place; async-signal-safe.
    unsafe {
        libc::sigemptyset(signals.as_mut_ptr());
        libc::sigaddset(signals.as_mut_ptr(), raise_signal());
        libc::sigaddset(signals.as_mut_ptr(), tick_signal());
        libc::pthread_sigmask(how, signals.as_ptr(), ptr::null_mut());
    }
}

/// Makes this thread the core: signals are handled, and `raise` finds it.
pub(super) fn begin() -> Result<(), i32> {
    let handler: Action = on_signal;
    state::prepare_frames();
    ARRIVED.store(false, Ordering::Relaxed);
    // Before the first signal can arrive. Interrupts are masked until the first task runs.
    state::set_on_core(true);
    set_up(handler).inspect_err(|_| state::set_on_core(false))?;
    // AcqRel pairs with the exchange in `raise`: the first task reads `PENDING` in any case and
    // sees a bit that was set before; a bit that is set later sends a signal.
    CORE.swap(u64::from(this_thread() as u32), Ordering::AcqRel);
    Ok(())
}

/// Sets `handler` for both signals, on this thread.
fn set_up(handler: Action) -> Result<(), i32> {
    let mut unblocked = MaybeUninit::<libc::sigset_t>::uninit();
    // SAFETY: the set and the actions are valid places; the handler is async-signal-safe: it
    // touches atomics, the core's own state, and the stacks of tasks.
    unsafe {
        libc::sigemptyset(unblocked.as_mut_ptr());
        for signal in [raise_signal(), tick_signal()] {
            let mut action: libc::sigaction = core::mem::zeroed();
            action.sa_sigaction = handler as *const () as usize;
            action.sa_flags = libc::SA_NODEFER | libc::SA_RESTART | libc::SA_SIGINFO;
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
    Ok(())
}

/// This thread is no longer the core. The handler stays and ignores signals still under way.
pub(super) fn end() {
    // Release pairs with the Acquire of a raising thread: the core has finished everything before.
    CORE.store(0, Ordering::Release);
    state::set_on_core(false);
}

pub(super) fn this_thread() -> i32 {
    // SAFETY: takes nothing.
    unsafe { libc::gettid() }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use std::sync::atomic::{AtomicU32, AtomicUsize};
    use std::thread;

    /// How often a handler left with its signals blocked.
    pub(super) static BLOCKED: AtomicU32 = AtomicU32::new(0);

    /// How often the end of a handler is still interrupted, and by how many ticks each time.
    static TO_COME: AtomicU32 = AtomicU32::new(0);
    static TICKS: AtomicU32 = AtomicU32::new(0);
    /// The deepest stack pointer of interrupted code.
    static DEEPEST: AtomicUsize = AtomicUsize::new(usize::MAX);

    /// A doorbell and ticks that arrive at this thread together, with nothing to serve. As in a
    /// run, a doorbell has one signal under way at most; and a timer has none while its last one
    /// has not been handled, so none comes to a handler that has blocked them.
    fn signals() {
        let mut before = MaybeUninit::<libc::sigset_t>::uninit();
        // SAFETY: the set is a valid place, which the first call fills; the signals are handled
        // when the last one unblocks them, if they were not blocked before.
        unsafe {
            libc::pthread_sigmask(libc::SIG_BLOCK, ptr::null(), before.as_mut_ptr());
            let blocked = libc::sigismember(before.as_ptr(), tick_signal()) == 1;
            block(true);
            let send = |signal: i32| {
                libc::syscall(libc::SYS_tgkill, libc::getpid(), this_thread(), signal);
            };
            for _ in (0..TICKS.load(Ordering::Relaxed)).filter(|_| !blocked) {
                send(tick_signal());
            }
            if CORE.fetch_or(SIGNALLED, Ordering::Relaxed) & SIGNALLED == 0 {
                send(raise_signal());
            }
            libc::pthread_sigmask(libc::SIG_SETMASK, before.as_ptr(), ptr::null_mut());
        }
    }

    /// Called where a handler can be interrupted that has served everything.
    pub(in super::super) fn at_an_end(interrupted: usize) {
        DEEPEST.fetch_min(interrupted, Ordering::Relaxed);
        let left = TO_COME.load(Ordering::Relaxed);
        if left > 0 {
            TO_COME.store(left - 1, Ordering::Relaxed);
            signals();
        }
    }

    /// T-RTOS-2: however often a handler is interrupted at its end, by a doorbell alone or together
    /// with the signals of both timers, no frames are added but those of one such time.
    #[test]
    fn frames_of_interrupts_do_not_pile_up() {
        // No tick is ever due.
        assert_eq!(tick::prepare(crate::port::Clock::Virtual), Ok(()));
        assert_eq!(begin(), Ok(()));
        state::unmask();
        let deepest_of = |count| {
            DEEPEST.store(usize::MAX, Ordering::Relaxed);
            TO_COME.store(count, Ordering::Relaxed);
            signals();
            assert_eq!(TO_COME.load(Ordering::Relaxed), 0);
            DEEPEST.load(Ordering::Relaxed)
        };
        for ticks in 0..=2 {
            TICKS.store(ticks, Ordering::Relaxed);
            let [seldom, often] = [5, 30].map(deepest_of);
            assert_eq!(often, seldom, "{ticks} ticks");
        }
        state::mask();
        end();
        state::reset();
    }

    fn doorbell_rings() {
        let rang = thread::spawn(|| raise(Interrupt::DOORBELL));
        rang.join().unwrap();
    }

    /// As [`doorbell_rings`], some bytes further down the stack.
    #[inline(never)]
    fn doorbell_rings_deeper() {
        let room = core::hint::black_box([0_u8; 512]);
        doorbell_rings();
        core::hint::black_box(room);
    }

    /// A handler that has ended is not taken for one that has been interrupted at its end, which
    /// would cost a system call in each interrupt from then on.
    #[test]
    fn interrupts_of_code_further_down_the_stack_block_nothing() {
        assert_eq!(begin(), Ok(()));
        state::unmask();
        doorbell_rings();
        let before = BLOCKED.load(Ordering::Relaxed);
        for _ in 0..10 {
            doorbell_rings_deeper();
        }
        let blocked = BLOCKED.load(Ordering::Relaxed) - before;
        state::mask();
        end();
        state::reset();
        assert_eq!(blocked, 0, "of 10 handlers");
    }

    /// A doorbell between `begin` and the first task is not lost, and does not suppress later ones:
    /// the core records that there is something to serve.
    #[test]
    fn a_signal_while_the_core_starts_is_noted() {
        assert_eq!(begin(), Ok(()));
        assert!(!state::needs_attention());
        doorbell_rings();
        let noted = state::needs_attention();
        end();
        state::reset();
        assert!(noted);
    }
}
