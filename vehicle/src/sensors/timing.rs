//! The time of each sensor: its clock, the global time that it hears over CAN, and its delay.

use std::fmt;
use std::str::FromStr;

use tandem_board::{Instant, SystemId};
use tandem_bus::{SensorId, TimeStateCode};
use tandem_timesync::{Arbitrary, BaseConfig, CanTimeCrc, CanTimeSlave, MasterQuality, TimeBase};

use super::disturbance::{name_of, named};
use super::{Noise, STREAMS_OF_TIMING, Stamp};

/// How a sensor's time differs from the vehicle's: written as `radar-front:offset:5ms`,
/// `all:rate:100ppm`, `all:drift:0.5ppm/s`, `camera-front:jump:-50ms@10s`, `all:delay:20ms` or
/// `all:jitter:5ms`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SensorTiming {
    /// The sensor; `None` for all.
    pub sensor: Option<SensorId>,
    /// What differs.
    pub what: TimingError,
}

/// A property of a sensor's clock, or of its way to the bus.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TimingError {
    /// The clock is ahead of the vehicle's, ms. It never shows a time before 0.
    OffsetMs(f64),
    /// The clock runs too fast, ppm.
    RatePpm(f64),
    /// The clock's rate grows, ppm/s.
    DriftPpmPerS(f64),
    /// The clock leaps ahead by `by_ms` at the scenario time `at_s`, s.
    Jump {
        /// Scenario time, s.
        at_s: f64,
        /// ms
        by_ms: f64,
    },
    /// Constant time from a measurement to its first frame, ms; a tick of the world is 1 ms.
    DelayMs(f64),
    /// Longest additional time, ms: each is as likely as any other.
    JitterMs(f64),
}

/// The text is not a [`SensorTiming`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "write it as radar-front:offset:5ms, all:rate:100ppm, all:drift:0.5ppm/s, \
     camera-front:jump:-50ms@10s, all:delay:20ms or all:jitter:5ms"
)]
pub struct NoSensorTiming;

impl FromStr for SensorTiming {
    type Err = NoSensorTiming;

    fn from_str(text: &str) -> Result<Self, NoSensorTiming> {
        parsed(text).ok_or(NoSensorTiming)
    }
}

/// The largest absolute value of each property.
const MOST_MS: f64 = 10_000_000.0;
const MOST_PPM: f64 = 10_000.0;
const MOST_DELAY_MS: f64 = 10_000.0;

fn parsed(text: &str) -> Option<SensorTiming> {
    let (name, rest) = text.split_once(':')?;
    let (kind, value) = rest.split_once(':')?;
    let sensor = match name {
        "all" => None,
        name => Some(named(name)?),
    };
    let number = |text: &str, unit: &str, most: f64| {
        let number = text.trim_end_matches(unit).parse::<f64>().ok()?;
        (-most..=most).contains(&number).then_some(number)
    };
    let positive = |most| number(value, "ms", most).filter(|ms| *ms >= 0.0);
    let what = match kind {
        "offset" => TimingError::OffsetMs(number(value, "ms", MOST_MS)?),
        "rate" => TimingError::RatePpm(number(value, "ppm", MOST_PPM)?),
        "drift" => TimingError::DriftPpmPerS(number(value, "ppm/s", MOST_PPM)?),
        "jump" => {
            let (by, at) = value.split_once('@')?;
            TimingError::Jump {
                at_s: number(at, "s", MOST_MS)?,
                by_ms: number(by, "ms", MOST_MS)?,
            }
        }
        "delay" => TimingError::DelayMs(positive(MOST_DELAY_MS)?),
        "jitter" => TimingError::JitterMs(positive(MOST_DELAY_MS)?),
        _ => return None,
    };
    Some(SensorTiming { sensor, what })
}

impl fmt::Display for SensorTiming {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = self.sensor.map_or_else(|| "all".to_owned(), name_of);
        match self.what {
            TimingError::OffsetMs(ms) => write!(f, "{name}:offset:{ms}ms"),
            TimingError::RatePpm(ppm) => write!(f, "{name}:rate:{ppm}ppm"),
            TimingError::DriftPpmPerS(ppm) => write!(f, "{name}:drift:{ppm}ppm/s"),
            TimingError::Jump { at_s, by_ms } => write!(f, "{name}:jump:{by_ms}ms@{at_s}s"),
            TimingError::DelayMs(ms) => write!(f, "{name}:delay:{ms}ms"),
            TimingError::JitterMs(ms) => write!(f, "{name}:jitter:{ms}ms"),
        }
    }
}

/// A clock with errors, compared with the vehicle's.
#[derive(Clone, Debug, Default)]
struct Clock {
    offset_ns: f64,
    rate_ppm: f64,
    drift_ppm_per_s: f64,
    /// Scenario time, s, and amount, ns.
    jumps: Vec<(f64, f64)>,
    /// When the clock started, ns on the vehicle's clock: the errors grow from here on.
    start_ns: Option<u64>,
}

impl Clock {
    /// Returns what the clock shows, ns, at `now_ns` on the vehicle's clock and this scenario time.
    fn read(&mut self, now_ns: u64, time_s: f64) -> u64 {
        let since_ns = now_ns.saturating_sub(*self.start_ns.get_or_insert(now_ns)) as f64;
        let ppm = self.rate_ppm + 0.5 * self.drift_ppm_per_s * since_ns * 1e-9;
        let leapt = self.jumps.iter().filter(|(at_s, _)| *at_s <= time_s);
        let leapt_ns: f64 = leapt.map(|(_, by_ns)| by_ns).sum();
        let ahead_ns = self.offset_ns + since_ns * ppm * 1e-6 + leapt_ns;
        now_ns.saturating_add_signed(ahead_ns as i64)
    }
}

/// The time of one sensor.
pub(super) struct Timing {
    clock: Clock,
    /// The sensor follows the driving system's frames of time. S-4
    slave: CanTimeSlave<Arbitrary>,
    base: TimeBase<Arbitrary>,
    delay_ms: f64,
    jitter_ms: f64,
    noise: Noise,
}

impl Timing {
    /// A sensor that shares the vehicle's clock, and sends what it has measured without delay.
    pub(super) fn new(sensor: SensorId, seed: u64) -> Self {
        Self {
            clock: Clock::default(),
            slave: CanTimeSlave::new(CanTimeCrc::Validated),
            base: TimeBase::new(BaseConfig::CAN),
            delay_ms: 0.0,
            jitter_ms: 0.0,
            noise: Noise::new(seed, STREAMS_OF_TIMING + sensor.index() as u64),
        }
    }

    pub(super) fn set(&mut self, what: TimingError) {
        match what {
            TimingError::OffsetMs(ms) => self.clock.offset_ns = ms * 1e6,
            TimingError::RatePpm(ppm) => self.clock.rate_ppm = ppm,
            TimingError::DriftPpmPerS(ppm) => self.clock.drift_ppm_per_s = ppm,
            TimingError::Jump { at_s, by_ms } => self.clock.jumps.push((at_s, by_ms * 1e6)),
            TimingError::DelayMs(ms) => self.delay_ms = ms,
            TimingError::JitterMs(ms) => self.jitter_ms = ms,
        }
    }

    /// Returns what the sensor's clock shows.
    fn read(&mut self, now_ns: u64, time_s: f64) -> Instant {
        Instant::from_ns(self.clock.read(now_ns, time_s))
    }

    /// Takes a frame of time that was on the bus at `at_ns` on the vehicle's clock.
    pub(super) fn on_time_sync(&mut self, from: SystemId, at_ns: u64, time_s: f64, data: &[u8]) {
        let at = self.read(at_ns, time_s);
        if let Ok(Some(heard)) = self.slave.receive(from, at, data) {
            let master = MasterQuality {
                to_gateway: heard.is_to_gateway,
                ..MasterQuality::default()
            };
            let _judged = self.base.on_sample(at, heard.sample, master);
        }
    }

    /// Returns the stamp of a measurement now, and how long its frames wait.
    pub(super) fn stamp(&mut self, now_ns: u64, time_s: f64) -> Stamp {
        let now = self.read(now_ns, time_s);
        let (time_state, ns) = match self.base.conversion() {
            None => (TimeStateCode::OwnClock, now.as_ns()),
            Some(conversion) => {
                let state = match conversion.status_at(now).is_synchronised() {
                    true => TimeStateCode::Global,
                    false => TimeStateCode::Holdover,
                };
                (state, conversion.at(now).as_ns())
            }
        };
        Stamp {
            measured_at: (ns / 1_000) as u32,
            time_state,
            delay_ms: self.delay_ms(),
        }
    }

    /// Returns the delay of the next list, ms.
    fn delay_ms(&mut self) -> u64 {
        let jitter_ms = match self.jitter_ms {
            0.0 => 0.0,
            jitter_ms => jitter_ms * self.noise.uniform(),
        };
        (self.delay_ms + jitter_ms).round() as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND_NS: u64 = 1_000_000_000;

    #[test]
    fn timings_are_written_with_sensor_kind_and_value() {
        for text in [
            "radar-front:offset:-5.5ms",
            "all:rate:100ppm",
            "all:drift:0.5ppm/s",
            "camera-front:jump:-50ms@10s",
            "all:delay:20ms",
            "radar-rear-left:jitter:5ms",
        ] {
            let timing: SensorTiming = text.parse().unwrap();
            assert_eq!(timing.to_string(), text);
        }
        for text in [
            "",
            "all:delay",
            "radar:delay:20ms",
            "all:gone:20ms",
            "all:delay:-1ms",
            "all:delay:10001ms",
            "all:rate:NaN",
            "all:offset:inf",
            "all:jump:50ms",
            "all:jump:50ms@",
            "all:delay:20us",
        ] {
            assert_eq!(text.parse::<SensorTiming>(), Err(NoSensorTiming), "{text}");
        }
    }

    /// A clock with an offset of 5 ms that runs 100 ppm too fast, and by 2 ppm more each second,
    /// and leaps, is ahead by the sum.
    #[test]
    fn the_errors_of_a_clock_add_up() {
        let mut timing = Timing::new(SensorId::RadarFront, 1);
        for what in [
            TimingError::OffsetMs(5.0),
            TimingError::RatePpm(100.0),
            TimingError::DriftPpmPerS(2.0),
            TimingError::Jump {
                at_s: 9.0,
                by_ms: -1_000.0,
            },
        ] {
            timing.set(what);
        }
        let mut ahead_us = |s: u64| {
            let now_ns = (7 + s) * SECOND_NS;
            (timing.read(now_ns, s as f64).as_ns() as i64 - now_ns as i64) / 1_000
        };
        assert_eq!(ahead_us(0), 5_000);
        assert_eq!(ahead_us(8), 5_000 + 800 + 64);
        assert_eq!(ahead_us(10), 5_000 + 1_000 + 100 - 1_000_000);
    }

    #[test]
    fn a_delay_is_constant_plus_jitter() {
        let mut timing = Timing::new(SensorId::RadarFront, 1);
        assert_eq!(timing.delay_ms(), 0);
        timing.set(TimingError::DelayMs(20.0));
        assert_eq!(timing.delay_ms(), 20);
        timing.set(TimingError::JitterMs(6.0));
        let delays: Vec<u64> = (0..500).map(|_| timing.delay_ms()).collect();
        let (least, most) = (delays.iter().min(), delays.iter().max());
        assert_eq!((least, most), (Some(&20), Some(&26)));
    }
}
