//! Every scenario can be driven: a reference driver with perfect knowledge drives 60 s through each.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod reference;

use std::path::Path;

use reference::ReferenceDriver;
use tandem_vehicle::geometry::Footprint;
use tandem_vehicle::{Config, Scenario, Snapshot, World};

const MS: u64 = 1_000_000;

/// Drives `seconds` of a scenario and looks at every 5 ms.
fn drive(scenario: &Scenario, seconds: u64, mut look: impl FnMut(&Snapshot)) -> World {
    let mut world = World::new(scenario, Config { seed: 1 });
    let mut driver = ReferenceDriver::new();
    for ms in 0..seconds * 1_000 {
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

fn overlapping(now: &Snapshot) -> Option<(i64, i64)> {
    let footprints: Vec<(i64, Footprint)> = now
        .vehicles
        .iter()
        .map(|v| {
            (
                v.id,
                Footprint {
                    pose: v.pose,
                    length: v.length,
                    width: v.width,
                },
            )
        })
        .collect();
    for (index, (id, a)) in footprints.iter().enumerate() {
        for (other, b) in &footprints[index + 1..] {
            if a.overlaps(b) {
                return Some((*id, *other));
            }
        }
    }
    None
}

/// Drives a scenario and prints and checks what makes it fair.
fn assert_fair(scenario: &Scenario) {
    let name = scenario.name();
    let mut crashes = Vec::new();
    let mut hardest: f64 = 0.0;
    let world = drive(scenario, 60, |now| {
        if std::env::var("TRACE").is_ok()
            && ((now.time_s * 1000.0).round() as u64).is_multiple_of(1000)
        {
            println!(
                "{:6.2} v {:5.2} a {:5.2} d {:5.2} lane {:?} gap {:6.1} vl {:5.2}",
                now.time_s,
                now.speed,
                now.acceleration,
                now.lateral_offset,
                now.lane,
                now.gap,
                now.leader_speed
            );
        }
        let new = |pair: &(i64, i64)| crashes.last().is_none_or(|(_, last)| last != pair);
        if let Some(pair) = overlapping(now).filter(new) {
            crashes.push((now.time_s, pair));
        }
        for v in &now.vehicles {
            hardest = hardest.min(v.acceleration);
        }
    });
    let metrics = world.metrics();
    println!("{name}: {metrics:#?} hardest braking of others {hardest:.1} crashes {crashes:?}");
    assert_eq!(metrics.collisions, 0, "{name}");
    assert_eq!(crashes, [], "{name}: the others collide");
    assert!(world.snapshot().time_s > 59.9);
}

#[test]
fn the_embedded_scenarios_can_be_driven() {
    for name in Scenario::names() {
        assert_fair(&Scenario::load(name).unwrap());
    }
}

/// The recorded scenarios are not part of the repository: they are looked for beside it.
#[test]
fn recorded_scenarios_can_be_driven() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/scenarios");
    for name in [
        "USA_US101-3_3_T-1.xml",
        "DEU_A9-3_1_T-1.xml",
        "ZAM_Tutorial-1_2_T-1.xml",
    ] {
        let path = folder.join(name);
        if path.exists() {
            assert_fair(&Scenario::read(&path).unwrap());
        }
    }
}
