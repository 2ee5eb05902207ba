//! Bare metal: QEMU's riscv32 `virt` machine. A hart is a core, the CLINT's software interrupt is
//! the doorbell, and a section at a fixed address is the LMU.
//!
//! One image runs on all harts (decision 0008): 0 to 2 are the cores of system A, 3 to 5 those of
//! system B, 6 is the carrier. A program names its main with [`entry!`]; every hart calls it with
//! its number.
#![no_std]

extern crate alloc;

mod boot_memory;
pub mod boot_rom;
pub mod clint;
pub mod heap;
pub mod keeper;
pub mod kernel;
pub mod measure;
pub mod program_flash;
mod slot;
#[path = "../../virt/mod.rs"]
mod virt;

pub(crate) use clint as interrupts;
pub use virt::*;

core::arch::global_asm!(
    include_str!("registers.S"),
    include_str!("../../virt/start.S"),
    include_str!("slot.S")
);
