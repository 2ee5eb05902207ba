//! Fuzz targets for files that a user writes: scenarios and lists of faults.

use tandem_faults::Sequence;
use tandem_vehicle::{Scenario, World, WorldConfig};

/// Checks that a scenario file is rejected, or its world runs for 60 ms without a controller.
///
/// # Panics
/// If the reader or the world panics, or a position is not a number.
pub(crate) fn scenario(data: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(data) else {
        return false;
    };
    let Ok(scenario) = Scenario::parse(text, "fuzzed.xml") else {
        return false;
    };
    let mut world = World::new(&scenario, WorldConfig::default());
    for ms in 0..60 {
        world.step(ms * 1_000_000, &mut |_, _| {});
    }
    for vehicle in &world.snapshot().vehicles {
        let at = vehicle.pose.position;
        assert!(
            at.x.is_finite() && at.y.is_finite() && vehicle.speed.is_finite(),
            "vehicle {} is at {at:?} with {} m/s",
            vehicle.id,
            vehicle.speed
        );
    }
    assert!(world.snapshot().lateral_offset.is_finite());
    true
}

/// Checks that a file of faults is rejected, or is unchanged when it is written and read again.
///
/// # Panics
/// If it changes.
pub(crate) fn faults(data: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(data) else {
        return false;
    };
    let Ok(read) = Sequence::from_toml(text, 0) else {
        return false;
    };
    let text = read.to_toml().expect("what was read can be written");
    let again = Sequence::from_toml(&text, 0).expect("what was written can be read");
    assert_eq!(again.faults, read.faults, "{text}");
    assert_eq!(
        (again.span, again.from_power_on),
        (read.span, read.from_power_on)
    );
    true
}
