//! The host's side of emulated machines: starts QEMU and exchanges messages with its firmware.
//!
//! [`Machine`] is one emulator process that runs one or both systems. [`EmulatedWorld`] is all
//! machines of a run as the vehicle sees them: the bus, the wires between the systems, and data for
//! an observer. Virtual time advances in steps of [`tandem_cosim::PERIOD_NS`]. Within a step the
//! machines run independently and in parallel; a message from one machine to another or to the
//! world arrives with the next step. With the same frames from the world, two runs are identical,
//! bit for bit. [`run_to_end`] runs images that need no world.
#![forbid(unsafe_code)]

mod alone;
mod bridge;
mod emulator;
mod machine;
mod world;

pub use alone::run_to_end;
pub use emulator::ImageMachine;
pub use machine::{
    BootFrom, LOADER_RAM_AT, Machine, MachineError, MachineOptions, PROGRAM_FLASH_AT,
};
pub use world::{EmulatedWorld, WorldLayout};
