//! Tests each driving function alone, with inputs made by hand.
#![allow(clippy::unwrap_used)]

use tandem_board::{Duration, Instant};
use tandem_bus::{
    CameraLanes, ClassCode, DriverRequest, EgoMotion, Message, RouteCode, SensorHeader, SensorId,
    SensorObject, TimeStateCode,
};
use tandem_cores::driving::control::{ControlError, MotionControl, TRAJECTORY_MAX_AGE};
use tandem_cores::driving::degraded::DegradedControl;
use tandem_cores::driving::perception::{GlobalClock, Perception};
use tandem_cores::driving::planning::Planner;
use tandem_cores::driving::types::{
    CameraLine, Command, Ego, Lanes, Maneuver, Object, Scene, Trajectory,
};

const CYCLE: Duration = Duration::from_ms(50);

fn at_ms(ms: u64) -> Instant {
    Instant::ORIGIN + Duration::from_ms(1_000 + ms)
}

/// Feeds perception with a straight three-lane road and an ego that moves as the test specifies.
struct Feed {
    perception: Perception,
    now: Instant,
    speed: f32,
    yaw_rate: f32,
}

impl Feed {
    fn new(speed: f32) -> Self {
        Self {
            perception: Perception::new(),
            now: at_ms(0),
            speed,
            yaw_rate: 0.0,
        }
    }

    /// Runs a cycle in which these sensors see these objects; `lanes` if the camera sees the road.
    fn cycle(&mut self, seen: &[(SensorId, &[SensorObject])], lanes: bool) -> &Scene {
        for step in 0..5 {
            let motion = EgoMotion {
                world_running: true,
                speed: self.speed,
                yaw_rate: self.yaw_rate,
                ..EgoMotion::default()
            };
            let at = self.now + Duration::from_ms(10 * step);
            self.perception.on_message(at, &Message::EgoMotion(motion));
        }
        self.now += CYCLE;
        for (sensor, objects) in seen {
            let header = SensorHeader {
                object_count: objects.len() as u8,
                ..SensorHeader::default()
            };
            self.perception
                .on_message(self.now, &Message::SensorHeader(*sensor, header));
            for object in *objects {
                self.perception
                    .on_message(self.now, &Message::SensorObject(*sensor, *object));
            }
        }
        if lanes {
            let lanes = CameraLanes {
                valid: true,
                left_exists: true,
                right_exists: true,
                view_range: 80,
                width: 3.5,
                left_width: 3.5,
                right_width: 3.5,
                own_end: CameraLanes::NO_END,
                left_end: CameraLanes::NO_END,
                right_end: CameraLanes::NO_END,
                speed_limit: CameraLanes::NO_SPEED_LIMIT,
                ..CameraLanes::default()
            };
            self.perception
                .on_message(self.now, &Message::CameraLanes(lanes));
        }
        self.perception.cycle(self.now)
    }
}

fn seen(x: f32, y: f32, vx: f32, vy: f32) -> SensorObject {
    SensorObject {
        x,
        y,
        vx,
        vy,
        class: ClassCode::Unknown,
        length: 4.5,
        width: 1.8,
        x_deviation: 0.2,
        y_deviation: 0.2,
        ..SensorObject::default()
    }
}

/// T-CHIP-4: an object that two sensors see is confirmed at once, with its velocity over ground and
/// class.
#[test]
fn two_sensors_confirm_one_object_at_once() {
    let mut feed = Feed::new(20.0);
    let radar = [seen(40.0, 0.2, -5.0, 0.0)];
    let camera = [SensorObject {
        class: ClassCode::Truck,
        ..seen(40.5, 0.1, -5.2, 0.0)
    }];
    let both: [(SensorId, &[SensorObject]); 2] = [
        (SensorId::RadarFront, &radar),
        (SensorId::CameraFront, &camera),
    ];
    let scene = feed.cycle(&both, true);
    assert_eq!(scene.objects.len(), 1, "{scene:?}");
    let object = scene.objects[0];
    assert!(
        (object.x - 40.0).abs() < 1.0 && (object.vx - 15.0).abs() < 0.5,
        "{object:?}"
    );
    assert_eq!((object.class, object.lane), (ClassCode::Truck, 0));
}

/// One sensor alone needs three cycles; the track keeps its identity, coasts over gaps, and ends.
#[test]
fn a_track_begins_coasts_and_ends() {
    let mut feed = Feed::new(20.0);
    let mut x = 50.0;
    let mut id = None;
    for cycle in 0..20 {
        let radar = [seen(x, 3.4, -4.0, 0.0)];
        // Missed in some cycles.
        let seen: &[(SensorId, &[SensorObject])] = if cycle > 5 && cycle % 4 == 0 {
            &[]
        } else {
            &[(SensorId::RadarFront, &radar)]
        };
        let scene = feed.cycle(seen, true);
        assert_eq!(scene.objects.is_empty(), cycle < 2, "cycle {cycle}");
        if let Some(object) = scene.objects.first() {
            assert_eq!(*id.get_or_insert(object.id), object.id);
            assert!((object.x - x).abs() < 0.5 && object.lane == 1, "{object:?}");
        }
        x -= 4.0 * 0.05;
    }
    for _ in 0..20 {
        feed.cycle(&[], true);
    }
    assert!(feed.perception.scene().objects.is_empty());
}

/// When the ego turns, objects beside the road still count as standing.
#[test]
fn the_own_motion_is_compensated() {
    let mut feed = Feed::new(10.0);
    feed.yaw_rate = 0.3;
    let (mut heading, mut ego) = (0.0_f32, (0.0_f32, 0.0_f32));
    for _ in 0..30 {
        // An object at (60, 20) in the plane, seen from an ego on a circle.
        let middle = heading + 0.5 * 0.3 * 0.05;
        ego = (ego.0 + 0.5 * middle.cos(), ego.1 + 0.5 * middle.sin());
        heading += 0.3 * 0.05;
        let (dx, dy) = (60.0 - ego.0, 20.0 - ego.1);
        let (sine, cosine) = heading.sin_cos();
        let radar = [seen(
            cosine * dx + sine * dy,
            cosine * dy - sine * dx,
            -10.0,
            0.0,
        )];
        feed.cycle(&[(SensorId::RadarFront, &radar)], false);
    }
    let object = feed.perception.scene().objects[0];
    assert!(object.vx.abs() < 0.6 && object.vy.abs() < 0.6, "{object:?}");
}

/// The camera may be blind for 300 ms; after that there are no lanes until it sees again.
#[test]
fn lanes_are_carried_along_and_then_given_up() {
    let mut feed = Feed::new(20.0);
    assert!(feed.cycle(&[], true).lanes.is_some());
    for _ in 0..6 {
        assert!(feed.cycle(&[], false).lanes.is_some());
    }
    assert!(feed.cycle(&[], false).lanes.is_none());
    assert!(feed.cycle(&[], true).lanes.is_some());
}

/// A vehicle that cuts in from the next lane is reported before it is in the ego lane.
#[test]
fn a_cut_in_is_foreseen() {
    let mut feed = Feed::new(25.0);
    let mut y = 3.5;
    let mut foreseen_at = None;
    for _ in 0..40 {
        let radar = [seen(25.0, y, -1.0, -1.0)];
        let both: [(SensorId, &[SensorObject]); 2] = [
            (SensorId::RadarFront, &radar),
            (SensorId::RadarFrontLeft, &radar),
        ];
        if feed.cycle(&both, true).objects[0].cuts_in {
            foreseen_at.get_or_insert(y);
        }
        y -= 0.05;
    }
    assert!(foreseen_at.is_some_and(|y| y > 2.4), "{foreseen_at:?}");
}

/// The start and the end of the driver's request reach the scene.
#[test]
fn the_drivers_request_is_passed_on() {
    let mut feed = Feed::new(25.0);
    for engage in [true, false] {
        let request = DriverRequest {
            overrides: false,
            route: RouteCode::Left,
            near_gap: engage,
            park: false,
            engage,
            set_speed: 30.0,
            lane_offset: -0.3,
        };
        feed.perception
            .on_message(feed.now, &Message::DriverRequest(request));
        let scene = feed.cycle(&[], true);
        assert_eq!((scene.route, scene.near_gap), (RouteCode::Left, engage));
        assert_eq!(scene.lane_offset, -0.3);
        let set = scene.set_speed;
        assert_eq!(set.is_some_and(|set| (set - 30.0).abs() < 0.01), engage);
    }
}

fn lanes() -> Lanes {
    Lanes {
        left: Some(3.5),
        ..Lanes::alone(3.5, 80.0)
    }
}

fn scene(ms: u64, speed: f32, objects: &[Object]) -> Scene {
    Scene {
        at: at_ms(ms),
        moment: None,
        measured: at_ms(ms),
        cycle: (ms / 50) as u32,
        missing: 0,
        ego: Ego {
            speed,
            ..Ego::default()
        },
        lanes: Some(lanes()),
        camera: CameraLine::default(),
        set_speed: Some(30.0),
        route: RouteCode::Free,
        near_gap: false,
        lane_offset: 0.0,
        objects: objects.iter().copied().collect(),
    }
}

fn object(x: f32, y: f32, vx: f32) -> Object {
    Object {
        id: 1,
        class: ClassCode::Car,
        x,
        y,
        vx,
        vy: 0.0,
        ax: 0.0,
        ay: 0.0,
        length: 4.5,
        width: 1.8,
        lane: 0,
        cuts_in: false,
        approaching: 0,
    }
}

fn is_finite(trajectory: &Trajectory) -> bool {
    trajectory.points.iter().all(|p| {
        [p.x, p.y, p.heading, p.curvature, p.speed, p.acceleration]
            .iter()
            .all(|v| v.is_finite())
    })
}

/// A new plan begins on the old one, although the measurements are noisy.
#[test]
fn plans_join_each_other() {
    let mut planner = Planner::new();
    let mut last: Option<Trajectory> = None;
    for cycle in 0..60 {
        let noise = if cycle % 2 == 0 { 0.15 } else { -0.15 };
        let speed = last
            .as_ref()
            .map_or(25.0, |t| 0.5 * (t.points[0].speed + t.points[1].speed));
        let mut scene = scene(
            cycle * 50,
            speed + noise,
            &[object(70.0, noise, 24.0 + noise)],
        );
        scene.lanes.as_mut().unwrap().c[0] = 0.1 * noise;
        let plan = planner.plan(&scene);
        assert!(is_finite(&plan));
        if let Some(last) = last {
            let middle = |f: fn(&tandem_cores::driving::types::TrajectoryPoint) -> f32| {
                0.5 * (f(&last.points[0]) + f(&last.points[1]))
            };
            let first = plan.points[0];
            assert!(
                (first.speed - middle(|p| p.speed)).abs() < 0.05,
                "cycle {cycle}"
            );
            assert!(
                (first.acceleration - middle(|p| p.acceleration)).abs() < 0.1,
                "{cycle}"
            );
            assert!(
                (first.curvature - middle(|p| p.curvature)).abs() < 5e-4,
                "{cycle}"
            );
        }
        last = Some(plan);
    }
}

/// The plan stops in front of a standing obstacle. If it is too near for comfort, the plan brakes
/// as hard as it can.
#[test]
fn brakes_for_a_standing_obstacle() {
    let mut scene = scene(0, 20.0, &[object(45.0, 0.0, 0.0)]);
    scene.lanes.as_mut().unwrap().left = None;
    let plan = Planner::new().plan(&scene);
    assert_eq!(plan.maneuver, Maneuver::Brake);
    let last = plan.points[40];
    assert!(last.speed < 0.5 && last.x < 45.0 - 4.5, "{last:?}");
}

/// The vehicle brakes for a road user that comes towards it or crosses its way if they would meet,
/// but not for one that is in the lane at another time, or seems to be far away.
#[test]
fn only_who_would_be_met_is_braked_for() {
    let moving = |x: f32, y: f32, vx: f32, vy: f32| Object {
        vy,
        ..object(x, y, vx)
    };
    for (name, speed, met, brakes) in [
        (
            "comes, in its lane",
            12.5,
            moving(31.0, 2.6, -11.6, -0.6),
            false,
        ),
        (
            "comes, in three seconds",
            12.5,
            moving(66.0, 1.6, -11.6, 0.0),
            false,
        ),
        (
            "comes, far away",
            12.5,
            moving(85.0, 1.6, -13.8, 0.0),
            false,
        ),
        (
            "comes, in the own lane",
            12.5,
            moving(50.0, 0.2, -11.6, 0.0),
            true,
        ),
        (
            "turns off, far away",
            8.0,
            moving(83.0, -2.7, -15.7, -6.3),
            false,
        ),
        (
            "crosses behind",
            10.0,
            moving(10.0, 12.0, -1.0, -4.0),
            false,
        ),
        ("crosses before", 10.0, moving(40.0, -8.0, 0.5, 6.0), false),
        (
            "crosses in the way",
            10.0,
            moving(20.0, -7.0, 0.0, 3.5),
            true,
        ),
    ] {
        let mut scene = scene(0, speed, &[met]);
        scene.lanes.as_mut().unwrap().left = None;
        scene.set_speed = Some(speed);
        let plan = Planner::new().plan(&scene);
        let hardest = plan.points.iter().map(|p| p.acceleration);
        let hardest = hardest.fold(0.0, f32::min);
        assert_eq!(hardest < -1.0, brakes, "{name}: {hardest}");
    }
}

/// The driver may ask for the shorter distance, and for a place in the lane where it has room.
#[test]
fn the_driver_chooses_distance_and_place() {
    let plan = |near_gap: bool, lane_offset: f32| {
        let mut scene = scene(0, 20.0, &[object(29.5, 0.0, 20.0)]);
        scene.lanes.as_mut().unwrap().left = None;
        Planner::new().plan(&Scene {
            near_gap,
            lane_offset,
            ..scene
        })
    };
    let [far, near] = [false, true].map(|near| plan(near, 0.0).points[40].speed);
    assert!(far < 19.7 && near > 19.9, "{far} {near}");
    // The lane is 3.5 m wide, the vehicle 1.6 m, and 0.2 m stay free.
    for (asked, expected) in [(0.0, 0.0), (-0.5, -0.5), (1.2, 0.75)] {
        let y = plan(false, asked).points[40].y;
        assert!((y - expected).abs() < 0.03, "{asked} {y}");
    }
}

/// From standstill, the vehicle uses a free lane beside it to pass a standing object. It stays if
/// there is no such lane or no room to turn out.
#[test]
fn from_standstill_a_free_lane_is_taken() {
    for (gap, left, expected) in [
        (9.0, Some(3.5), Maneuver::ChangeLeft),
        (9.0, None, Maneuver::Follow),
        (3.0, Some(3.5), Maneuver::Follow),
    ] {
        let mut planner = Planner::new();
        let mut last = Maneuver::Follow;
        for cycle in 0..24 {
            let mut scene = scene(1_000 + 50 * cycle, 0.0, &[object(4.5 + gap, 0.0, 0.0)]);
            scene.lanes.as_mut().unwrap().left = left;
            last = planner.plan(&scene).maneuver;
        }
        assert_eq!(last, expected, "{gap} {left:?}");
    }
}

/// Without lanes the plan follows the present curve and slows down.
#[test]
fn without_lanes_the_plan_slows_down() {
    let mut scene = scene(0, 20.0, &[]);
    (scene.lanes, scene.ego.yaw_rate) = (None, 0.1);
    let plan = Planner::new().plan(&scene);
    let last = plan.points[40];
    assert!(last.speed < 18.0 && last.y > 3.0, "{last:?}");
}

/// For any scene, the plan holds finite numbers and never moves backwards.
#[test]
fn every_scene_gives_a_plan() {
    let mut seed = 9_u32;
    let mut random = |from: f32, to: f32| {
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        from + (to - from) * (seed >> 8) as f32 / 16_777_216.0
    };
    let mut planner = Planner::new();
    for cycle in 0..500 {
        let objects: Vec<_> = (0..24)
            .map(|_| Object {
                vy: random(-5.0, 5.0),
                ax: random(-12.0, 5.0),
                ay: 0.0,
                length: random(0.0, 25.0),
                cuts_in: random(0.0, 1.0) > 0.5,
                approaching: 0,
                ..object(
                    random(-300.0, 300.0),
                    random(-40.0, 40.0),
                    random(-40.0, 60.0),
                )
            })
            .collect();
        let mut scene = scene(cycle * 50, random(-1.0, 60.0), &objects);
        scene.ego.yaw_rate = random(-1.0, 1.0);
        let lanes = scene.lanes.as_mut().unwrap();
        lanes.c = [
            random(-5.0, 5.0),
            random(-1.6, 1.6),
            random(-0.03, 0.03),
            random(-3e-4, 3e-4),
        ];
        (lanes.view_range, lanes.width) = (random(0.0, 255.0), random(1.0, 5.0));
        lanes.own_end = random(-10.0, 400.0);
        let plan = planner.plan(&scene);
        assert!(is_finite(&plan), "cycle {cycle}: {plan:?}");
        assert!(plan.points.iter().all(|p| p.speed >= 0.0), "cycle {cycle}");

        let ego = scene.ego;
        let command = DegradedControl::new().step(scene.at, &ego, &scene);
        assert!(command.steering_angle.is_finite() && command.acceleration.is_finite());
    }
}

/// A trajectory is followed only while it is valid. An invalid trajectory is refused.
#[test]
fn control_refuses_old_and_broken_trajectories() {
    let plan = Planner::new().plan(&scene(0, 20.0, &[]));
    let ego = Ego {
        speed: 20.0,
        ..Ego::default()
    };
    let mut control = MotionControl::new();
    control.on_ego(plan.at, &ego);
    let last_moment = plan.at + TRAJECTORY_MAX_AGE;
    assert!(control.step(last_moment, &ego, &plan).is_ok());
    let late = control.step(last_moment + Duration::from_ms(1), &ego, &plan);
    assert_eq!(late, Err(ControlError::TrajectoryTooOld));

    let mut broken = plan.clone();
    for point in &mut broken.points {
        point.heading = f32::NAN;
    }
    let before = control.last();
    assert_eq!(
        control.step(plan.at, &ego, &broken),
        Err(ControlError::TrajectoryInvalid)
    );
    assert_eq!(control.last(), before);
}

/// T-RED-4: the system that takes over continues from the last command that the vehicle obeyed.
#[test]
fn every_function_goes_on_from_the_last_command() {
    let last = Command {
        steering_angle: 0.01,
        acceleration: -1.8,
    };
    let world = scene(0, 25.0, &[]);
    let ego = world.ego;
    let mut control = MotionControl::new();
    let mut degraded = DegradedControl::new();
    control.on_ego(world.at, &ego);
    control.resume(&last);
    degraded.resume(&last);
    let plan = Planner::new().plan(&world);
    let first = [
        control.step(world.at, &ego, &plan).unwrap(),
        degraded.step(world.at, &ego, &world),
    ];
    for command in first {
        assert!(
            (command.steering_angle - last.steering_angle).abs() < 1e-3,
            "{command:?}"
        );
        assert!(
            (command.acceleration - last.acceleration).abs() < 0.1,
            "{command:?}"
        );
    }
}

/// T-CHIP-4: lists are fused at the time of their measurement. Lists that the bus delayed are
/// predicted to the present. Treated as fresh, they would pull the object back by 0.8 m.
#[test]
fn a_list_that_was_held_back_is_fused_where_its_object_is_by_now() {
    let (speed, closing) = (25.0, -20.0);
    let mut perception = Perception::new();
    let truth = |at_ms: u64| 90.0 + closing * at_ms as f32 * 1e-3;
    let mut worst = 0.0_f32;
    for cycle in 1..=30_u64 {
        let measured_ms = cycle * 50;
        let held_back_ms = if cycle > 10 { 40 } else { 0 };
        for at in (measured_ms - 40..=measured_ms).step_by(10) {
            let motion = EgoMotion {
                world_running: true,
                speed,
                ..EgoMotion::default()
            };
            perception.on_message(at_ms(at), &Message::EgoMotion(motion));
        }
        let header = SensorHeader {
            object_count: 1,
            measured_at: (measured_ms * 1_000) as u32,
            ..SensorHeader::default()
        };
        let object = SensorObject {
            x: truth(measured_ms),
            vx: closing,
            class: ClassCode::Car,
            length: 4.5,
            width: 1.8,
            x_deviation: 0.1,
            y_deviation: 0.1,
            ..SensorObject::default()
        };
        let (arrives, radar) = (measured_ms + held_back_ms, SensorId::RadarFront);
        let list = |perception: &mut Perception| {
            perception.on_message(at_ms(arrives), &Message::SensorHeader(radar, header));
            perception.on_message(at_ms(arrives), &Message::SensorObject(radar, object));
        };
        // The cycle begins 1 ms before a delayed list arrives. The next cycle takes the list in,
        // when the tracks are 39 ms ahead of it.
        if held_back_ms == 0 {
            list(&mut perception);
        }
        let now_ms = measured_ms + 39;
        let scene = perception.cycle(at_ms(now_ms));
        if let (Some(found), true) = (scene.objects.first(), cycle > 12) {
            worst = worst.max((found.x - truth(now_ms)).abs());
        }
        if held_back_ms > 0 {
            list(&mut perception);
        }
    }
    assert!(worst > 0.0 && worst < 0.2, "{worst} m");
}

/// The route decides the lane: the vehicle changes to a free lane without a gain, keeps its own
/// lane behind a slow leader, and does not change lanes towards a vehicle beside it.
#[test]
fn the_route_leads_to_its_lane_when_there_is_room() {
    let slow = object(75.0, 0.0, 21.0);
    let beside = object(1.0, 3.5, 25.0);
    for (route, objects, expected) in [
        (RouteCode::Free, vec![], Maneuver::Follow),
        (RouteCode::Left, vec![], Maneuver::ChangeLeft),
        (RouteCode::Left, vec![beside], Maneuver::Follow),
        (RouteCode::Right, vec![], Maneuver::Follow),
        (RouteCode::Free, vec![slow], Maneuver::ChangeLeft),
        (RouteCode::Keep, vec![slow], Maneuver::Follow),
    ] {
        let mut planner = Planner::new();
        let mut last = Maneuver::Follow;
        for cycle in 0..24 {
            let scene = Scene {
                route,
                ..scene(1_000 + 50 * cycle, 25.0, &objects)
            };
            last = planner.plan(&scene).maneuver;
        }
        assert_eq!(last, expected, "{route:?} {objects:?}");
    }
}

/// Where the lane ends, the vehicle falls back behind one beside it that leaves no gap ahead of it
/// and that it cannot leave behind. Then it changes.
#[test]
fn the_vehicle_falls_back_where_another_is_beside_it() {
    let (speed, first) = (14.0, 40.0);
    for (beside, fast, falls_back) in [
        (1.0, false, true),
        (-1.0, false, true),
        (-5.5, false, true),
        (-5.5, true, false),
        (-20.0, false, false),
    ] {
        let objects = [object(first, 3.5, speed), object(beside, 3.5, speed)];
        let mut planner = Planner::new();
        let mut plan = None;
        for cycle in 0..24 {
            let scene = Scene {
                set_speed: Some(if fast { 20.0 } else { speed }),
                lanes: Some(Lanes {
                    own_end: 180.0,
                    ..lanes()
                }),
                ..scene(1_000 + 50 * cycle, speed, &objects)
            };
            plan = Some(planner.plan(&scene));
        }
        let plan = plan.unwrap();
        let last = plan.points[plan.points.len() - 1].speed;
        assert_eq!(
            last < speed - 0.5,
            falls_back,
            "{beside} {fast}: {last} m/s"
        );
        let changes = plan.maneuver == Maneuver::ChangeLeft;
        assert_eq!(changes, beside == -20.0, "{beside} {fast}");
    }
}

/// S-4: lanes that the camera measured before the newest list are moved with the vehicle: 20 ms at
/// 30 m/s are 0.6 m along a line that is 0.1 rad aside.
#[test]
fn lanes_that_are_older_than_a_list_are_moved_with_the_vehicle() {
    for (delay_ms, expected) in [(0, 0.0), (20, 0.06)] {
        let mut perception = Perception::new();
        let now = at_ms(1_000);
        let motion = EgoMotion {
            world_running: true,
            speed: 30.0,
            ..EgoMotion::default()
        };
        for ms in (900..=1_000).step_by(10) {
            perception.on_message(at_ms(ms), &Message::EgoMotion(motion));
        }
        let (global_us, state) = (7_000_000, TimeStateCode::Global);
        perception.set_global(GlobalClock::new(now, global_us.into(), Duration::ZERO));
        let header = SensorHeader {
            time_state: state,
            measured_at: global_us,
            object_count: 0,
        };
        perception.on_message(now, &Message::SensorHeader(SensorId::RadarFront, header));
        let lanes = CameraLanes {
            valid: true,
            c1: 0.1,
            view_range: 80,
            width: 3.5,
            time_state: state,
            measured_at: global_us - delay_ms * 1_000,
            ..CameraLanes::default()
        };
        perception.on_message(now, &Message::CameraLanes(lanes));
        let found = perception.cycle(now).lanes.unwrap().c[0];
        assert!((found - expected).abs() < 1e-3, "{found} m");
    }
}
