//! The two signals of the core's thread: one for interrupts of other threads, one for the tick.

use super::process::errno;
use super::state::{self, PENDING};
use core::mem::MaybeUninit;
use core::ptr;
use core::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// A handler of a signal: its number, what sent it, and the interrupted code.
pub(super) type Action = extern "C" fn(i32, *mut libc::siginfo_t, *mut libc::ucontext_t);

/// The number of the tick among the interrupts.
const TICK: u32 = 63;

/// The number of the thread to signal (zero while no scheduler runs), and [`SIGNALLED`]. Both are
/// in one word, so that one access sets the bit and reads the thread's number.
static CORE: AtomicU64 = AtomicU64::new(0);
/// Set while a signal to that thread is under way, and until `PENDING` is read after its arrival.
const SIGNALLED: u64 = 1 << 32;

/// Whether the signal has arrived and `PENDING` was not read since. Only the core's thread uses it.
static ARRIVED: AtomicBool = AtomicBool::new(false);

/// Returns the signal for interrupts of other threads, which
/// `rtos/tests/standard_demos/runner.rs` sends too.
fn raise_signal() -> i32 {
    libc::SIGRTMIN() + 2
}

/// Returns the signal for the tick.
pub(super) fn tick_signal() -> i32 {
    libc::SIGRTMIN() + 3
}

/// Makes the core read [`PENDING`]. Called by another thread, after it has set a bit there.
pub(super) fn send() {
    // AcqRel pairs with the exchanges in `acknowledge` and `begin`: the later of the two sees the
    // earlier. So either the core reads `PENDING` after our bit, or a signal is sent.
    let core = CORE.fetch_or(SIGNALLED, Ordering::AcqRel);
    let thread = core as u32;
    if thread != 0 && core & SIGNALLED == 0 {
        // SAFETY: sends a signal to a thread of this process, or to none.
        let sent =
            unsafe { libc::syscall(libc::SYS_tgkill, libc::getpid(), thread, raise_signal()) };
        if sent != 0 {
            // Clear the bit unless another thread is the core now; the next call then tries again.
            let _ =
                CORE.compare_exchange(core | SIGNALLED, core, Ordering::Release, Ordering::Relaxed);
        }
    }
}

/// Sends the tick's signal to the calling thread, which is the core.
pub(super) fn send_tick() {
    // SAFETY: a signal to the calling thread is handled before the call returns, if it is not
    // blocked.
    unsafe {
        libc::syscall(
            libc::SYS_tgkill,
            libc::getpid(),
            this_thread(),
            tick_signal(),
        )
    };
}

/// Records that one of the two signals has arrived.
pub(super) fn arrived(signal: i32) {
    if signal == tick_signal() {
        PENDING.fetch_or(1 << TICK, Ordering::Relaxed);
    } else {
        ARRIVED.store(true, Ordering::Relaxed);
    }
}

/// Called before the core reads `PENDING`: later interrupts send a signal again. It is not called
/// earlier, so that no signals pile up on the stack while interrupts are masked.
pub(super) fn acknowledge() {
    // Allow one signal at a time: a signal still under way would add a frame to that of the next.
    if ARRIVED.load(Ordering::Relaxed) {
        ARRIVED.store(false, Ordering::Relaxed);
        // AcqRel pairs with the exchange in `send`.
        CORE.fetch_and(!SIGNALLED, Ordering::AcqRel);
    }
}

/// How many times the signals were blocked.
#[cfg(test)]
pub(super) static BLOCKED: core::sync::atomic::AtomicU32 = core::sync::atomic::AtomicU32::new(0);

/// Blocks or unblocks both signals, on the core's thread.
pub(super) fn block(on: bool) {
    #[cfg(test)]
    BLOCKED.fetch_add(u32::from(on), Ordering::Relaxed);
    let how = if on {
        libc::SIG_BLOCK
    } else {
        libc::SIG_UNBLOCK
    };
    let mut signals = MaybeUninit::<libc::sigset_t>::uninit();
    // SAFETY: the set is a valid variable; async-signal-safe.
    unsafe {
        libc::sigemptyset(signals.as_mut_ptr());
        libc::sigaddset(signals.as_mut_ptr(), raise_signal());
        libc::sigaddset(signals.as_mut_ptr(), tick_signal());
        libc::pthread_sigmask(how, signals.as_ptr(), ptr::null_mut());
    }
}

/// Makes this thread the core: `handler` handles the signals, and [`send`] finds the thread.
pub(super) fn begin(handler: Action) -> Result<(), i32> {
    ARRIVED.store(false, Ordering::Relaxed);
    // Set this before the first signal can arrive. Interrupts are masked until the first task runs.
    state::set_on_core(true);
    set_up(handler).inspect_err(|_| state::set_on_core(false))?;
    // AcqRel pairs with the exchange in `send`. The first task always reads `PENDING` and sees a
    // bit that was set before; a thread that sets a bit later sends a signal.
    CORE.swap(u64::from(this_thread() as u32), Ordering::AcqRel);
    Ok(())
}

/// Sets `handler` for both signals, on this thread.
fn set_up(handler: Action) -> Result<(), i32> {
    let mut unblocked = MaybeUninit::<libc::sigset_t>::uninit();
    // SAFETY: the set and the actions are valid variables; the handler is async-signal-safe: it
    // touches atomics, the core's own state, and the stacks of tasks.
    unsafe {
        libc::sigemptyset(unblocked.as_mut_ptr());
        for signal in [raise_signal(), tick_signal()] {
            let mut action: libc::sigaction = core::mem::zeroed();
            action.sa_sigaction = handler as *const () as usize;
            action.sa_flags = libc::SA_NODEFER | libc::SA_RESTART | libc::SA_SIGINFO;
            libc::sigemptyset(&mut action.sa_mask);
            if libc::sigaction(signal, &action, ptr::null_mut()) != 0 {
                return Err(errno());
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

/// Ends the core on this thread. The handler remains set and ignores signals still under way.
pub(super) fn end() {
    // Release pairs with the Acquire of a raising thread, which then sees all that the core did.
    CORE.store(0, Ordering::Release);
    state::set_on_core(false);
}

pub(super) fn this_thread() -> i32 {
    // SAFETY: has no arguments.
    unsafe { libc::gettid() }
}
