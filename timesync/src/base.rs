//! The time base: turns samples of another clock into a time that never goes back (S-5).

use tandem_board::{Duration, Instant};

use crate::scale::{GlobalTime, Sample, Scale};
use crate::servo::{FRACTION, Servo, ServoConfig, grown};

/// A small correction is spread over time: shown time runs faster or slower by 2^-11 (488 ppm).
/// Steeper would disturb what is measured with it; at this slope 1 ms takes 2.05 s.
const SLEW_SHIFT: u32 = 11;

/// Global times beyond 2^63 ns (the year 2262) are refused: the time after them must fit its type.
const LAST_NS: u64 = i64::MAX as u64;

/// How much a reader may lag behind what it has returned without telling, ns: it may have read 1 ms
/// ahead of a conversion that is 0.14 % slower than the last one.
const UNTOLD_LAG_NS: i64 = 2_000;

/// Length of a [`Conversion`] in shared memory, words.
pub const CONVERSION_WORDS: usize = 12;

/// The limits of a time base.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BaseConfig {
    /// How samples are filtered.
    pub servo: ServoConfig,
    /// Without a sample that is followed for this long, the time is in holdover.
    pub timeout: Duration,
    /// A deviation beyond this is a leap: it is told, then jumped. Smaller ones are slewed.
    pub leap: Duration,
    /// Samples in a row that agree on a leap, a step or a beginning before it is followed, at least
    /// 2.
    pub leap_samples: u8,
}

impl BaseConfig {
    /// gPTP: Sync every 125 ms (IEEE 802.1AS). 64 samples are 8 s, a bandwidth of 0.11 Hz: crystals
    /// change their rate more slowly, and noise is reduced to a fifth. Noise: software stamps.
    pub const GPTP: Self = Self::every_ms(125, 10);
    /// A pulse every 125 ms, its edge stamped in an interrupt.
    pub const PULSE: Self = Self::every_ms(125, 10);
    /// CAN SYNC every 100 ms: 0.13 Hz. A frame's stamp waits for an interrupt on both sides.
    pub const CAN: Self = Self::every_ms(100, 20);

    /// Four periods until the time-out: one more than two wild samples and a good one take. A leap
    /// is a tenth of a control cycle of 10 ms. Three samples: two wild ones never move the time.
    const fn every_ms(period: u64, noise_us: u64) -> Self {
        Self {
            servo: ServoConfig {
                period: Duration::from_ms(period),
                memory: 64,
                noise: Duration::from_us(noise_us),
                // Each crystal within 100 ppm, as IEEE 802.1AS requires.
                rate_limit_ppb: 200_000,
                // A crystal of 0.05 ppm a kelvin that warms by 4 K.
                wander_ppb: 200,
            },
            timeout: Duration::from_ms(4 * period),
            leap: Duration::from_ms(1),
            leap_samples: 3,
        }
    }
}

/// What a time is worth: bits with the names and values of AUTOSAR's StbM, and [`Self::HOLDOVER`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TimeStatus(u8);

impl TimeStatus {
    /// A master is expected to send, and nothing of it was followed for the time-out. Or the local
    /// clock is so far off that the scale has no time for it.
    pub const TIMEOUT: Self = Self(0x01);
    /// The master follows a gateway, not the origin of the time itself.
    pub const SYNC_TO_GATEWAY: Self = Self(0x04);
    /// The time was set at least once since the start. A conversion always has it.
    pub const GLOBAL_TIME_BASE: Self = Self(0x08);
    /// The master's time leapt ahead: the time will do so, or has just done so.
    pub const TIMELEAP_FUTURE: Self = Self(0x10);
    /// The master's time leapt back: the time will do so, or has just done so, or stands still
    /// until it reaches again what its reader has seen.
    pub const TIMELEAP_PAST: Self = Self(0x20);
    /// The time continues with the rate that was learned: after a time-out, or because this system
    /// became the master itself.
    pub const HOLDOVER: Self = Self(0x80);

    const ALL: u8 = 0xBD;

    /// Returns whether all bits of `other` are set.
    #[must_use]
    pub const fn has(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// Returns whether the time follows a living master, or is its own, and does not leap.
    #[must_use]
    pub const fn is_synchronised(self) -> bool {
        self.0 & !Self::SYNC_TO_GATEWAY.0 == Self::GLOBAL_TIME_BASE.0
    }

    /// Returns the bits, for records and shared memory.
    #[must_use]
    pub const fn bits(self) -> u8 {
        self.0
    }

    /// Adds the bits of `other` if `condition` holds.
    const fn with(self, other: Self, condition: bool) -> Self {
        if condition {
            Self(self.0 | other.0)
        } else {
            self
        }
    }
}

/// What a master says of its own time. The default is the origin of a time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MasterQuality {
    /// It follows a gateway, not the origin of the time.
    pub to_gateway: bool,
    /// Largest error of its time; zero at the origin.
    pub error: Duration,
}

/// What became of a sample. A number is by how much it says that it is later than shown, ns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Heard {
    /// There is no time yet: it begins when several samples in a row agree.
    Unconfirmed,
    /// The last of the first samples that agree: they set the time.
    First,
    /// The time follows it.
    Followed,
    /// Too far off: it did not move the time.
    Outlier,
    /// A small step that several samples agree on: the time is slewed there.
    Stepped(i64),
    /// Samples agree on a leap. The status tells it; the time has not moved.
    LeapTold(i64),
    /// The time has leapt.
    LeapFollowed(i64),
    /// Not later than the last one, later than now, or beyond the year 2262.
    Refused,
}

/// Whose time is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Source {
    /// The local clock is the time.
    Own,
    /// A master's time that this system continues.
    Continued,
    /// A master.
    Master,
}

/// Turns samples into time. It has none until several samples agree, or [`TimeBase::set_free`].
///
/// It needs no poll: a [`Conversion`] finds out by itself that its samples have stopped.
#[derive(Clone, Debug)]
pub struct TimeBase<S: Scale> {
    config: BaseConfig,
    servo: Option<Servo>,
    conversion: Option<Conversion<S>>,
    source: Source,
    /// What the newest sample that was followed is worth, its own error included.
    master: MasterQuality,
    /// The newest time that this base was told.
    now: Instant,
    /// Local time of the newest sample, followed or not.
    heard: Option<Instant>,
    /// How much later than the line that sample was, ns.
    offset_ns: i64,
    /// Outliers in a row that agree.
    run: u8,
    /// The leap that the status tells.
    told: TimeStatus,
    /// Samples until it no longer does.
    telling: u8,
    /// Leaps so far, modulo 256.
    leaps: u8,
    /// After a time-out: how far off the time may be if the first sample was wild, ns, until so
    /// many more were followed.
    doubt: (u64, u8),
    /// The local clock went back, and no sample has come since.
    is_lost: bool,
}

impl<S: Scale> TimeBase<S> {
    /// Returns a base without a time.
    #[must_use]
    pub fn new(config: BaseConfig) -> Self {
        Self {
            config,
            servo: None,
            conversion: None,
            source: Source::Own,
            master: MasterQuality::default(),
            now: Instant::ORIGIN,
            heard: None,
            offset_ns: 0,
            run: 0,
            told: TimeStatus(0),
            telling: 0,
            leaps: 0,
            doubt: (0, 0),
            is_lost: false,
        }
    }

    /// Looks at the local clock, as often as its owner does. If it went back, the status is a
    /// time-out until a sample is followed.
    pub fn look(&mut self, now: Instant) {
        if self.look_at_clock(now) && self.conversion.is_some() {
            self.is_lost = true;
            self.show(now, true);
        }
    }

    /// Takes a sample. `now`: the local time at which it is complete, not before its stamp. Publish
    /// [`TimeBase::conversion`] afterwards: it begins at `now`.
    pub fn on_sample(&mut self, now: Instant, sample: Sample<S>, master: MasterQuality) -> Heard {
        let back = self.look_at_clock(now);
        let heard = self.judge(now, sample, master);
        let moves = !matches!(heard, Heard::Refused | Heard::Unconfirmed);
        if moves || back && self.conversion.is_some() {
            self.show(now, back || matches!(heard, Heard::LeapFollowed(_)));
        }
        heard
    }

    /// Becomes its own master: expects no samples, and continues the time that it has; if it has
    /// none, the local clock is the time from now on, beginning with `start`. A sample ends it.
    pub fn set_free(&mut self, now: Instant, start: GlobalTime<S>) {
        let back = self.look_at_clock(now);
        if self.conversion.is_none() {
            let start = start.as_ns().min(LAST_NS);
            self.servo = Some(Servo::new(self.config.servo, now, start, 0));
        }
        if self.source == Source::Master {
            self.source = Source::Continued;
        }
        (self.run, self.told) = (0, TimeStatus(0));
        self.show(now, back);
    }

    /// Returns how local time becomes global time; `None` while there is no time.
    #[must_use]
    pub const fn conversion(&self) -> Option<Conversion<S>> {
        self.conversion
    }

    /// Returns how much later the newest sample was than expected, ns.
    #[must_use]
    pub const fn offset_ns(&self) -> i64 {
        self.offset_ns
    }

    /// Returns whether the local clock went back. Then the order of stamps says nothing.
    fn look_at_clock(&mut self, now: Instant) -> bool {
        let back = now < self.now;
        if back {
            self.heard = None;
        }
        self.now = now;
        back
    }

    fn judge(&mut self, now: Instant, sample: Sample<S>, master: MasterQuality) -> Heard {
        let (local, global_ns) = (sample.local, sample.global.as_ns());
        let is_old = self.heard.is_some_and(|heard| local <= heard);
        if is_old || local > now || global_ns > LAST_NS {
            return Heard::Refused;
        }
        let passed = local.since(self.heard.replace(local).unwrap_or(local));
        let alone = Servo::new(self.config.servo, local, global_ns, 1);
        let servo = self.servo.get_or_insert_with(|| alone.clone());
        let deviation = servo.deviation(local, global_ns);
        let by_ns = nanoseconds(deviation);
        let last_ns = core::mem::replace(&mut self.offset_ns, by_ns);
        let limit = servo.limit(local, sample.error);
        let is_leap = by_ns.unsigned_abs() > self.config.leap.as_ns();
        if !is_leap {
            servo.note(by_ns.unsigned_abs());
        }
        let is_near = !is_leap && by_ns.unsigned_abs() <= limit;
        if self.conversion.is_none() {
            if is_near && self.run > 0 && passed <= self.config.timeout {
                servo.follow(local, deviation);
                self.run = self.run.saturating_add(1);
            } else {
                (*servo, self.run) = (alone, 1);
            }
            if self.run < self.config.leap_samples.max(2) {
                return Heard::Unconfirmed;
            }
            return self.accept(sample, master, Heard::First);
        }
        if is_near {
            // After a time-out the newest sample knows more than the line.
            if local.since(servo.local()) > self.config.timeout {
                let before = self.conversion.map_or(0, |it| it.error_at(now).as_ns());
                let most = before.saturating_add(by_ns.unsigned_abs());
                self.doubt = (most, self.config.leap_samples.max(2));
                servo.step(local, deviation);
            } else {
                servo.follow(local, deviation);
            }
            let (most, left) = self.doubt;
            self.doubt = (most, left.saturating_sub(1));
            self.telling = self.telling.saturating_sub(1);
            if self.telling == 0 {
                self.told = TimeStatus(0);
            }
            return self.accept(sample, master, Heard::Followed);
        }
        let tolerance = limit.saturating_add(servo.worst_drift(passed));
        let agrees = by_ns.abs_diff(last_ns) <= tolerance;
        let run = if agrees { self.run } else { 0 };
        self.run = run.saturating_add(1);
        // Samples that drift away agree on a step before they agree on a leap.
        let is_told = !is_leap || self.told != TimeStatus(0);
        if is_leap && self.run > 1 {
            let is_back = by_ns < 0;
            let told = TimeStatus(0).with(TimeStatus::TIMELEAP_PAST, is_back);
            self.told = told.with(TimeStatus::TIMELEAP_FUTURE, !is_back);
        }
        if self.run >= self.config.leap_samples.max(2) && is_told {
            servo.step(local, deviation);
            self.doubt = (0, 0);
            if !is_leap {
                return self.accept(sample, master, Heard::Stepped(by_ns));
            }
            self.telling = self.config.leap_samples;
            return self.accept(sample, master, Heard::LeapFollowed(by_ns));
        }
        if is_leap && self.run > 1 {
            return Heard::LeapTold(by_ns);
        }
        Heard::Outlier
    }

    fn accept(&mut self, sample: Sample<S>, master: MasterQuality, heard: Heard) -> Heard {
        let error = sample.error + master.error;
        (self.run, self.source, self.is_lost) = (0, Source::Master, false);
        self.master = MasterQuality { error, ..master };
        heard
    }

    /// Makes the conversion from `now` on. It continues the last one, unless that leaps.
    fn show(&mut self, now: Instant, leaps: bool) {
        let Some(servo) = &self.servo else { return };
        self.leaps = self.leaps.wrapping_add(u8::from(leaps));
        // A local clock that jumped may be where the scale has no time: begin at the last sample.
        let outside = u64::try_from(servo.time_at(now) >> FRACTION).is_err();
        let now = if outside { servo.local() } else { now };
        let global = on_scale(servo.time_at(now) >> FRACTION);
        let shown = match &self.conversion {
            Some(last) if !leaps => last.at(now),
            _ => global,
        };
        // The line is at most as far from the truth as its samples are from it, twice for safety,
        // and whole nanoseconds are shown.
        let noise = servo.noise().saturating_mul(2).saturating_add(2);
        let span = now.as_ns().abs_diff(servo.local().as_ns());
        // A master that follows no living origin may have any rate: its error grows too.
        let more = match self.master.to_gateway {
            true => servo.worst_rate(),
            false => 0,
        };
        let growth = servo.rate_error() + more;
        let grown = noise.saturating_add(grown(growth, span));
        let error = grown.saturating_add(self.master.error.as_ns());
        let (most, left) = self.doubt;
        let error = error.max(if left > 0 { most } else { 0 });
        let fresh = match self.is_lost {
            true => Instant::ORIGIN,
            false => servo.local() + self.config.timeout,
        };
        let gateway = TimeStatus(0).with(TimeStatus::SYNC_TO_GATEWAY, self.master.to_gateway);
        let (error, growth, fresh_until, status) = match self.source {
            Source::Own => (0, 0, Instant::NEVER, TimeStatus(0)),
            Source::Continued => (error, growth, Instant::NEVER, TimeStatus::HOLDOVER),
            Source::Master => (error, growth, fresh, gateway),
        };
        let status = status.with(TimeStatus::GLOBAL_TIME_BASE, true);
        self.conversion = Some(Conversion {
            local: now,
            global,
            slew: shown.after(global),
            rate: servo.rate() as i32,
            error_ns: u32::try_from(error).unwrap_or(u32::MAX),
            growth: growth as u32,
            fresh_until,
            status: status.with(self.told, true),
            leaps: self.leaps,
        });
    }
}

/// How local time becomes global time, from one sample to the next: a snapshot that may be copied
/// to other cores and shared memory.
///
/// From its begin on it never goes back: a line with the learned rate, before which a correction is
/// slewed in. It also shows times before its begin, by the same rate, for stamps taken earlier.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Conversion<S: Scale> {
    local: Instant,
    /// The line at `local`.
    global: GlobalTime<S>,
    /// How much later than the line the shown time begins, ns.
    slew: i64,
    /// Slope of the line less 1, 2^-40: within 0.2 %.
    rate: i32,
    error_ns: u32,
    /// Growth of the error, 2^-40.
    growth: u32,
    fresh_until: Instant,
    status: TimeStatus,
    /// Leaps so far, modulo 256: a reader that skips conversions finds them.
    leaps: u8,
}

impl<S: Scale> Conversion<S> {
    /// Returns the global time at a local time; saturates at the ends of the scale.
    #[must_use]
    pub fn at(&self, local: Instant) -> GlobalTime<S> {
        on_scale(self.line(local))
    }

    /// Nanoseconds since the origin, also outside of the scale. One copy: 128 bits are large code.
    #[inline(never)]
    fn line(&self, local: Instant) -> i128 {
        let span = i128::from(local.as_ns()) - i128::from(self.local.as_ns());
        let slew = i128::from(self.slew);
        // What of it is slewed in at `local`, 2^-11 ns.
        let slewed = span.max(0).min(slew.abs() << SLEW_SHIFT) * slew.signum();
        // One sum is rounded, not two: else the time could go back by 1 ns.
        let fine = span * i128::from(self.rate) - (slewed << (FRACTION - SLEW_SHIFT));
        i128::from(self.global.as_ns()) + slew + span + (fine >> FRACTION)
    }

    /// Returns the first local time at which this conversion shows `global` or later, for a release
    /// that is due then. [`Instant::NEVER`] if it never does.
    #[must_use]
    pub fn local_of(&self, global: GlobalTime<S>) -> Instant {
        let moved = |at: Instant, ns| Instant::from_ns(at.as_ns().saturating_add_signed(ns));
        let mut near = self.local;
        // The slope is within 0.3 % of 1: each round leaves 0.3 % of the distance, 2^64 ns need 9.
        for _ in 0..12 {
            near = moved(near, global.after(self.at(near)));
        }
        // A slope below 1 shows a time twice at most, one above 1 skips one at most.
        let mut candidates = (-2..=2).map(|ns| moved(near, ns));
        candidates
            .find(|at| self.at(*at).as_ns() >= global.as_ns())
            .unwrap_or(Instant::NEVER)
    }

    /// Returns the status at a local time, which may be later than all samples.
    #[must_use]
    pub fn status_at(&self, local: Instant) -> TimeStatus {
        let outside = u64::try_from(self.line(local)).is_err();
        let late = outside || local > self.fresh_until;
        let status = self.status.with(TimeStatus::TIMEOUT, late);
        status.with(TimeStatus::HOLDOVER, late)
    }

    /// Returns how far from the master's time [`Conversion::at`] may be. Zero for an own clock that
    /// is the time. A master that lies is not in it: no receiver can see a constant asymmetry.
    #[must_use]
    pub fn error_at(&self, local: Instant) -> Duration {
        let span = local.as_ns().abs_diff(self.local.as_ns());
        let slewed = local.since(self.local).as_ns() >> SLEW_SHIFT;
        let slew = self.slew.unsigned_abs().saturating_sub(slewed);
        let grown = grown(self.growth.into(), span).saturating_add(slew);
        Duration::from_ns(grown.saturating_add(self.error_ns.into()))
    }

    /// Returns time, status and error at a local time. A [`TimeReader`] also never goes back from
    /// one conversion to the next.
    #[must_use]
    pub fn reading(&self, local: Instant) -> TimeReading<S> {
        TimeReading {
            time: self.at(local),
            error: self.error_at(local),
            status: self.status_at(local),
        }
    }

    /// Returns the learned rate: how much faster than the local clock the master's runs, ppb.
    #[must_use]
    pub const fn rate_ppb(&self) -> i32 {
        ((self.rate as i64 * 1_000_000_000) >> FRACTION) as i32
    }

    /// Encodes the conversion for shared memory.
    #[must_use]
    pub const fn to_words(&self) -> [u32; CONVERSION_WORDS] {
        let [la, lb] = self.local.to_words();
        let [ga, gb] = Instant::from_ns(self.global.as_ns()).to_words();
        let [sa, sb] = Instant::from_ns(self.slew.cast_unsigned()).to_words();
        let [fa, fb] = self.fresh_until.to_words();
        let rate = self.rate.cast_unsigned();
        let state = (self.status.bits() as u32) | (self.leaps as u32) << 8;
        let (error, growth) = (self.error_ns, self.growth);
        [la, lb, ga, gb, sa, sb, fa, fb, rate, error, growth, state]
    }

    /// The inverse of [`Conversion::to_words`]. `None` if no conversion has this status. Any other
    /// words are safe to use.
    #[must_use]
    pub const fn from_words(words: [u32; CONVERSION_WORDS]) -> Option<Self> {
        let [la, lb, ga, gb, sa, sb, fa, fb, ..] = words;
        let [.., rate, error_ns, growth, state] = words;
        let status = TimeStatus(state as u8);
        let unknown = status.0 & !TimeStatus::ALL != 0 || state >> 16 != 0;
        if unknown || !status.has(TimeStatus::GLOBAL_TIME_BASE) {
            return None;
        }
        Some(Self {
            local: Instant::from_words([la, lb]),
            global: GlobalTime::from_ns(Instant::from_words([ga, gb]).as_ns()),
            slew: Instant::from_words([sa, sb]).as_ns().cast_signed(),
            rate: rate.cast_signed(),
            error_ns,
            growth,
            fresh_until: Instant::from_words([fa, fb]),
            status,
            leaps: (state >> 8) as u8,
        })
    }
}

/// A time with what it is worth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimeReading<S: Scale> {
    /// The global time.
    pub time: GlobalTime<S>,
    /// How far from the master's time it may be.
    pub error: Duration,
    /// What is known of it.
    pub status: TimeStatus,
}

/// One reader's view of the time: it never goes back, and each leap and stop of it is told.
#[derive(Clone, Copy, Debug)]
pub struct TimeReader<S: Scale> {
    /// The last reading: local time, time, leaps so far, and whether the time was held.
    last: Option<(Instant, GlobalTime<S>, u8, bool)>,
}

impl<S: Scale> TimeReader<S> {
    /// Returns the time at `local` by the newest conversion. While that shows less than this reader
    /// has already returned, the time stands still and the status has TIMELEAP_PAST.
    pub fn read(&mut self, conversion: &Conversion<S>, local: Instant) -> TimeReading<S> {
        let mut reading = conversion.reading(local);
        let mut held = false;
        if let Some((last_local, last_time, leaps, was_held)) = self.last {
            let moved = reading.time.after(last_time);
            let passed = local.since(last_local).as_ns().min(LAST_NS).cast_signed();
            held = moved < -UNTOLD_LAG_NS;
            let leaps = leaps != conversion.leaps;
            let ahead = leaps && moved >= passed;
            let back = held || was_held || (leaps && !ahead);
            let status = reading.status.with(TimeStatus::TIMELEAP_FUTURE, ahead);
            reading.status = status.with(TimeStatus::TIMELEAP_PAST, back);
            if moved < 0 {
                reading.time = last_time;
                reading.error = reading.error + Duration::from_ns(moved.unsigned_abs());
            }
        }
        self.last = Some((local, reading.time, conversion.leaps, held));
        reading
    }
}

impl<S: Scale> Default for TimeReader<S> {
    fn default() -> Self {
        Self { last: None }
    }
}

fn on_scale<S: Scale>(ns: i128) -> GlobalTime<S> {
    GlobalTime::from_ns(ns.max(0).min(u64::MAX.into()) as u64)
}

/// Returns whole nanoseconds of 2^-40 ns; saturates.
fn nanoseconds(fine: i128) -> i64 {
    (fine >> FRACTION).max(i64::MIN.into()).min(i64::MAX.into()) as i64
}

#[cfg(test)]
mod tests;
