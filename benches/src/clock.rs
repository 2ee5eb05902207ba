//! A clock that two CPUs agree on, cheap enough to stamp every message.

use std::sync::OnceLock;

/// Ticks of the clock, truncated to 32 bits: differences up to about a second are exact.
#[inline(always)]
pub fn ticks() -> u32 {
    #[cfg(target_arch = "x86_64")]
    {
        // SAFETY: SSE2 and the time stamp counter are part of every x86-64. The fence keeps the
        // counter from being read before the loads that it is to time have completed.
        unsafe {
            core::arch::x86_64::_mm_lfence();
            core::arch::x86_64::_rdtsc() as u32
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        monotonic_ns() as u32
    }
}

/// `CLOCK_MONOTONIC` in nanoseconds.
pub fn monotonic_ns() -> u64 {
    read_ns(libc::CLOCK_MONOTONIC)
}

/// CPU time that the calling thread has used, user and system, in nanoseconds.
pub fn cpu_ns() -> u64 {
    read_ns(libc::CLOCK_THREAD_CPUTIME_ID)
}

fn read_ns(clock: libc::clockid_t) -> u64 {
    let mut now = libc::timespec {
        tv_sec: 0,
        tv_nsec: 0,
    };
    // SAFETY: `now` is a valid place for the result; the clocks above always exist.
    unsafe { libc::clock_gettime(clock, &mut now) };
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// Picoseconds of one tick, measured against `CLOCK_MONOTONIC` over 50 ms, once.
pub fn ps_per_tick() -> f64 {
    static MEASURED: OnceLock<f64> = OnceLock::new();
    *MEASURED.get_or_init(|| {
        let (from_ns, from) = (monotonic_ns(), ticks());
        while monotonic_ns() - from_ns < 50_000_000 {
            core::hint::spin_loop();
        }
        let (to_ns, to) = (monotonic_ns(), ticks());
        (to_ns - from_ns) as f64 * 1000.0 / f64::from(to.wrapping_sub(from))
    })
}

/// A span of ticks in picoseconds.
pub fn to_ps(ticks: u32) -> u64 {
    (f64::from(ticks) * ps_per_tick()) as u64
}

/// So many nanoseconds as ticks; at most what 32 bits hold, about a second.
pub fn from_ns(ns: u64) -> u32 {
    (ns as f64 * 1000.0 / ps_per_tick()) as u32
}
