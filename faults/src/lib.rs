//! Faults as data: what can fail, when and for how long; which faults a campaign injects; how long
//! the vehicle may be without control under each fault; and the judge of a campaign.
//!
//! The simulator, the processes of a run and emulated machines suffer the same faults: each
//! implements [`Suffer`]. A new kind of fault needs a variant and its [`Facts`] in `kind.rs`, and
//! code for its effect in each board that can suffer it.
#![forbid(unsafe_code)]

mod amount;
mod entry;
mod file;
mod judge;
mod kind;
mod loss;
mod plan;
mod sequence;
mod setting;
mod site;
mod value;
mod values;
mod words;

pub use amount::{Amount, Given, just};
pub use entry::{BusFaults, CannotSuffer, Effect, Fault, Suffer, Way, effects};
pub use file::FileError;
pub use judge::{Observed, known};
pub use kind::{Ends, Facts, Kind, Scope};
pub use loss::Loss;
pub use plan::{DISTANCES, Draw, PHASES};
pub use sequence::{Group, Sequence};
pub use setting::{DriveRoad, DriveSetting};
pub use site::Site;
pub use value::{Bend, DeafTo, Forged, FrameName, How, Real, Signal, WrongValue};
