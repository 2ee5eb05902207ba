//! The world outside the bus: plant, sensors, traffic, scenarios.
//!
//! ```
//! use tandem_vehicle::{Config, Scenario, World};
//!
//! let scenario = Scenario::load("cut-in")?;
//! let mut world = World::new(&scenario, Config { seed: 1 });
//! for now_ms in 0..1_000 {
//!     // world.on_frame(now_ns, id, data) for each frame that a controller has sent, and then:
//!     world.step(now_ms * 1_000_000, &mut |id, data| println!("{id:03X} {data:02X?}"));
//! }
//! assert!(!world.snapshot().running, "it waits for the first control frame");
//! # Ok::<(), tandem_vehicle::ScenarioError>(())
//! ```
//!
//! It is told the time and the frames, and hands out frames: no clock, no input, no output, except
//! for reading a scenario file.
#![forbid(unsafe_code)]

pub mod actuators;
pub mod commonroad;
pub mod gate;
pub mod geometry;
pub mod mastership;
pub mod metrics;
pub mod plant;
pub mod road;
pub mod scenario;
pub mod sensors;
pub mod traffic;
pub mod world;

pub use gate::{Acceptance, FrameCounts, Verdict};
pub use metrics::Metrics;
pub use road::LaneId;
pub use scenario::{Scenario, ScenarioError};
pub use world::{Config, Snapshot, VehicleSnapshot, World};
