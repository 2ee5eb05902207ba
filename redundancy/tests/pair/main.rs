//! Two systems connected to each other: start, takeover, split brain, random faults, and the tables
//! of the docs.
#![allow(clippy::unwrap_used)]

mod docs;
mod explore;
mod faults;
mod forged;
mod hostile;
mod model;
mod page;
mod schedules;
mod start;
mod truth;
