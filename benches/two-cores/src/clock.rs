//! A clock that two CPUs agree on, cheap enough to stamp every message.

use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, Timespec, clock_gettime};
use std::sync::OnceLock;

/// Ticks of the clock, truncated to 32 bits: differences up to about a second are exact.
#[inline(always)]
pub fn ticks() -> u32 {
    #[cfg(target_arch = "x86_64")]
    {
        // SAFETY: SSE2 and the time stamp counter are part of every x86-64. The fence prevents a
        // read of the counter before the timed loads have completed.
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
    read_ns(ClockId::Monotonic)
}

/// CPU time that the calling thread has used, user and system, in nanoseconds.
pub fn cpu_ns() -> u64 {
    read_ns(ClockId::ThreadCPUTime)
}

fn read_ns(clock: ClockId) -> u64 {
    let now = clock_gettime(clock);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// Sleeps until this time of `CLOCK_MONOTONIC`, or until a signal.
pub fn sleep_until(ns: u64) {
    let until = Timespec {
        tv_sec: (ns / 1_000_000_000) as i64,
        tv_nsec: (ns % 1_000_000_000) as i64,
    };
    let _ = clock_nanosleep_absolute(rustix::thread::ClockId::Monotonic, &until);
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

/// Returns the step of the clock's readings, in ticks: on many processors the counter goes up by
/// more than one at a time, every 10 ns or so.
pub fn step_ticks() -> u32 {
    static MEASURED: OnceLock<u32> = OnceLock::new();
    *MEASURED.get_or_init(|| {
        let mut last = ticks();
        let steps = (0..10_000).map(|_| {
            let now = ticks();
            now.wrapping_sub(std::mem::replace(&mut last, now))
        });
        steps.fold(0, gcd).max(1)
    })
}

fn gcd(a: u32, b: u32) -> u32 {
    if b == 0 { a } else { gcd(b, a % b) }
}

/// Converts a span of ticks, the `n`-th of many, to picoseconds.
///
/// A reading means any time within one step of the clock. So the spans are spread evenly over a
/// step (by the golden ratio, not at random): a percentile then has the value that a finer clock
/// would give, and does not jump by whole steps. The mean does not change.
pub fn to_ps_spread(n: usize, ticks: u32) -> u64 {
    const GOLDEN: f64 = 0.618_033_988_749_895;
    let within = (n as f64 * GOLDEN).fract() - 0.5;
    let ticks = f64::from(ticks) + within * f64::from(step_ticks());
    (ticks.max(0.0) * ps_per_tick()) as u64
}

/// Converts a span of ticks to picoseconds.
pub fn to_ps(ticks: u32) -> u64 {
    (f64::from(ticks) * ps_per_tick()) as u64
}

/// Converts nanoseconds to ticks; limited to 32 bits, about a second.
pub fn from_ns(ns: u64) -> u32 {
    (ns as f64 * 1000.0 / ps_per_tick()) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spread_spans_keep_their_mean_and_stay_within_a_step() {
        let step = to_ps(step_ticks()) as f64;
        let span = 1_000_000;
        let exact = to_ps(span) as f64;
        let spread: Vec<f64> = (0..1000).map(|n| to_ps_spread(n, span) as f64).collect();
        assert!(
            spread
                .iter()
                .all(|ps| (ps - exact).abs() <= step / 2.0 + 1.0)
        );
        let mean = spread.iter().sum::<f64>() / 1000.0;
        assert!(
            (mean - exact).abs() < step / 50.0 + 1.0,
            "{mean} for {exact}"
        );
    }

    #[test]
    fn the_greatest_common_divisor_is_one() {
        assert_eq!([52, 78, 26].into_iter().fold(0, gcd), 26);
        assert_eq!([52, 78, 27].into_iter().fold(0, gcd), 1);
    }
}
