//! What `tandem top` and `tandem web` share: the state of a run that they show, and the hands that
//! inject and end faults in it.
#![forbid(unsafe_code)]

mod hands;
mod picture;

pub use hands::{Hand, Hands, Refused};
pub use picture::Picture;
