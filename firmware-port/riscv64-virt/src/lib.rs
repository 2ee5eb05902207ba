//! Bare metal: QEMU's riscv64 `virt` machine. A hart is a core, a message to its interrupt file is
//! the doorbell (IMSIC), and a section at a fixed address is the LMU.
//!
//! One image runs on all harts, as on riscv32 (decision 0008). The sources of the facts about the
//! machine are the RISC-V Advanced Interrupt Architecture 1.0, the ACLINT specification, and QEMU.
#![no_std]

pub mod interrupts;
#[path = "../../virt/mod.rs"]
mod virt;

pub use virt::*;

core::arch::global_asm!(
    include_str!("registers.S"),
    include_str!("../../virt/start.S")
);
