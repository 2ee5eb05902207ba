//! What may run on a computer, when, and what happens when it fails.
#![forbid(unsafe_code)]

pub mod launcher;
pub mod supervisor;
pub mod trust;
