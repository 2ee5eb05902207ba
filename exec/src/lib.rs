//! Deterministic execution: clients that are activated at the same time and compute the same, the
//! master that activates them, and the comparison of what they computed. Sans-IO.
#![no_std]
#![forbid(unsafe_code)]

pub mod client;
pub mod lockstep;
pub mod master;
