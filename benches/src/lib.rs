//! Measurements: floors, peers, and what Tandem adds, by one harness in one run.

pub mod clock;
pub mod floor;
pub mod harness;
pub mod peers;
pub mod tandem;
