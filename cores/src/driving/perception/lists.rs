//! Object lists as they arrive over the bus: a header, then one frame for each object.

use heapless::Vec;
use tandem_board::{Duration, Instant};
use tandem_bus::{SensorHeader, SensorId, SensorObject};

use super::MAX_DETECTIONS;

/// A list that is still not complete after this time has lost frames; its objects are used.
const COMPLETION_TIME: Duration = Duration::from_ms(20);

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
}

impl Lists {
    /// Begins the next list of this sensor, whose header arrives `now` and which was measured at
    /// `at`; the one before it ends, complete or not.
    pub(crate) fn begin(
        &mut self,
        (now, at): (Instant, Instant),
        sensor: SensorId,
        header: &SensorHeader,
    ) {
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

    /// Moves all times by this many nanoseconds.
    pub(crate) fn shift(&mut self, by_ns: i64) {
        for list in &mut self.lists {
            for at in [&mut list.at, &mut list.begun, &mut list.done] {
                *at = at.moved(by_ns);
            }
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
        lists.begin((ms(5), ms(5)), radar, &header(2));
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
        lists.begin((ms(0), ms(0)), SensorId::CameraFront, &header(3));
        lists.add(ms(6), SensorId::CameraFront, &SensorObject::default());
        assert!(lists.take(ms(20)).is_none());
        assert_eq!(lists.take(ms(21)).unwrap().3.len(), 1);
    }

    #[test]
    fn the_oldest_comes_first() {
        let mut lists = Lists::default();
        lists.begin((ms(9), ms(9)), SensorId::RadarFront, &header(0));
        lists.begin((ms(3), ms(3)), SensorId::CameraFront, &header(0));
        assert_eq!(lists.take(ms(10)).unwrap().0, SensorId::CameraFront);
        assert_eq!(lists.take(ms(10)).unwrap().0, SensorId::RadarFront);
    }

    #[test]
    fn an_announced_count_beyond_the_capacity_is_cut_off() {
        let mut lists = Lists::default();
        lists.begin((ms(0), ms(0)), SensorId::RadarFront, &header(255));
        for _ in 0..300 {
            lists.add(ms(6), SensorId::RadarFront, &SensorObject::default());
        }
        assert_eq!(lists.take(ms(1)).unwrap().3.len(), MAX_DETECTIONS);
    }
}
