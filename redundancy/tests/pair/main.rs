//! Two systems against each other: start, takeover, split brain, random faults, and the tables of the docs.

mod faults;
mod model;
mod start;
