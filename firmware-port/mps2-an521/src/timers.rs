//! The time: CMSDK timer 0 is the clock of both processors; each uses its SysTick as alarm.

use crate::cpu::{self, CPUS};
use core::ptr::{read_volatile, write_volatile};
use core::sync::atomic::{AtomicU32, Ordering};
use tandem_board::Instant;

/// The timer counts down at 20 MHz.
const NS_PER_TICK: u64 = 50;
const TIMER: usize = 0x5000_0000;
const TIMER_CONTROL: usize = TIMER;
const TIMER_VALUE: usize = TIMER + 4;
const TIMER_RELOAD: usize = TIMER + 8;

const SYSTICK_CONTROL: *mut u32 = 0xE000_E010 as *mut u32;
const SYSTICK_RELOAD: *mut u32 = 0xE000_E014 as *mut u32;
const SYSTICK_VALUE: *mut u32 = 0xE000_E018 as *mut u32;
/// Uses the processor clock (20 MHz), with the interrupt enabled.
const SYSTICK_ON: u32 = 0b111;
const SYSTICK_MAX: u64 = 0xFF_FFFF;

/// Starts the clock. Processor 0 calls this before it starts processor 1.
pub(crate) fn start() {
    // SAFETY: the timer's registers, which no other code uses.
    unsafe {
        write_volatile(TIMER_RELOAD as *mut u32, u32::MAX);
        write_volatile(TIMER_VALUE as *mut u32, u32::MAX);
        write_volatile(TIMER_CONTROL as *mut u32, 1);
    }
}

/// The state with which a processor extends the 32-bit counter to 64 bits: the last value that it
/// read, and how often the counter has wrapped around.
struct Seen {
    low: AtomicU32,
    wraps: AtomicU32,
}

static SEEN: [Seen; CPUS] = [const {
    Seen {
        low: AtomicU32::new(0),
        wraps: AtomicU32::new(0),
    }
}; CPUS];

/// Returns the time since the start. Each processor must call this at least once in 214 s, the
/// period of the counter.
#[must_use]
pub fn now() -> Instant {
    let seen = &SEEN[cpu::number()];
    let ticks = cpu::without_interrupts(|| {
        // SAFETY: reading has no side effect.
        let low = !unsafe { read_volatile(TIMER_VALUE as *const u32) };
        // Relaxed: only this processor uses `seen`, and interrupts are off.
        let mut wraps = seen.wraps.load(Ordering::Relaxed);
        wraps += u32::from(low < seen.low.load(Ordering::Relaxed));
        seen.low.store(low, Ordering::Relaxed);
        seen.wraps.store(wraps, Ordering::Relaxed);
        u64::from(wraps) << 32 | u64::from(low)
    });
    Instant::from_ns(ticks * NS_PER_TICK)
}

/// Sets the alarm: it interrupts this processor at `deadline`, or earlier.
pub(crate) fn set_alarm(deadline: Instant) {
    let ticks = deadline.since(now()).as_ns() / NS_PER_TICK + 1;
    // SAFETY: this processor's own SysTick.
    unsafe {
        write_volatile(SYSTICK_CONTROL, 0);
        write_volatile(SYSTICK_RELOAD, ticks.clamp(2, SYSTICK_MAX) as u32);
        write_volatile(SYSTICK_VALUE, 0);
        write_volatile(SYSTICK_CONTROL, SYSTICK_ON);
    }
}

/// Handler of SysTick. Switches SysTick off, because one interrupt is enough.
pub(crate) extern "C" fn on_alarm() {
    // SAFETY: this processor's own SysTick.
    unsafe { write_volatile(SYSTICK_CONTROL, 0) };
}

const SLICER: usize = 0x5000_1000;

/// Makes timer 1 expire every `ticks` of 50 ns, without an interrupt. The emulator ends a
/// processor's turn whenever a timer expires, so turns have this length. Each length gives a
/// different schedule.
pub fn set_turns(ticks: u32) {
    // SAFETY: timer 1's registers, which no other code uses.
    unsafe {
        write_volatile((SLICER + 8) as *mut u32, ticks);
        write_volatile((SLICER + 4) as *mut u32, ticks);
        write_volatile(SLICER as *mut u32, 1);
    }
}
