//! Measurements: floors, peers, and what Tandem adds.
