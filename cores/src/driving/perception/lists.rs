//! Object lists as they arrive over the bus: a header, then one frame for each object.

use heapless::Vec;
use tandem_board::{Duration, Instant};
use tandem_bus::{SensorHeader, SensorId, SensorObject};

use super::MAX_DETECTIONS;

/// A list that is still not complete after this time has lost frames; its objects are used.
const COMPLETION_TIME: Duration = Duration::from_ms(20);

/// If a list took longer than the fastest one by more than this, µs, the sensors' clock was set:
/// the clocks' difference is measured anew.
const CLOCK_WAS_SET_US: i32 = 500_000;
/// The clocks may drift apart by 0.1 %: the smallest known difference grows by 1 µs in this time.
const DRIFT: Duration = Duration::from_ms(1);

/// The sensors' clock as this core sees it. The smallest difference between arrival and measurement
/// is the clocks' difference plus the shortest transfer time; a list's excess over it is its delay.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct SensorClock {
    /// The smallest difference, modulo 2^32 µs, and when it was measured or last raised for the
    /// drift.
    smallest: Option<(u32, Instant)>,
}

impl SensorClock {
    /// Returns the time of a measurement with the stamp `measured_at` that arrives `now`; the stamp
    /// 0 means that there is none.
    pub(crate) fn time_of(&mut self, now: Instant, measured_at: u32) -> Instant {
        if measured_at == 0 {
            return now;
        }
        let way = ((now.as_ns() / 1_000) as u32).wrapping_sub(measured_at);
        let (smallest, since) = self.smallest.get_or_insert((way, now));
        let drifted = now.since(*since).as_ns() / DRIFT.as_ns();
        *smallest = smallest.wrapping_add(drifted as u32);
        *since += Duration::from_ns(drifted * DRIFT.as_ns());
        let delay_us = way.wrapping_sub(*smallest) as i32;
        if !(0..=CLOCK_WAS_SET_US).contains(&delay_us) {
            self.smallest = Some((way, now));
            return now;
        }
        let delay = Duration::from_us(delay_us as u64);
        Instant::from_ns(now.as_ns().saturating_sub(delay.as_ns()))
    }
}

/// The newest object list of one sensor.
#[derive(Clone, Debug, Default)]
struct List {
    /// When the sensor measured.
    at: Instant,
    /// When its header arrived.
    begun: Instant,
    /// When the last object arrived.
    done: Instant,
    expected: usize,
    objects: Vec<SensorObject, MAX_DETECTIONS>,
    fresh: bool,
}

/// The newest object list of every sensor.
#[derive(Clone, Debug, Default)]
pub(crate) struct Lists {
    lists: [List; SensorId::ALL.len()],
    /// One for all sensors: they share the time of the vehicle.
    clock: SensorClock,
}

impl Lists {
    /// Begins the next list of this sensor; the one before it ends, complete or not.
    pub(crate) fn begin(&mut self, now: Instant, sensor: SensorId, header: &SensorHeader) {
        let at = self.clock.time_of(now, header.measured_at);
        let list = &mut self.lists[sensor.index()];
        (list.at, list.begun, list.done) = (at, now, now);
        list.expected = usize::from(header.object_count).min(MAX_DETECTIONS);
        list.objects.clear();
        list.fresh = true;
    }

    /// Adds an object to the list that the sensor has begun. Ignores objects beyond the announced
    /// number, and objects after the list was taken.
    pub(crate) fn add(&mut self, now: Instant, sensor: SensorId, object: &SensorObject) {
        let list = &mut self.lists[sensor.index()];
        if list.fresh && list.objects.len() < list.expected {
            // Cannot be full: `expected` is within the capacity.
            let _ = list.objects.push(*object);
            list.done = now;
        }
    }

    /// Returns the time at which the list was complete; `None` if it is not, or was taken.
    pub(crate) fn completed(&self, sensor: usize) -> Option<Instant> {
        let list = &self.lists[sensor];
        let is_complete = list.fresh && list.objects.len() == list.expected;
        is_complete.then_some(list.done)
    }

    /// Returns the oldest list that is ready and was not taken before: its sensor, the times of the
    /// measurement and of its last object's arrival, and its objects.
    pub(crate) fn take(
        &mut self,
        now: Instant,
    ) -> Option<(
        SensorId,
        Instant,
        Instant,
        Vec<SensorObject, MAX_DETECTIONS>,
    )> {
        let is_ready = |list: &List| {
            let complete = list.objects.len() == list.expected;
            list.fresh && (complete || now.since(list.begun) > COMPLETION_TIME)
        };
        let sensor = SensorId::ALL
            .into_iter()
            .filter(|sensor| is_ready(&self.lists[sensor.index()]))
            .min_by_key(|sensor| self.lists[sensor.index()].at)?;
        let list = &mut self.lists[sensor.index()];
        list.fresh = false;
        Some((sensor, list.at, list.done, list.objects.clone()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(ms: u64) -> Instant {
        Instant::ORIGIN + Duration::from_ms(ms)
    }

    /// The time of a measurement is the sensor's, not that of its arrival: a list that the bus
    /// delayed counts as older. The sensors' clock has its own origin, and wraps around.
    #[test]
    fn a_list_is_as_old_as_its_measurement() {
        let mut clock = SensorClock::default();
        let first = u32::MAX - 70_000;
        let mut at = |arrival_ms: u64, measured_ms: u32| {
            let measured_at = first.wrapping_add(measured_ms * 1_000);
            clock.time_of(ms(arrival_ms), measured_at).as_ns() / 1_000_000
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

    fn header(object_count: u8) -> SensorHeader {
        SensorHeader {
            object_count,
            ..SensorHeader::default()
        }
    }

    #[test]
    fn a_list_is_taken_once_and_only_when_it_is_complete() {
        let mut lists = Lists::default();
        let radar = SensorId::RadarFront;
        lists.begin(ms(5), radar, &header(2));
        lists.add(ms(6), radar, &SensorObject::default());
        assert!(lists.take(ms(10)).is_none());
        lists.add(ms(6), radar, &SensorObject::default());
        lists.add(ms(6), radar, &SensorObject::default());
        let (sensor, at, done, objects) = lists.take(ms(10)).unwrap();
        assert_eq!((sensor, at, objects.len()), (radar, ms(5), 2));
        assert_eq!(done, ms(6));
        assert!(lists.take(ms(10)).is_none());
    }

    #[test]
    fn a_list_that_lost_frames_is_used_after_a_while() {
        let mut lists = Lists::default();
        lists.begin(ms(0), SensorId::CameraFront, &header(3));
        lists.add(ms(6), SensorId::CameraFront, &SensorObject::default());
        assert!(lists.take(ms(20)).is_none());
        assert_eq!(lists.take(ms(21)).unwrap().3.len(), 1);
    }

    #[test]
    fn the_oldest_comes_first() {
        let mut lists = Lists::default();
        lists.begin(ms(9), SensorId::RadarFront, &header(0));
        lists.begin(ms(3), SensorId::CameraFront, &header(0));
        assert_eq!(lists.take(ms(10)).unwrap().0, SensorId::CameraFront);
        assert_eq!(lists.take(ms(10)).unwrap().0, SensorId::RadarFront);
    }

    #[test]
    fn an_announced_count_beyond_the_capacity_is_cut_off() {
        let mut lists = Lists::default();
        lists.begin(ms(0), SensorId::RadarFront, &header(255));
        for _ in 0..300 {
            lists.add(ms(6), SensorId::RadarFront, &SensorObject::default());
        }
        assert_eq!(lists.take(ms(1)).unwrap().3.len(), MAX_DETECTIONS);
    }
}
