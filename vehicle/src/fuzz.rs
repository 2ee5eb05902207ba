//! What a scenario file must never do, for fuzzers and campaigns.

use crate::scenario::Scenario;
use crate::world::{Config, World};

/// Reads `data` as a scenario file and lets the world run for 60 ms without a controller. Returns
/// whether it was a scenario.
///
/// # Panics
/// If the reader or the world panics, or a position is no number: a fault of ours.
pub fn scenario(data: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(data) else {
        return false;
    };
    let Ok(scenario) = Scenario::parse(text, "fuzzed.xml") else {
        return false;
    };
    let mut world = World::new(&scenario, Config::default());
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
