//! The driving functions in a closed loop with the world: every scenario, several seeds, virtual time.

mod drive;

use drive::{Drive, Function};

/// How long every scenario is driven, s.
const SECONDS: f64 = 60.0;

/// T-CHIP-3: perception, planning and control drive every scenario without a collision and in comfort.
#[test]
fn l3_drives_every_scenario() {
    for scenario in drive::scenarios() {
        for seed in 1..=3 {
            let mut drive = Drive::new(&scenario, seed, 1);
            drive.run(SECONDS, &mut |_, _, _| {});
            let m = drive.metrics();
            let run = format!("{} seed {seed}: {m:?}", scenario.name());
            assert_eq!(m.collisions, 0, "{run}");
            assert!(m.lateral_error_max_m < 0.35, "{run}");
            assert!(m.lateral_acceleration_max < 3.0, "{run}");
            assert!(m.acceleration_max < 2.5, "{run}");
        }
    }
}

/// T-CHIP-3: the L2 functions keep lane and distance in every scenario, whose lane may end.
#[test]
fn l2_drives_every_scenario() {
    for scenario in drive::scenarios() {
        for seed in 1..=3 {
            let mut drive = Drive::new(&scenario, seed, 1);
            drive.function = Function::L2;
            drive.run(SECONDS, &mut |_, _, _| {});
            let m = drive.metrics();
            let run = format!("{} seed {seed}: {m:?}", scenario.name());
            assert_eq!((m.collisions, m.lane_changes), (0, 0), "{run}");
            assert!(m.lateral_error_max_m < 0.35, "{run}");
        }
    }
}
