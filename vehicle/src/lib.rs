//! The world outside the bus: plant, sensors, traffic, scenarios.
//!
//! ```
//! use tandem_board::Instant;
//! use tandem_vehicle::{LocalBus, Scenario, World, WorldConfig};
//!
//! let scenario = Scenario::load("cut-in")?;
//! let mut world = World::new(&scenario, WorldConfig { seed: 1 });
//! let mut bus = LocalBus::new(Instant::ORIGIN);
//! for ms in 0..1_000 {
//!     bus.now = Instant::from_ns(ms * 1_000_000);
//!     // The controller's frames: bus.to_vehicle.push(frame).
//!     world.run_period(bus.now, &mut bus, &mut |logged| println!("{:?}", logged.message()));
//!     // Readings of its sensors:
//!     bus.from_vehicle.clear();
//! }
//! assert!(!world.snapshot().running, "it waits for the first control frame");
//! # Ok::<(), tandem_vehicle::ScenarioError>(())
//! ```
//!
//! The caller passes the time and the frames, and gets frames back. The crate reads no clock and
//! does no input or output, except for reading a scenario file.
#![forbid(unsafe_code)]

pub mod actuators;
pub mod body;
pub mod commonroad;
mod driver;
mod emergency;
mod error;
pub mod gate;
pub mod geometry;
pub mod mastership;
pub mod metrics;
pub mod plant;
pub mod road;
mod route;
pub mod scenario;
pub mod sensors;
pub mod traffic;
pub mod world;
pub mod world_loop;

pub use driver::Habit;
pub use error::ScenarioError;
pub use gate::{Acceptance, FrameCounts, Ruling};
pub use metrics::WorldMetrics;
pub use road::LaneId;
pub use scenario::Scenario;
pub use sensors::{SensorFault, SensorTiming};
pub use world::{VehicleSnapshot, World, WorldConfig, WorldSnapshot};
pub use world_loop::{LocalBus, LoggedFrame};
