//! Two systems that run as one. Core 0 is system A, core 1 is system B and the vehicle. Core 0
//! stops after a second, as if its power were cut, and B takes over.
#![no_std]
#![no_main]

mod lmu;
#[cfg_attr(target_arch = "riscv32", path = "riscv32.rs")]
#[cfg_attr(target_arch = "arm", path = "cortex_m.rs")]
mod machine;
mod system;
mod vehicle;

/// When system A stops, ms.
const CUT_MS: u64 = 1_000;
/// When the vehicle judges, ms.
const END_MS: u64 = 2_000;
