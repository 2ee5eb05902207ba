//! When a sensor has measured: from stamps in global time, or else learned from arrivals.
//!
//! Learning finds how far a sensor's clock and this core's are apart, plus the shortest way of its
//! frames. So it cannot see a delay that all lists of the sensor have. A stamp in global time can:
//! the delay that it shows is kept, and used if global time is lost.

use tandem_board::{Duration, Instant};
use tandem_bus::{CameraLanes, SensorHeader, SensorId, TimeStateCode};

use super::round::LANES;

/// If a list took longer than the fastest one by more than this, µs, the sensor's clock was set:
/// the clocks' difference is learned anew. A measurement in global time is no older than this.
const CLOCK_WAS_SET_US: i32 = 500_000;
/// The clocks may drift apart by 0.1 %: the smallest known difference grows by 1 µs in this time.
const DRIFT: Duration = Duration::from_ms(1);
/// A sensor measures every 50 ms. Stamps that do not advance by a multiple of it, within the
/// tolerance, µs, are of a clock that was set.
const PERIOD_US: u32 = 50_000;
const REGULAR_US: u32 = 2_000;
/// The difference is learned anew after this many regular stamps of a clock that was set: lists
/// that arrive in a wrong order have none.
const REGULAR: u8 = 2;
/// Stamps in global time must not deviate by more than this, µs, from what earlier ones have shown:
/// 0.3 m at 30 m/s.
const TOLERANCE_US: i32 = 10_000;
/// Global time that has a larger error than this is not used, µs: 0.15 m at 30 m/s.
const ERROR_US: i32 = 5_000;
/// Stamps that agree count up to this: after 10 s, others must deviate for 10 s to be believed.
const MOST_TRUST: u8 = 200;

/// The global time at a moment of this core's clock. Its user gives a new one at least every
/// second: the two clocks are taken for equally fast, within 100 ppm.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GlobalClock {
    at: Instant,
    us: u64,
    error_us: i32,
}

impl GlobalClock {
    /// At the time `at` of this core's clock the global time is `us`, µs, within
    /// `error`. `None` if that error is too large to use it, or the time lies after the year 2262.
    #[must_use]
    pub fn new(at: Instant, us: u64, error: Duration) -> Option<Self> {
        let error_us = i32::try_from(error.as_us()).ok()?;
        let is_usable = error_us <= ERROR_US && us <= i64::MAX as u64 / 1_000;
        is_usable.then_some(Self { at, us, error_us })
    }

    /// Returns the global time at `at`, modulo 2^32 µs.
    fn us_at(&self, at: Instant) -> u32 {
        let ns = at.as_ns().cast_signed().wrapping_add(self.ahead_ns());
        ns.div_euclid(1_000) as u32
    }

    /// Returns how far the global time is ahead of this core's clock, ns, modulo 2^64.
    pub(super) const fn ahead_ns(&self) -> i64 {
        let ns = self.us.wrapping_mul(1_000);
        ns.wrapping_sub(self.at.as_ns()).cast_signed()
    }

    /// Returns whether a measurement of this age, µs, can arrive now.
    const fn permits(&self, age_us: i32) -> bool {
        -self.error_us <= age_us && age_us <= CLOCK_WAS_SET_US
    }
}

/// The time stamp of a measurement.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stamp {
    us: u32,
    state: TimeStateCode,
}

impl From<&SensorHeader> for Stamp {
    fn from(header: &SensorHeader) -> Self {
        let (us, state) = (header.measured_at, header.time_state);
        Self { us, state }
    }
}

impl From<&CameraLanes> for Stamp {
    fn from(lanes: &CameraLanes) -> Self {
        let (us, state) = (lanes.measured_at, lanes.time_state);
        Self { us, state }
    }
}

impl Stamp {
    const fn is_global(self) -> bool {
        !matches!(self.state, TimeStateCode::OwnClock)
    }

    /// Returns whether this is the stamp of a later measurement on the same clock.
    const fn follows(self, last: Self) -> bool {
        let early = self.us.wrapping_sub(last.us).wrapping_add(REGULAR_US);
        early as i32 >= PERIOD_US as i32 && early % PERIOD_US <= 2 * REGULAR_US
    }
}

/// Global stamps of a sensor deviate from what they have shown before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct RefusedStamp {
    /// The sensor by [`SensorId::index`]; the camera's lanes have the number after the last.
    pub(crate) source: u8,
    /// How much older its measurement is than by what earlier stamps have shown, µs.
    pub(crate) off_us: i32,
}

/// The clock of one sensor as this core sees it.
///
/// The smallest difference between arrival and stamp is the clocks' difference plus the shortest
/// way; a list's excess over it is its additional delay.
#[derive(Clone, Copy, Debug, Default)]
struct SensorClock {
    /// The smallest difference, modulo 2^32 µs, and when it was measured or last raised for the
    /// drift.
    smallest: Option<(u32, Instant)>,
    last: Option<Stamp>,
    /// Regular stamps since the clock was set; [`REGULAR`] if that was learned.
    regular: u8,
    /// What the shortest way takes from the measurement, µs: stamps in global time have shown it.
    way_us: i32,
    /// How many lists have shown that way, less those that did not; 0 if it is unknown.
    trust: u8,
    /// The last stamp in global time was refused.
    refuses: bool,
}

impl SensorClock {
    /// Returns the time of a measurement that arrives `now`, at most 1 s before; and by how much
    /// its stamp deviates, if it is the first one that is refused.
    fn time_of(
        &mut self,
        now: Instant,
        stamp: Stamp,
        global: Option<&GlobalClock>,
    ) -> (Instant, Option<i32>) {
        // The stamp 0 means that there is none.
        if stamp.us == 0 {
            return (now, None);
        }
        let difference = ((now.as_ns() / 1_000) as u32).wrapping_sub(stamp.us);
        let before = self.learn(now, stamp, difference);
        let smallest = self.smallest.map_or(difference, |it| it.0);
        let excess_us = difference.wrapping_sub(smallest) as i32;
        let way_us = if self.trust > 0 { self.way_us } else { 0 };
        let mut age_us = excess_us + way_us;
        let mut refused = None;
        if let Some(global) = global.filter(|_| stamp.is_global()) {
            let shown_us = global.us_at(now).wrapping_sub(stamp.us) as i32;
            // What it would be if the stamps' clock and the global time differ as before.
            let expected_us = difference.wrapping_sub(before) as i32 + way_us;
            let off_us = shown_us.wrapping_sub(expected_us);
            if global.permits(shown_us) && self.believes(stamp, off_us) {
                age_us = shown_us.max(0);
                self.way_us = (age_us - excess_us).clamp(0, CLOCK_WAS_SET_US);
            } else if !core::mem::replace(&mut self.refuses, true) {
                refused = Some(off_us);
            }
        }
        let age = Duration::from_us(age_us.max(0) as u64);
        let at = Instant::from_ns(now.as_ns().saturating_sub(age.as_ns()));
        (at, refused)
    }

    /// Learns the smallest difference. Returns what it was without this list; that of this list if
    /// it is the first one of a clock.
    fn learn(&mut self, now: Instant, stamp: Stamp, difference: u32) -> u32 {
        let last = self.last.replace(stamp);
        let same_clock = last.filter(|last| last.is_global() == stamp.is_global());
        let (Some(last), Some((smallest, since))) = (same_clock, self.smallest) else {
            (self.smallest, self.regular) = (Some((difference, now)), REGULAR);
            return difference;
        };
        let drifted = now.since(since).as_ns() / DRIFT.as_ns();
        let since = since + Duration::from_ns(drifted * DRIFT.as_ns());
        let smallest = smallest.wrapping_add(drifted as u32);
        let excess_us = difference.wrapping_sub(smallest) as i32;
        let was_settled = self.regular >= REGULAR;
        self.regular = match stamp.follows(last) {
            true => REGULAR.min(self.regular.saturating_add(1)),
            false => 0,
        };
        let is_learned = self.regular >= REGULAR && !was_settled;
        if is_learned || !(-TOLERANCE_US..=CLOCK_WAS_SET_US).contains(&excess_us) {
            self.regular = REGULAR;
            self.smallest = Some((difference, now));
            return difference;
        }
        self.smallest = Some(match excess_us {
            ..0 => (difference, now),
            _ => (smallest, since),
        });
        smallest
    }

    /// Returns whether to use a stamp in global time. `off_us`: how much older its measurement is
    /// than by what earlier stamps have shown.
    const fn believes(&mut self, stamp: Stamp, off_us: i32) -> bool {
        let agrees = off_us.unsigned_abs() <= TOLERANCE_US as u32;
        // A sensor that has lost the master of time shows no new way.
        let is_new = self.trust == 0 && matches!(stamp.state, TimeStateCode::Global);
        if agrees && self.trust > 0 || is_new {
            self.refuses = false;
            if self.trust < MOST_TRUST {
                self.trust += 1;
            }
            return true;
        }
        self.trust = self.trust.saturating_sub(1);
        false
    }
}

/// The clocks of all sensors. Objects and lanes of the camera are learned separately: they take
/// different ways.
#[derive(Clone, Debug, Default)]
pub(crate) struct SensorClocks {
    clocks: [SensorClock; SensorId::ALL.len() + 1],
    global: Option<GlobalClock>,
    refused: Option<RefusedStamp>,
}

impl SensorClocks {
    /// Sets the global time; `None` if this system has none.
    pub(crate) const fn set_global(&mut self, global: Option<GlobalClock>) {
        self.global = global;
    }

    /// Returns when the sensor has measured a list that arrives `now`.
    pub(crate) fn time_of(&mut self, now: Instant, sensor: SensorId, stamp: Stamp) -> Instant {
        self.of(now, sensor.index(), stamp)
    }

    /// Returns when the camera has measured lanes that arrive `now`.
    pub(crate) fn time_of_lanes(&mut self, now: Instant, stamp: Stamp) -> Instant {
        self.of(now, LANES, stamp)
    }

    fn of(&mut self, now: Instant, source: usize, stamp: Stamp) -> Instant {
        let (at, off_us) = self.clocks[source].time_of(now, stamp, self.global.as_ref());
        let source = source as u8;
        self.refused = off_us
            .map(|off_us| RefusedStamp { source, off_us })
            .or(self.refused);
        at
    }

    /// Returns the newest stamp in global time that was refused after others were used, once.
    pub(crate) const fn take_refused(&mut self) -> Option<RefusedStamp> {
        self.refused.take()
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use proptest::prelude::*;

    const RADAR: SensorId = SensorId::RadarFront;
    /// How far the sensors' clock is ahead of this core's, and the global time, µs: both wrap soon.
    const OWN_US: u32 = u32::MAX - 3_000_000;
    const GLOBAL_US: u32 = u32::MAX - 700_000;

    fn us(us: u64) -> Instant {
        Instant::from_ns(us * 1_000)
    }

    /// One list every 50 ms, measured at times that end in 0, and its way to the bus.
    struct Bench {
        clocks: SensorClocks,
        now_us: u64,
        /// From the measurement to the arrival.
        way_us: u64,
        /// How far the stamps are ahead of the right ones.
        lie_us: i32,
        /// How far the global time of this core is ahead of the right one.
        leap_us: i32,
        has_global: bool,
        state: TimeStateCode,
    }

    impl Bench {
        fn new(state: TimeStateCode) -> Self {
            Self {
                clocks: SensorClocks::default(),
                now_us: 1_000_000,
                way_us: 21_000,
                lie_us: 0,
                leap_us: 0,
                has_global: true,
                state,
            }
        }

        /// Returns how much later than its measurement the next list is placed, µs.
        fn next(&mut self) -> i64 {
            self.now_us += 50_000;
            let (measured_us, arrives) = (self.now_us, us(self.now_us + self.way_us));
            let global_us = (arrives.as_ns() / 1_000) as u32;
            let global = GLOBAL_US
                .wrapping_add(global_us)
                .wrapping_add_signed(self.leap_us);
            let global = GlobalClock::new(arrives, global.into(), Duration::from_us(100));
            self.clocks.set_global(global.filter(|_| self.has_global));
            let ahead = match self.state {
                TimeStateCode::OwnClock => OWN_US,
                _ => GLOBAL_US,
            };
            let right = (measured_us as u32).wrapping_add(ahead);
            let stamp = Stamp {
                us: right.wrapping_add_signed(self.lie_us),
                state: self.state,
            };
            let at = self.clocks.time_of(arrives, RADAR, stamp);
            assert!(at <= arrives);
            (at.as_ns() / 1_000) as i64 - measured_us as i64
        }

        fn run(&mut self, lists: usize) -> std::vec::Vec<i64> {
            (0..lists).map(|_| self.next()).collect()
        }

        fn refused_us(&mut self) -> Option<i32> {
            self.clocks.take_refused().map(|it| it.off_us)
        }
    }

    /// The time of a measurement is the sensor's, not that of its arrival: a list that the bus
    /// delayed counts as older. The sensors' clock has its own origin, and wraps around.
    #[test]
    fn a_list_is_as_old_as_its_measurement() {
        let mut clocks = SensorClocks::default();
        let first = u32::MAX - 70_000;
        let mut at = |arrival_ms: u64, measured_ms: u32| {
            let stamp = Stamp {
                us: first.wrapping_add(measured_ms * 1_000),
                state: TimeStateCode::OwnClock,
            };
            let at = clocks.time_of(us(arrival_ms * 1_000), RADAR, stamp);
            at.as_ns() / 1_000_000
        };
        assert_eq!(
            at(1_005, 0),
            1_005,
            "the first one gives the difference of the clocks"
        );
        assert_eq!(at(1_055, 50), 1_055);
        assert_eq!(at(1_140, 100), 1_105, "held back by 35 ms, after the wrap");
        assert_eq!(at(1_152, 150), 1_152, "a faster way is the new smallest");
        assert_eq!(at(1_205, 200), 1_202);
        assert_eq!(at(9_000, 10), 9_000, "a clock that was set gives no time");
        assert_eq!(at(9_050, 60), 9_050);
    }

    /// S-4: a stamp in global time shows the delay that learning from arrivals cannot see, and the
    /// delay is still known when the global time is lost.
    #[test]
    fn global_time_shows_a_constant_delay() {
        let mut own = Bench::new(TimeStateCode::OwnClock);
        assert_eq!(own.run(40), [21_000; 40]);
        let mut global = Bench::new(TimeStateCode::Global);
        assert_eq!(global.run(100), [0; 100], "over the wraps");
        global.has_global = false;
        assert_eq!(global.run(10), [0; 10]);
        (global.has_global, global.state) = (true, TimeStateCode::Holdover);
        assert_eq!(global.run(10), [0; 10]);
        global.state = TimeStateCode::OwnClock;
        assert_eq!(global.run(10), [0; 10], "the sensor lost it as well");
        assert_eq!(global.refused_us(), None);
    }

    /// A sensor that has lost the master of time shows no way, and one without a clock none.
    #[test]
    fn only_a_synchronised_sensor_shows_its_way() {
        let mut bench = Bench::new(TimeStateCode::Holdover);
        assert_eq!(bench.run(10), [21_000; 10]);
        bench.state = TimeStateCode::Global;
        assert_eq!(bench.run(10), [0; 10]);
        let none = Stamp {
            us: 0,
            state: TimeStateCode::Global,
        };
        assert_eq!(bench.clocks.time_of(us(77), RADAR, none), us(77));
    }

    /// S-4: whether the sensor's clock leaps or this core's global time, by how much and in which
    /// direction: two lists at most are placed wrongly, by no more than the leap, and it is told. A
    /// sensor that leaps back is believed at once.
    #[test]
    fn a_leap_moves_two_lists_at_most() {
        for amount_us in [
            3_000,
            20_000,
            50_000,
            61_234,
            137_000,
            1_000_000,
            100_000_000,
        ] {
            for amount_us in [amount_us, -amount_us] {
                for (of_sensor, of_core) in [(amount_us, 0), (0, amount_us)] {
                    for state in [TimeStateCode::Global, TimeStateCode::OwnClock] {
                        let mut bench = Bench::new(state);
                        bench.run(300);
                        let before = bench.next();
                        (bench.lie_us, bench.leap_us) = (of_sensor, of_core);
                        let moved = bench.run(150).into_iter().map(|it| it - before);
                        let moved: std::vec::Vec<i64> = moved.collect();
                        let what = std::format!("{state:?} {of_sensor} {of_core}: {moved:?}");
                        let is_small = amount_us.abs() <= TOLERANCE_US;
                        let limit = i64::from(amount_us.abs());
                        assert!(
                            moved.iter().all(|it| it.abs() <= limit.min(500_000)),
                            "{what}"
                        );
                        if !is_small {
                            assert!(moved[2..].iter().all(|it| it.abs() <= 150), "{what}");
                        }
                        let tells = state == TimeStateCode::Global && !is_small;
                        assert_eq!(bench.refused_us().is_some(), tells, "{what}");
                        (bench.lie_us, bench.leap_us) = (0, 0);
                        let back = bench.run(20);
                        assert!(
                            back[2..].iter().all(|it| (it - before).abs() <= 150),
                            "{back:?}"
                        );
                    }
                }
            }
        }
    }

    proptest! {
        /// Whatever sensors and time base say, and whatever the clocks do: a measurement lies at
        /// most 1 s before its arrival, and never after it.
        #[test]
        fn a_measurement_lies_before_its_arrival(
            lists in prop::collection::vec(
                (0_usize..3, any::<u32>(), 0_u8..3, any::<u32>(), 0_u64..10_000, any::<bool>()),
                1..60,
            ),
            step in prop_oneof![Just(50_000_u64), any::<u64>().prop_map(|it| it >> 8)],
        ) {
            let mut clocks = SensorClocks::default();
            let mut now_us = 0;
            for (sensor, stamp_us, state, global_us, error_us, is_regular) in lists {
                now_us = (now_us + step) % (u64::MAX / 1_000);
                let (now, state) = (us(now_us), TimeStateCode::ALL[usize::from(state)]);
                let own_us = if is_regular { now_us as u32 } else { stamp_us };
                let global_us = if is_regular { now_us as u32 } else { global_us };
                let error = Duration::from_us(error_us);
                clocks.set_global(GlobalClock::new(us(now_us / 2), global_us.into(), error));
                let at = clocks.time_of(now, SensorId::ALL[sensor], Stamp { us: own_us, state });
                prop_assert!(at <= now);
                prop_assert!(now.since(at) <= Duration::from_ms(1_000));
            }
        }
    }

    /// A time that others deviate from for 10 s is the new one: nothing is refused for ever.
    #[test]
    fn a_new_way_is_believed_after_a_while() {
        let mut bench = Bench::new(TimeStateCode::Global);
        bench.run(1_000);
        bench.leap_us = -15_000;
        let lists = bench.run(400);
        let since = lists.iter().position(|it| *it != 0).unwrap();
        assert_eq!(since, usize::from(MOST_TRUST));
        assert_eq!(lists[since..], [15_000; 200]);
        let refused_us = bench.refused_us().unwrap();
        assert!((-15_000..=-14_900).contains(&refused_us), "{refused_us}");
    }

    #[test]
    fn a_global_time_with_a_large_error_is_none() {
        let clock = |ns| GlobalClock::new(Instant::ORIGIN, 0, Duration::from_ns(ns));
        assert!(clock(5_000_999).is_some());
        assert!(clock(5_001_000).is_none() && clock(u64::MAX).is_none());
    }
}
