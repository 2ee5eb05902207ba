//! The driving functions in a closed loop with the world: every scenario, several seeds, virtual
//! time.

mod drive;
#[path = "../../vehicle/tests/recorded/mod.rs"]
mod recorded;

use drive::{Drive, Function, System};
use tandem_bus::{CameraLanes, SensorId};
use tandem_cores::driving::knowledge::Knowledge;
use tandem_cores::driving::types::{Maneuver, Object};
use tandem_vehicle::Scenario;

/// Duration of every scenario, s.
const SECONDS: f64 = 60.0;
/// When a fault hits the controller, s: the events of scenarios happen around this time too.
const EVENT_S: f64 = 24.0;
/// Comfort limits of a scenario without an emergency, m/s², m/s³.
const COMFORT_BRAKING: f64 = 3.2;
const COMFORT_JERK: f64 = 3.5;

/// Scenarios in which another vehicle makes hard braking necessary.
fn is_emergency(scenario: &Scenario) -> bool {
    ["cut-in", "hard-braking"].contains(&scenario.name())
}

/// The checks that every run must pass, with any fault of the controller.
fn assert_safe(scenario: &Scenario, seed: u64, drive: &Drive) {
    let m = drive.metrics();
    let run = format!("{} seed {seed}: {m:?}", scenario.name());
    assert_eq!(m.collisions, 0, "{run}");
    // The recorded ego of the A9 starts in a lane change, off the centre by more than this.
    assert!(m.lateral_error_max_m < 0.31, "{run}");
    assert!(m.lateral_acceleration_max < 2.5, "{run}");
    assert!(m.acceleration_max < 2.2, "{run}");
    assert!(m.gap_min_m > 2.0, "{run}");
}

/// T-CHIP-3: perception, planning and control drive every scenario without a collision and in
/// comfort.
#[test]
fn l3_drives_every_scenario() {
    for scenario in recorded::scenarios() {
        for seed in 1..=3 {
            let mut drive = Drive::new(&scenario, seed, 1);
            drive.run(SECONDS, &mut |_, _, _| {});
            assert_safe(&scenario, seed, &drive);
            let m = drive.metrics();
            if !is_emergency(&scenario) {
                let run = format!("{} seed {seed}: {m:?}", scenario.name());
                assert!(m.deceleration_max < COMFORT_BRAKING, "{run}");
                assert!(m.jerk_p99 < COMFORT_JERK, "{run}");
            }
        }
    }
}

/// The vehicle overtakes a slower leader, and leaves a lane that ends without stopping.
#[test]
fn l3_changes_lanes_where_it_helps() {
    for (name, distance_m) in [("slow-leader", 1_800.0), ("lane-drop", 1_500.0)] {
        let scenario = Scenario::load(name).unwrap();
        for seed in 5..=6 {
            let mut drive = Drive::new(&scenario, seed, 1);
            drive.run(SECONDS, &mut |_, _, _| {});
            let m = drive.metrics();
            assert_eq!(m.lane_changes, 1, "{name} seed {seed}: {m:?}");
            assert!(m.distance_m > distance_m, "{name} seed {seed}: {m:?}");
        }
    }
}

/// T-CHIP-3: the L2 functions keep lane and distance in every scenario, and stop where the lane
/// ends.
#[test]
fn l2_drives_every_scenario() {
    for scenario in recorded::scenarios() {
        for seed in 1..=2 {
            let mut drive = Drive::new(&scenario, seed, 1);
            drive.function = Function::L2;
            drive.run(SECONDS, &mut |_, _, _| {});
            assert_safe(&scenario, seed, &drive);
            let m = drive.metrics();
            let run = format!("{} seed {seed}: {m:?}", scenario.name());
            assert_eq!(m.lane_changes, 0, "{run}");
            assert!(m.deceleration_max < 5.0, "{run}");
            if scenario.name() == "lane-drop" {
                let world = drive.world.snapshot();
                assert!(world.speed < 0.1 && world.gap > 5.0, "{run}");
            }
        }
    }
}

/// When core 2 dies during the drive, core 0 switches to the L2 functions without a jump.
#[test]
fn degrades_amid_the_drive() {
    for scenario in recorded::scenarios() {
        let seed = 11;
        let mut drive = Drive::new(&scenario, seed, 1);
        drive.run(EVENT_S, &mut |_, _, _| {});
        drive.systems[0].planning_is_dead = true;
        drive.run(SECONDS - EVENT_S, &mut |_, _, _| {});
        assert_eq!(drive.produced, Some(Function::L2));
        // A change of lanes may have been under way. The vehicle then keeps the lane that it is in,
        // so its offset is not an error.
        let m = drive.metrics();
        let run = format!("{} seed {seed}: {m:?}", scenario.name());
        assert_eq!(m.collisions, 0, "{run}");
        assert!(m.lateral_acceleration_max < 3.0, "{run}");
        let step = drive.largest_step;
        assert!(
            step.steering_angle < 0.0035 && step.acceleration < 0.5,
            "{run} {step:?}"
        );
    }
}

/// T-CHIP-7: the standby computes silently; when it takes over, passengers notice nothing.
#[test]
fn a_takeover_is_not_felt() {
    for scenario in recorded::scenarios() {
        let seed = 11;
        let mut alone = Drive::new(&scenario, seed, 1);
        alone.run(SECONDS, &mut |_, _, _| {});
        let mut pair = Drive::new(&scenario, seed, 2);
        pair.run(EVENT_S, &mut |_, _, _| {});
        pair.master = 1;
        pair.run(SECONDS - EVENT_S, &mut |_, _, _| {});
        assert_safe(&scenario, seed, &pair);
        let (m, other) = (pair.metrics(), alone.metrics());
        let run = format!(
            "{} seed {seed}: {m:?} instead of {other:?}",
            scenario.name()
        );
        assert!(m.deceleration_max < other.deceleration_max + 0.7, "{run}");
        assert!(
            m.lateral_acceleration_max < other.lateral_acceleration_max + 0.3,
            "{run}"
        );
    }
}

/// T-CHIP-5: a system that joins as the vehicle ahead begins to brake detects this in its first
/// cycle if it receives knowledge. False knowledge creates no object, even if the system's sensors
/// cannot contradict it at once. A second later, when commands begin to be compared, all systems
/// have the same knowledge.
#[test]
fn what_is_told_sharpens_the_own_sensors_and_invents_nothing() {
    let mut drive = Drive::new(&Scenario::load("hard-braking").unwrap(), 3, 1);
    drive.run(11.0, &mut |_, _, _| {});
    let truth = drive.systems[0].perception.scene().clone();
    let ghost = Object {
        x: 9.0,
        y: 0.0,
        vx: 0.0,
        ..truth.objects[0]
    };
    let lie = |lie: fn(&mut Object)| {
        let mut scene = truth.clone();
        scene.objects.iter_mut().for_each(lie);
        if scene.objects.push(ghost).is_err() {
            scene.objects[0] = ghost;
        }
        if let Some(lanes) = &mut scene.lanes {
            lanes.c[0] += 0.2;
        }
        Knowledge::of(&scene, None)
    };
    let reported = [
        None,
        Some(drive.systems[0].knowledge()),
        Some(lie(|object| object.ax = -9.0)),
        Some(lie(|object| (object.vx, object.y) = (0.0, 0.5))),
        Some(lie(|object| (object.ax, object.approaching) = (4.0, 255))),
    ];
    for reported in reported {
        let mut system = System::new();
        system.reported = reported;
        drive.systems.push(system);
    }
    let mut worst = vec![[0.0_f32; 2]; drive.systems.len()];
    for cycle in 0..24 {
        drive.run(0.05, &mut |_, _, _| {});
        let known = drive.systems[0].perception.scene();
        for (system, worst) in drive.systems.iter().zip(&mut worst).skip(1) {
            let scene = system.perception.scene();
            for object in &scene.objects {
                let near = |one: &&Object| (one.x - object.x).abs() < 3.0;
                let Some(same) = known.objects.iter().find(near) else {
                    panic!("cycle {cycle}: {object:?} is not there");
                };
                let late = usize::from(cycle >= 20);
                worst[late] = worst[late].max((same.ax - object.ax).abs());
            }
            let (ours, theirs) = (scene.lanes.unwrap(), known.lanes.unwrap());
            assert!((ours.c[0] - theirs.c[0]).abs() < 0.1, "cycle {cycle}");
        }
    }
    println!("difference of accelerations, at first and after 1 s, m/s²: {worst:?}");
    assert!(worst[1][0] > 3.0 && worst[2][0] < 1.5, "{worst:?}");
    assert!(worst.iter().all(|[_, late]| *late < 0.3), "{worst:?}");
}

/// T-CHIP-5: a system that joins during a lane change continues it if it receives knowledge.
/// Without knowledge it would plan to keep the lane.
#[test]
fn a_plan_is_continued_by_a_system_that_joins() {
    let mut drive = Drive::new(&Scenario::load("slow-leader").unwrap(), 5, 1);
    let changes = |drive: &Drive| {
        let trajectory = drive.systems.last().unwrap().trajectory.as_ref();
        trajectory.is_some_and(|it| it.maneuver == Maneuver::ChangeLeft)
    };
    while !changes(&drive) {
        drive.run(0.05, &mut |_, _, _| {});
    }
    drive.run(1.0, &mut |_, _, _| {});
    let knowledge = drive.systems[0].knowledge();
    assert!(knowledge.plan.is_some());
    for reported in [None, Some(knowledge)] {
        let mut system = System::new();
        system.reported = reported;
        drive.systems.push(system);
        drive.run(0.2, &mut |_, _, _| {});
        let aside = |system: &System| system.trajectory.as_ref().unwrap().points[20].y;
        let difference = (aside(&drive.systems[0]) - aside(drive.systems.last().unwrap())).abs();
        println!("aside in 2 s: {difference} m");
        let is_told = drive.systems.len() == 3;
        assert_eq!(changes(&drive), is_told);
        assert!((difference < 0.1) == is_told, "{difference} m");
    }
}

/// Any single sensor may be missing for the whole drive; the camera's lanes may be missing for a
/// while.
#[test]
fn drives_without_any_one_sensor() {
    for name in ["cut-in", "hard-braking"] {
        let scenario = Scenario::load(name).unwrap();
        for sensor in SensorId::ALL {
            let mut drive = Drive::new(&scenario, 1, 1);
            drive.lost = vec![sensor.header_id(), sensor.object_id()];
            drive.run(SECONDS, &mut |_, _, _| {});
            assert_eq!(drive.metrics().collisions, 0, "{name} without {sensor:?}");
        }
        let mut drive = Drive::new(&scenario, 1, 1);
        drive.run(EVENT_S, &mut |_, _, _| {});
        drive.lost = vec![CameraLanes::ID];
        drive.run(2.0, &mut |_, _, _| {});
        assert!(drive.systems[0].perception.scene().lanes.is_none());
        drive.lost.clear();
        drive.run(SECONDS - EVENT_S - 2.0, &mut |_, _, _| {});
        assert_eq!(drive.metrics().collisions, 0, "{name} with a blind camera");
    }
}

/// With only the chassis sensors left, the vehicle stops.
#[test]
fn a_safe_stop_stops() {
    let scenario = Scenario::load("free-lane").unwrap();
    let mut drive = Drive::new(&scenario, 1, 1);
    drive.run(EVENT_S, &mut |_, _, _| {});
    drive.function = Function::SafeStop;
    drive.run(20.0, &mut |_, _, _| {});
    let m = drive.metrics();
    assert!(drive.world.snapshot().speed < 0.1);
    assert!(m.deceleration_max < 3.0, "{m:?}");
    assert_eq!(m.collisions, 0);
}

/// The same frames at the same times give bit-identical commands.
#[test]
fn deterministic() {
    let commands = || {
        let mut drive = Drive::new(&Scenario::load("cut-in").unwrap(), 7, 1);
        let mut bits = Vec::new();
        drive.run(20.0, &mut |_, _, command| {
            bits.push((
                command.steering_angle.to_bits(),
                command.acceleration.to_bits(),
            ));
        });
        bits
    };
    assert_eq!(commands(), commands());
}
