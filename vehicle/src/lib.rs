//! The world outside the bus: plant, sensors, traffic, scenarios.
