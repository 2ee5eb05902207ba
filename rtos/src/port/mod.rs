//! What differs between machines: switching, masking, interrupts, the tick.
#![allow(unsafe_code)]

#[cfg(target_os = "linux")]
pub mod host;
#[cfg(target_os = "linux")]
pub(crate) use host::{
    MIN_STACK_WORDS, Stack, assert_may_block, attach, fatal, idle, prepare, run_time, start,
    tear_down,
};

#[cfg(target_arch = "riscv32")]
pub mod riscv32;
#[cfg(target_arch = "riscv32")]
pub(crate) use riscv32::{
    MIN_STACK_WORDS, Stack, assert_may_block, attach, fatal, idle, prepare, run_time, start,
    tear_down,
};
