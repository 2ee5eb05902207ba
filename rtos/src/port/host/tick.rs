//! The tick: 1 kHz on absolute time, or driven by virtual time.
//!
//! The timers expire on a grid that begins when the scheduler starts and that tasks may shift. Each
//! signal computes the number of due ticks from the clock, so no error accumulates; late ticks are
//! made up at once and counted.

use super::process::errno;
use super::{signals, state};
use crate::ffi;
use crate::port::TickSource;
use crate::time::TICK_NS;
use core::mem::MaybeUninit;
use core::ptr;
use core::sync::atomic::Ordering::Relaxed;
use core::sync::atomic::{AtomicBool, AtomicPtr, AtomicU32, AtomicU64};
use core::time::Duration;

static VIRTUAL: AtomicBool = AtomicBool::new(false);
/// Two timers that alternate. The operating system re-arms a periodic timer when it delivers the
/// signal, before the handler runs. If that timer is the next one to expire on this processor, the
/// system must program the hardware then, which costs microseconds on a virtual machine. With two
/// timers, the next one to expire is always the other.
static TIMERS: [AtomicPtr<libc::c_void>; 2] = [const { AtomicPtr::new(ptr::null_mut()) }; 2];
/// How many of the timers exist.
static MADE: AtomicU32 = AtomicU32::new(0);
/// Nanoseconds of CLOCK_MONOTONIC at tick 0; 0 in virtual time.
static START_NS: AtomicU64 = AtomicU64::new(0);
/// Nanoseconds of virtual time since tick 0.
static VIRTUAL_NS: AtomicU64 = AtomicU64::new(0);
/// When the last tick that was passed to the kernel was due, on [`timestamp_ns`]'s clock.
static LAST_NS: AtomicU64 = AtomicU64::new(0);
/// When the next tick is due, on that clock.
static NEXT_NS: AtomicU64 = AtomicU64::new(0);
static CAUGHT_UP: AtomicU64 = AtomicU64::new(0);
/// Called with the lateness of each tick interrupt in nanoseconds.
static OBSERVER: AtomicPtr<()> = AtomicPtr::new(ptr::null_mut());

/// Returns the number of ticks of this run, or of the last one, that were served together with a
/// later tick because the machine was late by more than a tick.
#[must_use]
pub fn caught_up() -> u64 {
    CAUGHT_UP.load(Relaxed)
}

/// Sets or removes `observer`. Each tick interrupt calls it with its lateness in nanoseconds. It
/// runs in interrupt context: it must not allocate, print or block.
pub fn observe(observer: Option<fn(u64)>) {
    let pointer = observer.map_or(ptr::null_mut(), |it| it as *mut ());
    OBSERVER.store(pointer, Relaxed);
}

/// Returns the time since tick 0 on the clock that drives the tick, ns.
#[must_use]
pub fn elapsed_ns() -> u64 {
    if VIRTUAL.load(Relaxed) {
        VIRTUAL_NS.load(Relaxed)
    } else {
        now_ns() - START_NS.load(Relaxed)
    }
}

/// Returns when the last tick was due and when the next one is, in nanoseconds of
/// [`timestamp_ns`]'s clock. Called with interrupts masked.
pub(crate) fn tick_times_ns() -> (u64, u64) {
    (LAST_NS.load(Relaxed), NEXT_NS.load(Relaxed))
}

/// Moves the next tick to this time, and all later ones with it. Called with interrupts masked,
/// while no tick is due.
pub(crate) fn set_next_tick(at_ns: u64) {
    NEXT_NS.store(at_ns, Relaxed);
    if !is_virtual() {
        // A signal of the old time that arrives in between finds no tick due.
        arm(at_ns);
    }
}

/// Returns the time of CLOCK_MONOTONIC, ns.
#[must_use]
pub fn now_ns() -> u64 {
    let mut now = MaybeUninit::<libc::timespec>::uninit();
    // SAFETY: writes the time to a valid variable; this clock always exists.
    let now = unsafe {
        libc::clock_gettime(libc::CLOCK_MONOTONIC, now.as_mut_ptr());
        now.assume_init()
    };
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// Makes the timers. They do not run until `begin`.
pub(super) fn prepare(clock: TickSource) -> Result<(), i32> {
    VIRTUAL.store(clock == TickSource::Virtual, Relaxed);
    origin();
    VIRTUAL_NS.store(0, Relaxed);
    for count in [&CAUGHT_UP, &START_NS, &LAST_NS] {
        count.store(0, Relaxed);
    }
    NEXT_NS.store(TICK_NS, Relaxed);
    if clock == TickSource::Virtual {
        return Ok(());
    }
    for place in &TIMERS {
        let mut timer: libc::timer_t = ptr::null_mut();
        // SAFETY: an event of zeroes is valid and is then filled; the timer's signal goes to this
        // thread.
        let refused = unsafe {
            let mut event: libc::sigevent = core::mem::zeroed();
            event.sigev_notify = libc::SIGEV_THREAD_ID;
            event.sigev_signo = signals::tick_signal();
            event.sigev_notify_thread_id = signals::this_thread();
            libc::timer_create(libc::CLOCK_MONOTONIC, &mut event, &mut timer)
        };
        if refused != 0 {
            let refusal = errno();
            end();
            return Err(refusal);
        }
        place.store(timer, Relaxed);
        MADE.fetch_add(1, Relaxed);
    }
    Ok(())
}

/// Sets tick 0 to the current time and starts the timers.
pub(super) fn begin() {
    if VIRTUAL.load(Relaxed) {
        return;
    }
    let start = now_ns();
    START_NS.store(start, Relaxed);
    LAST_NS.store(start, Relaxed);
    NEXT_NS.store(start + TICK_NS, Relaxed);
    arm(start + TICK_NS);
}

/// Sets the timers: the first expires at `next_ns`, the other a tick later.
fn arm(next_ns: u64) {
    for (number, timer) in (0..).zip(&TIMERS) {
        let setting = libc::itimerspec {
            it_interval: time(TIMERS.len() as u64 * TICK_NS),
            it_value: time(next_ns + number * TICK_NS),
        };
        let timer = timer.load(Relaxed);
        // SAFETY: the timer was made by `prepare`; the setting is valid, so this cannot fail.
        unsafe { libc::timer_settime(timer, libc::TIMER_ABSTIME, &setting, ptr::null_mut()) };
    }
}

const fn time(ns: u64) -> libc::timespec {
    libc::timespec {
        tv_sec: (ns / 1_000_000_000) as libc::time_t,
        tv_nsec: (ns % 1_000_000_000) as libc::c_long,
    }
}

/// Deletes the timers.
pub(super) fn end() {
    let made = MADE.swap(0, Relaxed) as usize;
    for timer in &TIMERS[..made] {
        // SAFETY: the timer was made by `prepare` and is deleted once.
        unsafe { libc::timer_delete(timer.load(Relaxed)) };
    }
}

/// Handles the interrupt of the tick. Called with interrupts masked.
pub(super) fn interrupt() {
    let (now, next) = (timestamp_ns(), NEXT_NS.load(Relaxed));
    if now < next {
        return;
    }
    let late = now - next;
    let observer = OBSERVER.load(Relaxed);
    if !observer.is_null() {
        // SAFETY: `observe` stored a function of this type.
        let observer: fn(u64) = unsafe { core::mem::transmute(observer) };
        observer(late);
    }
    let due = 1 + late / TICK_NS;
    CAUGHT_UP.store(CAUGHT_UP.load(Relaxed) + due - 1, Relaxed);
    let last = next + (due - 1) * TICK_NS;
    LAST_NS.store(last, Relaxed);
    NEXT_NS.store(last + TICK_NS, Relaxed);
    for _ in 0..due {
        // SAFETY: interrupts are masked; called once for each tick.
        if unsafe { ffi::xTaskIncrementTick() } != 0 {
            state::tandem_port_yield_from_interrupt();
        }
    }
}

/// Advances virtual time by `span_ns` of the caller's work, which each tick interrupts when due.
pub(super) fn consume_virtual(mut span_ns: u64) {
    while span_ns > 0 {
        let now = VIRTUAL_NS.load(Relaxed);
        let left = left_to_tick(now);
        let step = span_ns.min(left);
        span_ns -= step;
        VIRTUAL_NS.store(now + step, Relaxed);
        if step == left {
            // The tick is a real signal in virtual time too, so pre-emption works in the same way.
            signals::send_tick();
        }
    }
}

/// Returns the virtual time from `now` to the next tick. Earlier ones may be pending, if interrupts
/// are masked.
fn left_to_tick(now: u64) -> u64 {
    let next = NEXT_NS.load(Relaxed);
    if now < next {
        next - now
    } else {
        TICK_NS - (now - next) % TICK_NS
    }
}

pub(super) fn is_virtual() -> bool {
    VIRTUAL.load(Relaxed)
}

/// Advances virtual time by `span`. Returns `false` if time is not virtual.
pub(crate) fn virtual_work(span: Duration) -> bool {
    if is_virtual() {
        consume_virtual(span.as_nanos() as u64);
    }
    is_virtual()
}

/// Returns the time of an event, in nanoseconds of CLOCK_MONOTONIC or of virtual time.
pub(crate) fn timestamp_ns() -> u64 {
    if is_virtual() {
        VIRTUAL_NS.load(Relaxed)
    } else {
        now_ns()
    }
}

/// Converts a span of [`run_time`] to time, with the average rate of that counter since the process
/// first used it.
pub(crate) fn run_time_span(counts: u64) -> Duration {
    let (origin_count, origin_ns) = origin();
    let counted = u128::from((run_time() - origin_count).max(1));
    let ns = u128::from(counts) * u128::from(now_ns() - origin_ns) / counted;
    Duration::from_nanos(ns as u64)
}

/// Returns counter and clock as they were at the first call.
fn origin() -> (u64, u64) {
    static ORIGIN: [AtomicU64; 2] = [const { AtomicU64::new(0) }; 2];
    if ORIGIN[0].load(Relaxed) == 0 {
        ORIGIN[1].store(now_ns(), Relaxed);
        ORIGIN[0].store(run_time(), Relaxed);
    }
    (ORIGIN[0].load(Relaxed), ORIGIN[1].load(Relaxed))
}

/// Advances virtual time to the next tick.
pub(super) fn skip_to_next() {
    let now = VIRTUAL_NS.load(Relaxed);
    consume_virtual(left_to_tick(now));
}

/// Reads the counter for the run time of tasks: the processor's own, without a system call.
pub(crate) fn run_time() -> u64 {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: reads a counter that every x86_64 has.
    unsafe {
        core::arch::x86_64::_rdtsc()
    }
    #[cfg(target_arch = "aarch64")]
    {
        let count: u64;
        // SAFETY: reads a counter that Linux lets programs read.
        unsafe { core::arch::asm!("mrs {}, cntvct_el0", out(reg) count) };
        count
    }
}
