//! The platform that runs the processes of a computer: what may run, when, and what happens when it
//! fails.
#![forbid(unsafe_code)]

pub mod launcher;
pub mod supervisor;
pub mod trust;
