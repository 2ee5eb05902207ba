//! The servo of a time base: a least-squares line through noisy samples that forgets old ones.

use tandem_board::{Duration, Instant};

/// Fraction bits of the servo's times (2^-40 ns) and of rates (2^-40, about 0.9e-12).
pub(crate) const FRACTION: u32 = 40;

/// Fraction bits of the gains of offset and rate: on a small target 128-bit products are cheap, and
/// 128-bit quotients are not. Two samples have the largest gain, 2^-0 a period.
const GAIN_BITS: u32 = 32;
const RATE_GAIN_BITS: u32 = 60;

/// Deviations that judge the next sample. Their median stands while at most three of them are wild.
const RECENT: usize = 8;

/// A sample is an outlier beyond this many medians of recent deviations: 4 sigma of Gaussian noise.
const OUTLIER_MEDIANS: u64 = 6;

/// Samples after which the rate is worth more than the bound of the crystals.
const LEARNED: u32 = 8;

/// How a servo filters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ServoConfig {
    /// Time from sample to sample. More frequent samples do not widen the bandwidth of the rate.
    pub period: Duration,
    /// Samples that the line remembers, at least 2. The servo's bandwidth (-3 dB) is
    /// 0.86 / (`memory` * `period`), and white noise of the stamps is reduced to about
    /// 1.65 / sqrt(`memory`).
    pub memory: u16,
    /// How far a sample may be off while the noise of the link is not known yet.
    pub noise: Duration,
    /// Largest rate between both clocks, ppb, at most 900,000: the tolerances of both crystals.
    /// A learned rate never exceeds it.
    pub rate_limit_ppb: u32,
    /// How much the rate may have changed since it was learned, ppb: the crystals' temperature.
    pub wander_ppb: u32,
}

/// A line through samples (time over local time), and what the samples scatter around it.
///
/// The gains are those of a least-squares line through all samples so far, until there are
/// `memory` samples; from then on they stay. So the start converges as fast as the noise allows,
/// and afterwards the servo is a loop of second order with a damping of 0.82.
/// Source of the gains: Brookner, *Tracking and Kalman Filtering Made Easy*, 1998, chapter 1.
#[derive(Clone, Debug)]
pub(crate) struct Servo {
    config: ServoConfig,
    /// Where the newest sample that was followed is.
    local: Instant,
    /// The line at `local`, 2^-40 ns.
    time: i128,
    /// The slope of the line less 1, 2^-40.
    rate: i64,
    /// Samples in the line, at most `memory`.
    count: u32,
    /// Local time that they cover, ns.
    span: u64,
    /// How far the last samples were off, ns.
    recent: [u64; RECENT],
}

impl Servo {
    /// Returns a line through one point, with the local clock's rate. `count`: 1 if the point is a
    /// sample, 0 if it is a guess.
    pub(crate) fn new(config: ServoConfig, local: Instant, global_ns: u64, count: u32) -> Self {
        Self {
            config,
            local,
            time: i128::from(global_ns) << FRACTION,
            rate: 0,
            count,
            span: 0,
            recent: [config.noise.as_ns(); RECENT],
        }
    }

    /// Returns the line at a local time, 2^-40 ns; also outside of the scale. One copy, as of all
    /// that has 128 bits: they are large code.
    #[inline(never)]
    pub(crate) fn time_at(&self, local: Instant) -> i128 {
        let span = i128::from(local.as_ns()) - i128::from(self.local.as_ns());
        self.time + (span << FRACTION) + span * i128::from(self.rate)
    }

    /// Returns how much a sample lies above the line, 2^-40 ns.
    pub(crate) fn deviation(&self, local: Instant, global_ns: u64) -> i128 {
        (i128::from(global_ns) << FRACTION) - self.time_at(local)
    }

    /// Bends the line towards a sample with this deviation.
    pub(crate) fn follow(&mut self, local: Instant, deviation: i128) {
        let memory = u32::from(self.config.memory).max(2);
        let passed = local.since(self.local).as_ns();
        if self.count == memory {
            self.span -= divided(self.span, memory.into());
        }
        self.span = self.span.saturating_add(passed);
        self.count = self.count.saturating_add(1).min(memory);
        let n = u64::from(self.count);
        let gain = divided((4 * n - 2) << GAIN_BITS, n * (n + 1));
        self.time = self.time_at(local) + scaled(deviation, gain);
        if self.count > 1 {
            let period = passed.max(self.config.period.as_ns());
            let gain = divided(divided(6 << RATE_GAIN_BITS, n * (n + 1)), period);
            let limit = i128::from(fine(self.config.rate_limit_ppb));
            let rate =
                i128::from(self.rate) + (scaled(deviation, gain) >> (RATE_GAIN_BITS - GAIN_BITS));
            self.rate = rate.max(-limit).min(limit) as i64;
        }
        self.local = local;
    }

    /// Moves the line onto a sample with this deviation. The rate stays.
    pub(crate) fn step(&mut self, local: Instant, deviation: i128) {
        self.time = self.time_at(local) + deviation;
        self.local = local;
        self.count = self.count.max(1);
    }

    /// Learns the noise from a sample, followed or not.
    pub(crate) fn note(&mut self, deviation_ns: u64) {
        let [a, b, c, d, e, f, g, _] = self.recent;
        self.recent = [deviation_ns, a, b, c, d, e, f, g];
    }

    /// Returns from which deviation on a sample is an outlier, ns. `error`: of the sample.
    #[inline(never)]
    pub(crate) fn limit(&self, local: Instant, error: Duration) -> u64 {
        let recent = &self.recent;
        let more_than_half = |v: &u64| recent.iter().filter(|w| *w <= v).count() > RECENT / 2;
        let median = recent.iter().copied().filter(more_than_half).min();
        let noise = median.unwrap_or(u64::MAX).saturating_mul(OUTLIER_MEDIANS);
        let drift = grown(
            self.rate_error(),
            local.as_ns().abs_diff(self.local.as_ns()),
        );
        noise.saturating_add(error.as_ns()).saturating_add(drift)
    }

    /// Returns how far the recent samples were off at most, ns.
    pub(crate) fn noise(&self) -> u64 {
        self.recent.iter().copied().max().unwrap_or(u64::MAX)
    }

    /// Returns how wrong the rate may be, 2^-40: eight sigma of a least-squares slope (one sigma is
    /// the largest recent deviation), and what the crystals may have changed. Four would do if no
    /// samples were lost and no older one was farther off.
    pub(crate) fn rate_error(&self) -> u64 {
        // The learned rate and the true one are both within the limit.
        let worst = self.worst_rate();
        if self.count < LEARNED {
            return worst;
        }
        // In 2^20 ns, so that both fit 64 bits.
        let scatter = (self.noise().min(1 << 32) * 28) << (FRACTION - 20);
        let span = self.span.saturating_mul(self.count.isqrt().into()) >> 20;
        let learned = scatter.checked_div(span).unwrap_or(worst);
        worst.min(learned.saturating_add(fine(self.config.wander_ppb)))
    }

    /// Returns by how much two rates within the limit may differ, 2^-40.
    pub(crate) const fn worst_rate(&self) -> u64 {
        2 * fine(self.config.rate_limit_ppb)
    }

    /// Returns how far both clocks may drift apart in a span at most, ns.
    pub(crate) fn worst_drift(&self, span: Duration) -> u64 {
        grown(self.worst_rate(), span.as_ns())
    }

    /// Returns the local time of the newest sample that was followed.
    pub(crate) const fn local(&self) -> Instant {
        self.local
    }

    /// Returns the slope of the line less 1, 2^-40.
    pub(crate) const fn rate(&self) -> i64 {
        self.rate
    }
}

/// Returns a rate in units of 2^-40; at most 900 ppm, so that it fits an `i32`.
const fn fine(ppb: u32) -> u64 {
    let ppb = if ppb > 900_000 { 900_000 } else { ppb };
    ((ppb as u64) << FRACTION) / 1_000_000_000
}

/// Returns what a rate (2^-40) makes of a span, ns.
#[inline(never)]
pub(crate) fn grown(rate: u64, span_ns: u64) -> u64 {
    u64::try_from((u128::from(rate) * u128::from(span_ns)) >> FRACTION).unwrap_or(u64::MAX)
}

/// Divides; a division by zero gives 0.
fn divided(a: u64, b: u64) -> u64 {
    a.checked_div(b).unwrap_or(0)
}

#[inline(never)]
fn scaled(deviation: i128, gain: u64) -> i128 {
    deviation.saturating_mul(gain.into()) >> GAIN_BITS
}
