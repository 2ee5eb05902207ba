//! Traffic on a straight road of two lanes, 4 m wide, along x: lane 0 at y = 0, lane 1 at y = 4.

use super::*;
use crate::commonroad::{Lanelet, TimedState};

const STEP: f64 = 0.005;

/// Lane 0 ends at `drop`, if it is given; lane 1 continues.
fn road(drop: Option<f64>) -> Arc<Road> {
    let lanelet = |id, y: f64, from: f64, to: f64| Lanelet {
        id,
        left: vec![Vec2::new(from, y + 2.0), Vec2::new(to, y + 2.0)],
        right: vec![Vec2::new(from, y - 2.0), Vec2::new(to, y - 2.0)],
        predecessors: Vec::new(),
        successors: Vec::new(),
        left_neighbour: None,
        right_neighbour: None,
        speed_limit: None,
        is_refused: false,
        is_crosswalk: false,
    };
    let end = drop.unwrap_or(2_000.0);
    let mut lanelets = vec![lanelet(1, 0.0, -500.0, end), lanelet(2, 4.0, -500.0, end)];
    lanelets[0].left_neighbour = Some(2);
    lanelets[1].right_neighbour = Some(1);
    if drop.is_some() {
        lanelets[1].successors = vec![3];
        lanelets.push(lanelet(3, 4.0, end, 3_000.0));
        lanelets[2].predecessors = vec![2];
    }
    Arc::new(Road::new(&lanelets).unwrap())
}

/// Returns a car recorded every 0.1 s until `end`, with x and y by time.
fn car(id: i64, end: f64, place: impl Fn(f64) -> (f64, f64)) -> Obstacle {
    let states = (0..=(end * 10.0) as u32).map(|step| {
        let t = f64::from(step) * 0.1;
        let (x, y) = place(t);
        let (next_x, next_y) = place(t + 0.1);
        let way = Vec2::new(next_x - x, next_y - y);
        let speed = Some(way.norm() * 10.0);
        TimedState {
            t,
            position: Vec2::new(x, y),
            yaw: way.angle(),
            speed,
        }
    });
    Obstacle {
        id,
        class: Class::Car,
        is_static: false,
        length: 4.5,
        width: 1.8,
        states: states.collect(),
    }
}

fn ego(x: f64, y: f64, speed: f64) -> Participant {
    let pose = Pose {
        position: Vec2::new(x, y),
        yaw: 0.0,
    };
    Participant {
        footprint: Footprint {
            pose,
            length: 4.5,
            width: 1.6,
        },
        speed,
        acceleration: 0.0,
    }
}

/// Runs for `seconds` with an ego that keeps its lane and speed; calls `look` at each step.
fn run(
    drop: Option<f64>,
    recordings: Vec<Obstacle>,
    start: Participant,
    seconds: f64,
    mut look: impl FnMut(f64, &[RoadUser], &Participant),
) {
    let mut traffic = Traffic::new(road(drop), recordings.into(), &start);
    for step in 1..=(seconds / STEP) as u32 {
        let t = f64::from(step) * STEP;
        let frame = start.footprint.pose.frame();
        let footprint = Deviating::new(0, start, &frame).predicted(t);
        let ego = Participant { footprint, ..start };
        traffic.step(t, STEP, &ego);
        look(t, traffic.vehicles(), &ego);
    }
}

#[test]
fn a_recording_is_replayed_and_goes_on_smoothly_when_it_ends() {
    let recording = car(1, 2.0, |t| (50.0 + 20.0 * t, 4.0 - 0.5 * t));
    let mut before: Option<Participant> = None;
    run(
        None,
        vec![recording],
        ego(-200.0, 0.0, 20.0),
        20.0,
        |t, vehicles, _| {
            let now = vehicles[0].participant;
            assert_eq!(
                vehicles[0].mode,
                if t <= 2.0 {
                    Movement::Replay
                } else {
                    Movement::Driving
                },
                "{t}"
            );
            if let Some(before) = before.filter(|_| t > 0.3) {
                let moved = (now.footprint.pose.position - before.footprint.pose.position).norm();
                assert!(
                    (moved / STEP - now.speed).abs() < 0.1,
                    "{t}: {moved} {}",
                    now.speed
                );
                assert!(
                    wrap_angle(now.footprint.pose.yaw - before.footprint.pose.yaw).abs() < 0.004
                );
                assert!((now.speed - before.speed).abs() < 0.02);
            }
            before = Some(now);
            if t > 15.0 {
                assert!(
                    (vehicles[0].place.d).abs() < 0.05,
                    "in the middle of its lane"
                );
            }
        },
    );
}

#[test]
fn who_would_run_into_the_ego_stops_replaying() {
    // The ego stands where the recorded vehicle drives through at 25 m/s.
    let recording = car(1, 10.0, |t| (-150.0 + 25.0 * t, 0.0));
    let mut slowest = f64::INFINITY;
    run(
        None,
        vec![recording],
        ego(0.0, 0.0, 0.0),
        20.0,
        |_, vehicles, ego| {
            assert!(!vehicles[0].participant.footprint.overlaps(&ego.footprint));
            slowest = vehicles[0].participant.speed.min(slowest);
            assert!(vehicles[0].participant.acceleration > -5.0, "in time");
        },
    );
    assert!(slowest < 0.1);
}

#[test]
fn who_would_change_lanes_into_the_ego_stays_in_the_lane() {
    let recording = car(1, 8.0, |t| {
        (20.0 * t, 4.0 - 4.0 * ((t - 2.0) / 3.0).clamp(0.0, 1.0))
    });
    run(
        None,
        vec![recording.clone()],
        ego(1.0, 0.0, 20.0),
        15.0,
        |t, vehicles, ego| {
            assert!(
                !vehicles[0].participant.footprint.overlaps(&ego.footprint),
                "{t}"
            );
            assert_eq!(vehicles[0].lane, LaneId(1), "{t}");
        },
    );
    let mut lane = LaneId(1);
    run(
        None,
        vec![recording],
        ego(-60.0, 0.0, 20.0),
        15.0,
        |_, vehicles, _| {
            lane = vehicles[0].lane;
        },
    );
    assert_eq!(lane, LaneId(0), "with room it does change");
}

#[test]
fn who_has_to_leave_a_lane_that_ends_is_let_in() {
    let hardest = |drop| {
        let recording = car(1, 0.5, |t| (-3.0 + 20.0 * t, 4.0));
        let mut hardest = 0.0_f64;
        run(
            drop,
            vec![recording],
            ego(0.0, 0.0, 19.0),
            5.0,
            |_, vehicles, _| {
                hardest = hardest.min(vehicles[0].participant.acceleration);
            },
        );
        hardest
    };
    assert!(
        hardest(None) > -0.05,
        "beside a lane that continues no vehicle brakes"
    );
    let braking = hardest(Some(180.0));
    assert!((-1.51..-1.0).contains(&braking), "gently: {braking}");
}

#[test]
fn who_is_off_the_middle_waits_beside_a_vehicle_that_is_in_the_way() {
    // Side by side, half in lane 0: neither may move to the lane's middle before they are apart.
    let gain = |speed: f64| {
        let right = car(1, 0.5, |t| (20.0 * t, -1.0));
        let left = car(2, 0.5, |t| (1.0 + speed * t, 1.4));
        let mut places = Vec::new();
        run(
            None,
            vec![right, left],
            ego(-300.0, 0.0, 10.0),
            30.0,
            |t, vehicles, _| {
                let [right, left] = vehicles else {
                    panic!("{vehicles:?}")
                };
                let (right, left) = (right.participant, left.participant);
                assert!(!right.footprint.overlaps(&left.footprint), "{t}");
                assert!(left.acceleration.min(right.acceleration) > -3.0, "{t}");
                places = vehicles.iter().map(|v| v.place.d.abs()).collect();
            },
        );
        places
    };
    assert!(gain(23.0).iter().all(|d| *d < 0.2), "apart at last");
    assert!(gain(20.0).iter().all(|d| *d > 0.8), "side by side for ever");
}

#[test]
fn a_vehicle_stops_at_the_end_of_its_lane() {
    let recording = car(1, 0.5, |t| (20.0 * t, 0.0));
    let mut last = None;
    run(
        Some(300.0),
        vec![recording],
        ego(-400.0, 4.0, 0.0),
        60.0,
        |_, vehicles, _| {
            last = Some(vehicles[0].participant);
        },
    );
    let last = last.unwrap();
    let bumper = last.footprint.pose.position.x + 2.25;
    assert!(
        last.speed < 0.1 && (290.0..301.0).contains(&bumper),
        "{last:?}"
    );
}

/// A vehicle that certainly passes is not a leader and does not block the return to the middle.
#[test]
fn one_that_passes_is_no_leader_and_blocks_nothing() {
    let (mut passed, mut meets) = (0, 0);
    let road = road(Some(300.0));
    let sides = (-8..=8).map(|side| f64::from(side) * 0.7);
    for (y, other_y) in sides
        .clone()
        .flat_map(|y| sides.clone().map(move |it| (y, it)))
    {
        for yaw in [-0.4, -0.02, 0.0, 0.1, 2.9] {
            let recordings = vec![car(1, 1.0, |t| (10.0 * t, y))];
            let traffic = Traffic::new(Arc::clone(&road), recordings.into(), &ego(-90.0, 9.0, 0.0));
            let mut vehicle = traffic.vehicles[0].clone();
            vehicle.lateral_speed = 0.3;
            let mut other = ego(20.0, other_y, 15.0);
            other.footprint.pose.yaw = yaw;
            let viewer = Viewer::new(&traffic.road, &vehicle);
            let see = |passes| {
                let mut views = Views::default();
                views.renew(other.footprint.pose.frame().forward());
                viewer.see(&other, &mut views, passes)
            };
            let seen = see(false).unwrap();
            let matters = sight::ahead(&vehicle, &other, &seen).is_some()
                || sight::blocks_return(&vehicle, &other, &seen);
            let passes = see(true).is_none();
            assert!(!(matters && passes), "{y} {other_y} {yaw}");
            passed += u32::from(passes);
            meets += u32::from(matters);
        }
    }
    assert!(passed > 200 && meets > 200, "{passed} {meets}");
}
