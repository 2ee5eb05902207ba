//! Perception on the vehicle's time: whatever this time does, the scene is not disturbed. Two
//! systems with different clocks compute the same bits.

#![allow(clippy::unwrap_used)]

use proptest::prelude::*;
use tandem_board::{Duration, Instant};
use tandem_bus::{
    CameraLanes, EgoMotion, Message, SensorHeader, SensorId, SensorObject, TimeStateCode,
};
use tandem_cores::driving::perception::{GlobalClock, Perception};
use tandem_cores::driving::types::{CameraLine, Scene};

const MS: u64 = 1_000_000;
/// The vehicle's time at time 0 of the test, ns; it has no relation to its milliseconds.
const VEHICLE_NS: u64 = 1_790_000_000_000_321_000;
/// m/s
const SPEED: f32 = 30.0;

/// A system that drives behind a vehicle whose distance swings by 10 m.
struct System {
    perception: Perception,
    /// Its clock at time 0 of the test, ns, and how much faster it runs, ppb.
    offset_ns: u64,
    drift_ppb: u64,
    /// How far the vehicle's time is off here, µs; `None` without that time.
    global_us: Option<i64>,
    /// The radar sees nothing before this round.
    sees_since: u64,
}

impl System {
    fn new(offset_ns: u64, drift_ppb: u64) -> Self {
        Self {
            perception: Perception::new(),
            offset_ns,
            drift_ppb,
            global_us: None,
            sees_since: 0,
        }
    }

    fn local(&self, ns: u64) -> Instant {
        Instant::from_ns(self.offset_ns + ns + ns / 1_000_000 * self.drift_ppb / 1_000)
    }

    /// Hears the frames of 50 ms, and computes the scene. The radar measures 2 ms before its list
    /// arrives.
    fn round(&mut self, number: u64, state: TimeStateCode) -> Scene {
        let begin_ns = number * 50 * MS;
        let now = self.local(begin_ns);
        let clock = self.global_us.and_then(|off_us| {
            let us = (VEHICLE_NS + begin_ns) / 1_000;
            GlobalClock::new(now, us.saturating_add_signed(off_us), Duration::ZERO)
        });
        self.perception.set_global(clock);
        let stamp = |ns: u64| ((VEHICLE_NS + ns) / 1_000) as u32;
        for step in 0..5 {
            let motion = EgoMotion {
                world_running: true,
                speed: SPEED + 0.1 * (number as f32 * 0.3).sin(),
                yaw_rate: 0.02,
                ..EgoMotion::default()
            };
            let at = self.local(begin_ns + step * 10 * MS + 130_000);
            self.perception.on_message(at, &Message::EgoMotion(motion));
        }
        let measured_ns = begin_ns + 43 * MS;
        let arrived = self.local(measured_ns + 2 * MS);
        let header = SensorHeader {
            time_state: state,
            measured_at: stamp(measured_ns),
            object_count: u8::from(number >= self.sees_since),
        };
        let time_s = measured_ns as f32 * 1e-9;
        let object = SensorObject {
            x: 60.0 + 10.0 * (0.5 * time_s).sin(),
            vx: 5.0 * (0.5 * time_s).cos(),
            x_deviation: 0.2,
            y_deviation: 0.2,
            ..SensorObject::default()
        };
        let lanes = CameraLanes {
            valid: true,
            view_range: 80,
            width: 3.5,
            c1: 0.01,
            time_state: state,
            measured_at: stamp(measured_ns),
            ..CameraLanes::default()
        };
        let (radar, camera) = (SensorId::RadarFront, Message::CameraLanes(lanes));
        let messages = [
            Message::SensorHeader(radar, header),
            Message::SensorObject(radar, object),
            camera,
        ];
        for message in &messages {
            self.perception.on_message(arrived, message);
        }
        let is_complete = number == 0 || self.perception.is_round_complete();
        assert!(is_complete, "round {number}");
        let scene = self.perception.cycle(arrived).clone();
        let apart = scene.at.since(arrived).max(arrived.since(scene.at));
        assert!(apart <= Duration::from_ms(1), "{apart:?}");
        let late = Duration::from_us(12_500);
        let period = Duration::from_ms(50);
        let next = self.perception.next_round(arrived + late, period);
        let apart = next.unwrap().since(arrived).as_us().abs_diff(50_000);
        assert!(apart <= 1_000, "{apart} µs");
        scene
    }
}

/// What the vehicle's time may do before a round.
fn change() -> impl Strategy<Value = Option<i64>> {
    prop_oneof![
        Just(None),
        Just(Some(0)),
        (-2_000_i64..2_000).prop_map(Some),
        (-100_000_i64..100_000).prop_map(Some),
        // More than a day.
        (-100_000_000_000_i64..100_000_000_000).prop_map(Some),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Gain, loss, leaps and holdover of the vehicle's time: the scene stays that of a system
    /// without it, within half a millisecond of motion, and with every object.
    #[test]
    fn no_sequence_of_gains_losses_and_leaps_disturbs_the_scene(
        changes in prop::collection::vec((0_u64..12, change()), 1..30),
    ) {
        let (mut with, mut without) = (System::new(5_000 * MS, 0), System::new(5_000 * MS, 0));
        let mut number = 0;
        for (rounds, global_us) in changes {
            with.global_us = global_us;
            for _ in 0..=rounds {
                let (a, b) = (
                    with.round(number, TimeStateCode::OwnClock),
                    without.round(number, TimeStateCode::OwnClock),
                );
                prop_assert_eq!((a.missing & 1, a.objects.len()), (b.missing & 1, b.objects.len()));
                prop_assert_eq!(a.lanes.is_some(), b.lanes.is_some());
                for (one, two) in a.objects.iter().zip(&b.objects) {
                    prop_assert_eq!(one.id, two.id);
                    prop_assert!((one.x - two.x).abs() < 0.05, "{} {}", one.x, two.x);
                    prop_assert!((one.vx - two.vx).abs() < 0.1, "{} {}", one.vx, two.vx);
                }
                number += 1;
            }
        }
    }
}

/// Without the times of one system.
fn content(scene: &Scene) -> Scene {
    let camera = CameraLine {
        at: Instant::ORIGIN,
        ..scene.camera
    };
    Scene {
        at: Instant::ORIGIN,
        measured: Instant::ORIGIN,
        camera,
        ..scene.clone()
    }
}

/// Both systems get the time at different moments, read it some microseconds apart, and their
/// clocks drift: their scenes become the same bits.
#[test]
fn two_systems_with_one_time_compute_the_same_scenes() {
    let mut systems = [System::new(MS, 0), System::new(7_000 * MS + 77, 20_000)];
    let mut differ = vec![];
    for number in 0..400 {
        let scenes = [0, 1].map(|of: usize| {
            systems[of].sees_since = 100;
            let has_time = number >= 10 + 7 * of as u64;
            let off_us = [0, (number % 7).cast_signed() - 3][of];
            systems[of].global_us = has_time.then_some(off_us);
            content(&systems[of].round(number, TimeStateCode::Global))
        });
        let [a, b] = &scenes;
        assert_eq!(a.moment.is_some(), number >= 10);
        if a != b {
            differ.push(number);
        }
    }
    assert!(differ.iter().all(|number| *number < 100), "{differ:?}");
    assert!(!differ.is_empty(), "they began differently");
}

/// A sender that was held up sends its frames within a millisecond: the newest motion counts, with
/// and without the vehicle's time.
#[test]
fn of_frames_in_one_millisecond_the_newest_counts() {
    for has_time in [false, true] {
        let mut perception = Perception::new();
        let mut scene = None;
        for number in 0..54_u64 {
            let late_ns = if number < 50 {
                0
            } else {
                3_600_000 + (number - 50) * 130_000
            };
            let due = if number < 50 { number } else { 53 };
            let now = Instant::from_ns(1_000 * MS + due * 10 * MS + late_ns);
            let us = now.as_ns() / 1_000 + 5_000_000_000;
            let global = GlobalClock::new(now, us, Duration::ZERO);
            perception.set_global(global.filter(|_| has_time));
            let motion = EgoMotion {
                world_running: true,
                speed: 30.0 - number as f32,
                ..EgoMotion::default()
            };
            perception.on_message(now, &Message::EgoMotion(motion));
            scene = Some(perception.cycle(now).clone());
        }
        assert_eq!(scene.unwrap().ego.speed, 30.0 - 53.0);
    }
}

/// A time that the 64 bits of the timeline cannot hold is no time.
#[test]
fn a_time_beyond_the_timeline_is_none() {
    let last = i64::MAX as u64 / 1_000;
    let clock = |us| GlobalClock::new(Instant::ORIGIN, us, Duration::ZERO);
    assert!(clock(last).is_some());
    assert_eq!(clock(last + 1), None);
}
