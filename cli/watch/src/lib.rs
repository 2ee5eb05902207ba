//! What the observers of a run share: the state of the run, what it perceives and plans, and the
//! hands that inject and end faults in it.
#![forbid(unsafe_code)]

mod driving;
mod hands;
mod picture;

pub use driving::{DrivingView, borders, yaw};
pub use hands::{Hand, Hands, Refused};
pub use picture::{Alone, Picture, state_name};
