//! What runs on the cores of one system: the driving functions and their wiring, generic over one
//! board.
//!
//! `driving` is pure computation (sensor frames in, scene, trajectory, command out), told the time.
#![no_std]
#![forbid(unsafe_code)]

#[cfg(test)]
extern crate std;

pub mod driving;
pub mod schedule;
pub mod trace;
pub mod words;
