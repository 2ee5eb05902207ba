//! Tests the sensors through their frames.

#![allow(clippy::unwrap_used)]

use std::f64::consts::PI;
use std::fmt::Write;

use tandem_bus::{CameraLanes, ClassCode, FrameReceiver, Message, SensorId, SensorObject};
use tandem_vehicle::{Scenario, World, WorldConfig};

/// The ego's speed, m/s.
const SPEED: f64 = 20.0;

/// Returns three straight lanes along x, 3.5 m wide, the ego in the middle one at the origin; the
/// leftmost lane ends at 150 m. `things` are (x, y, length, width) of standing objects.
fn scenario(things: &[(f64, f64, f64, f64)], yaw: f64) -> Scenario {
    let mut xml = String::from(
        "<commonRoad commonRoadVersion=\"2018b\" timeStepSize=\"0.1\" benchmarkID=\"straight\">",
    );
    let lanelet = |id: u32, from: f64, to: f64, y: f64, links: &str| {
        let bound = |name: &str, y: f64| {
            let point = |x: f64| format!("<point><x>{x}</x><y>{y}</y></point>");
            format!("<{name}>{}{}</{name}>", point(from), point(to))
        };
        let (left, right) = (bound("leftBound", y + 1.75), bound("rightBound", y - 1.75));
        format!("<lanelet id=\"{id}\">{left}{right}{links}<speedLimit>25</speedLimit></lanelet>")
    };
    let next = |id: u32| format!("<successor ref=\"{id}\"/>");
    let left = |id: u32| format!("<adjacentLeft ref=\"{id}\" drivingDir=\"same\"/>");
    let right = |id: u32| format!("<adjacentRight ref=\"{id}\" drivingDir=\"same\"/>");
    xml += &lanelet(1, -300.0, 150.0, -3.5, &(next(4) + &left(2)));
    xml += &lanelet(2, -300.0, 150.0, 0.0, &(next(5) + &left(3) + &right(1)));
    xml += &lanelet(3, -300.0, 150.0, 3.5, &right(2));
    xml += &lanelet(4, 150.0, 900.0, -3.5, &left(5));
    xml += &lanelet(5, 150.0, 900.0, 0.0, &right(4));
    for (id, (x, y, length, width)) in things.iter().enumerate() {
        write!(
            xml,
            "<obstacle id=\"{}\"><role>static</role><type>car</type><shape><rectangle>\
             <length>{length}</length><width>{width}</width></rectangle></shape><initialState>\
             <position><point><x>{x}</x><y>{y}</y></point></position><orientation><exact>0</exact>\
             </orientation><time><exact>0</exact></time></initialState></obstacle>",
            id + 100
        )
        .unwrap();
    }
    write!(
        xml,
        "<planningProblem id=\"9\"><initialState><position><point><x>0</x><y>0</y></point>\
         </position><orientation><exact>{yaw}</exact></orientation><time><exact>0</exact>\
         </time><velocity><exact>{SPEED}</exact></velocity>\
         </initialState></planningProblem></commonRoad>"
    )
    .unwrap();
    Scenario::parse(&xml, "straight").unwrap()
}

/// Returns all lists of one sensor, and all lanes, in `cycles` measurements of the standing world.
fn measure(
    scenario: &Scenario,
    sensor: SensorId,
    cycles: u64,
) -> (Vec<Vec<SensorObject>>, Vec<CameraLanes>) {
    let mut world = World::new(scenario, WorldConfig { seed: 3 });
    let mut receiver = FrameReceiver::new();
    let (mut lists, mut lanes) = (Vec::new(), Vec::new());
    for ms in 0..cycles * 50 {
        world.step(
            ms * 1_000_000,
            &mut |id, data| match receiver.receive(id.into(), data).unwrap() {
                Message::SensorHeader(s, _) if s == sensor => lists.push(Vec::new()),
                Message::SensorObject(s, object) if s == sensor => {
                    let list: &mut Vec<SensorObject> = lists.last_mut().unwrap();
                    assert_eq!(usize::from(object.index), list.len());
                    list.push(object);
                }
                Message::CameraLanes(seen) => lanes.push(seen),
                _ => {}
            },
        );
    }
    (lists, lanes)
}

/// Returns the share of the lists that have an object within 3 m of this place.
fn seen(lists: &[Vec<SensorObject>], x: f64, y: f64) -> f64 {
    let near =
        |object: &SensorObject| (f64::from(object.x) - x).hypot(f64::from(object.y) - y) < 3.0;
    lists.iter().filter(|list| list.iter().any(near)).count() as f64 / lists.len() as f64
}

/// T-CHIP-4: each sensor sees exactly the objects in its field of view.
#[test]
fn every_sensor_looks_in_its_own_direction() {
    use SensorId::*;
    let cases = [
        (150.0, 0.0, &[RadarFront][..]),
        (
            60.0,
            0.0,
            &[RadarFront, RadarFrontLeft, RadarFrontRight, CameraFront],
        ),
        (30.0, 20.0, &[RadarFront, RadarFrontLeft, CameraFront]),
        (0.0, 10.0, &[RadarFrontLeft, RadarRearLeft]),
        // Abreast no radar looks at its middle, but two see its flank.
        (0.0, 3.5, &[RadarFrontLeft, RadarRearLeft]),
        (0.0, -3.5, &[RadarFrontRight, RadarRearRight]),
        (0.0, -10.0, &[RadarFrontRight, RadarRearRight]),
        (-50.0, 0.0, &[RadarRearLeft, RadarRearRight]),
        (-60.0, 40.0, &[RadarRearLeft]),
        (-95.0, 0.0, &[]),
        (260.0, 0.0, &[]),
    ];
    for (x, y, expected) in cases {
        let scenario = scenario(&[(x, y, 4.0, 2.0)], 0.0);
        for sensor in SensorId::ALL {
            let share = seen(&measure(&scenario, sensor, 40).0, x, y);
            let expected = expected.contains(&sensor);
            assert!(
                if expected { share > 0.7 } else { share == 0.0 },
                "{x} {y} {sensor:?} {share}"
            );
        }
    }
}

/// Something small disappears in the triangle that perception takes for hidden (`HIDDEN_M` in
/// `cores/src/driving/perception/track.rs`): 2.4 m to either end on the vehicle's middle line, up
/// to 4.2 m aside.
#[test]
fn the_fields_of_view_leave_out_a_triangle_beside_the_vehicle() {
    for (x, y, is_seen) in [
        (0.0, 2.0, false),
        (0.0, -3.9, false),
        (1.0, 2.0, false),
        (-1.0, -2.0, false),
        (1.6, 2.0, true),
        (-1.6, -2.0, true),
        (0.0, 4.5, true),
    ] {
        let scenario = scenario(&[(x, y, 0.2, 0.2)], 0.0);
        let shares = SensorId::ALL.map(|of| seen(&measure(&scenario, of, 40).0, x, y));
        let most = shares.into_iter().fold(0.0, f64::max);
        assert!(
            if is_seen { most > 0.7 } else { most == 0.0 },
            "{x} {y} {most}"
        );
    }
}

#[test]
fn what_a_nearer_vehicle_covers_is_not_seen() {
    let truck = (20.0, 0.0, 10.0, 2.5);
    let hidden = (60.0, 0.0, 4.0, 1.8);
    let beside = (60.0, 7.0, 4.0, 1.8);
    let scenario = scenario(&[hidden, truck, beside], 0.0);
    for sensor in [SensorId::RadarFront, SensorId::CameraFront] {
        let (lists, _) = measure(&scenario, sensor, 100);
        assert!(seen(&lists, 20.0, 0.0) > 0.9);
        assert_eq!(seen(&lists, 60.0, 0.0), 0.0, "{sensor:?}");
        assert!(seen(&lists, 60.0, 7.0) > 0.9, "{sensor:?}");
    }
}

/// The errors have the standard deviations that the sensor announces, and no bias; velocities are
/// relative and in the vehicle's axes.
#[test]
fn errors_are_as_announced() {
    let yaw = 0.2;
    let (x, y) = (40.0, 5.0);
    let scenario = scenario(&[(x, y, 4.0, 2.0)], yaw);
    let expected = (x * yaw.cos() + y * yaw.sin(), y * yaw.cos() - x * yaw.sin());
    for sensor in [
        SensorId::RadarFront,
        SensorId::RadarFrontLeft,
        SensorId::CameraFront,
    ] {
        let (lists, _) = measure(&scenario, sensor, 2_000);
        let objects: Vec<_> = lists.concat();
        let statistics = |value: &dyn Fn(&SensorObject) -> f64| {
            let count = objects.len() as f64;
            let mean = objects.iter().map(value).sum::<f64>() / count;
            let square = objects
                .iter()
                .map(|o| (value(o) - mean).powi(2))
                .sum::<f64>()
                / count;
            (mean, square.sqrt())
        };
        let (mean, deviation) = statistics(&|o| f64::from(o.x));
        let announced = f64::from(objects[0].x_deviation);
        assert!(
            (mean - expected.0).abs() < 0.1 * announced + 0.01,
            "{sensor:?} {mean}"
        );
        assert!(
            (deviation / announced - 1.0).abs() < 0.15,
            "{sensor:?} {deviation} {announced}"
        );
        let (mean, deviation) = statistics(&|o| f64::from(o.y));
        let announced = f64::from(objects[0].y_deviation);
        assert!(
            (mean - expected.1).abs() < 0.1 * announced + 0.01,
            "{sensor:?} {mean}"
        );
        assert!(
            (deviation / announced - 1.0).abs() < 0.2,
            "{sensor:?} {deviation} {announced}"
        );
        let (vx, _) = statistics(&|o| f64::from(o.vx));
        let (vy, _) = statistics(&|o| f64::from(o.vy));
        assert!(
            (vx + SPEED).abs() < 0.1 && vy.abs() < 0.1,
            "{sensor:?} {vx} {vy}"
        );
        let expected = if sensor == SensorId::CameraFront {
            ClassCode::Car
        } else {
            ClassCode::Unknown
        };
        assert!(objects.iter().all(|o| o.class == expected));
        assert!(lists.len() > objects.len(), "some are missed");
    }
}

/// Of a vehicle abreast a corner radar sees a part: where its middle is, it tells with an error as
/// large as it announces, which is that of its middle's way out of the field of view.
#[test]
fn a_part_tells_less_of_where_the_whole_is() {
    let errors = |y: f64| {
        let (lists, _) = measure(
            &scenario(&[(0.0, y, 4.5, 1.8)], 0.0),
            SensorId::RadarFrontLeft,
            2_000,
        );
        let objects = lists.concat();
        let square: f64 = objects.iter().map(|o| f64::from(o.x).powi(2)).sum();
        let deviation = (square / objects.len() as f64).sqrt();
        (deviation, f64::from(objects[0].x_deviation))
    };
    // Its middle is in view from 4.2 m aside on.
    let (partly, announced) = errors(3.5);
    assert!(
        (partly / announced - 1.0).abs() < 0.15,
        "{partly} {announced}"
    );
    let (wholly, _) = errors(4.5);
    assert!(partly > 2.0 * wholly, "{partly} {wholly}");
}

#[test]
fn a_list_holds_the_twenty_nearest() {
    let things: Vec<_> = (0..30)
        .map(|i| {
            (
                20.0 + f64::from(i) * 2.0,
                -40.0 + f64::from(i) * 3.0,
                0.5,
                0.5,
            )
        })
        .collect();
    let (lists, _) = measure(&scenario(&things, 0.0), SensorId::RadarFront, 20);
    assert!(lists.iter().all(|list| list.len() <= 20));
    let range = |o: &SensorObject| (o.x - 2.2).hypot(o.y);
    assert!(
        lists
            .iter()
            .all(|list| list.windows(2).all(|w| range(&w[0]) < range(&w[1]) + 2.0))
    );
}

#[test]
fn the_camera_sees_lanes_neighbours_and_their_ends() {
    let yaw = 0.05;
    let (_, lanes) = measure(&scenario(&[], yaw), SensorId::CameraFront, 500);
    let mean = |value: &dyn Fn(&CameraLanes) -> f32| {
        lanes.iter().map(|lane| f64::from(value(lane))).sum::<f64>() / lanes.len() as f64
    };
    assert!(
        lanes
            .iter()
            .all(|l| l.valid && l.left_exists && l.right_exists)
    );
    assert!(mean(&|l| l.c0).abs() < 0.005);
    assert!((mean(&|l| l.c1) + yaw.tan()).abs() < 0.000_5);
    assert!(mean(&|l| l.c2).abs() < 5e-6 && mean(&|l| l.c3).abs() < 1e-7);
    let width = |width: f64| (width - 3.5).abs() < 0.02;
    assert!(width(mean(&|l| l.width)) && width(mean(&|l| l.left_width)));
    assert!((mean(&|l| l.left_end) - 150.0).abs() < 2.0);
    assert!(lanes.iter().all(|l| l.own_end == CameraLanes::NO_END));
    assert!(lanes.iter().all(|l| l.right_end == CameraLanes::NO_END));
    assert_eq!(lanes[0].speed_limit, 25.0);
}

#[test]
fn the_camera_is_blind_when_the_ego_faces_the_wrong_way() {
    let (_, lanes) = measure(&scenario(&[], PI), SensorId::CameraFront, 2);
    assert!(lanes.iter().all(|lane| !lane.valid));
}
