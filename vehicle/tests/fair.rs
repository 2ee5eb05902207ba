//! Every scenario can be driven: a reference driver with perfect knowledge drives 60 s through
//! each. With any behaviour of the ego, the others do not collide with each other or hit the ego
//! from behind.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod recorded;
mod reference;

use recorded::scenarios;
use reference::{Manner, ReferenceDriver};
use tandem_vehicle::geometry::Footprint;
use tandem_vehicle::{Scenario, World, WorldConfig, WorldSnapshot};

const MS: u64 = 1_000_000;

/// Drives 60 s of a scenario and checks every 5 ms.
fn drive(scenario: &Scenario, manner: Manner, mut look: impl FnMut(&WorldSnapshot)) -> World {
    let mut world = World::new(scenario, WorldConfig { seed: 1 });
    let mut driver = ReferenceDriver::new(manner);
    for ms in 0..60_000 {
        if ms % 10 == 0 {
            let frame = driver.control(&world);
            world.on_frame(ms * MS, u32::from(frame.id), frame.data());
        }
        world.step(ms * MS, &mut |_, _| {});
        if ms % 5 == 0 {
            look(world.snapshot());
        }
    }
    world
}

/// Returns the first two other vehicles that overlap.
fn overlapping(now: &WorldSnapshot) -> Option<(i64, i64)> {
    let footprint = |v: &tandem_vehicle::VehicleSnapshot| Footprint {
        pose: v.pose,
        length: v.length,
        width: v.width,
    };
    let others = now.vehicles.iter().enumerate();
    others
        .flat_map(|(i, a)| now.vehicles[i + 1..].iter().map(move |b| (a, b)))
        .find_map(|(a, b)| footprint(a).overlaps(&footprint(b)).then_some((a.id, b.id)))
}

#[test]
fn every_scenario_can_be_driven() {
    for scenario in scenarios() {
        let name = scenario.name();
        let world = drive(&scenario, Manner::Normal, |now| {
            assert_eq!(overlapping(now), None, "{name} at {} s", now.time_s);
        });
        let metrics = world.metrics();
        println!("{name}: {metrics:#.2?}");
        assert_eq!(metrics.collisions, 0, "{name}");
        assert!(metrics.lateral_error_max_m < 0.4, "{name} {metrics:?}");
        assert!(metrics.deceleration_max < 8.0, "{name} {metrics:?}");
        assert!(metrics.distance_m > 400.0, "{name} {metrics:?}");
        assert!(world.snapshot().time_s > 59.9);
    }
}

/// The scenarios are realistic: no vehicle needs to brake harder than in real traffic, except in
/// the scenario about hard braking.
#[test]
fn embedded_scenarios_are_fair() {
    for name in Scenario::names() {
        let mut hardest = 0.0_f64;
        let scenario = Scenario::load(name).unwrap();
        let world = drive(&scenario, Manner::Normal, |now| {
            hardest = now
                .vehicles
                .iter()
                .fold(hardest, |least, v| least.min(v.acceleration));
        });
        let (own, others) = if name == "hard-braking" {
            (7.0, 7.1)
        } else {
            (4.0, 3.5)
        };
        let metrics = world.metrics();
        assert!(metrics.deceleration_max < own, "{name} {metrics:?}");
        assert!(-hardest < others, "{name} {hardest}");
    }
}

/// Replayed vehicles give way to an ego that is not where it was when they were recorded.
#[test]
fn the_others_cope_with_every_kind_of_ego() {
    for scenario in scenarios() {
        for manner in [
            Manner::StopsInLane,
            Manner::Dawdles,
            Manner::ChangesLanes,
            Manner::Absent,
        ] {
            let name = format!("{} {manner:?}", scenario.name());
            let mut hit = false;
            drive(&scenario, manner, |now| {
                assert_eq!(overlapping(now), None, "{name} at {} s", now.time_s);
                hit |= now.collides;
            });
            assert!(!hit, "{name}: the ego was hit");
        }
    }
}
