//! Bare metal: QEMU's riscv32 `virt` machine. A hart is a core, the CLINT's software interrupt is
//! the doorbell, and a section at a fixed address is the LMU.
//!
//! One image runs on all harts (decision 0008): 0 to 2 are the cores of system A, 3 to 5 those of
//! system B, 6 is the carrier. A program names its main with [`entry!`]; every hart calls it with
//! its number.
#![no_std]

extern crate alloc;

pub mod board;
pub mod boot_rom;
pub mod clint;
pub mod controller;
pub mod doorbell;
pub mod exit;
pub mod hart;
pub mod heap;
#[path = "../../log.rs"]
mod log;
pub mod measure;
pub mod memory;
pub mod peripherals;
pub mod program_flash;
mod semihosting;
pub mod trap;
pub mod uart;

use tandem_shm::mailbox::TaskId;

/// Returns the value of a result. The result is an error only if the memory layout is wrong.
///
/// # Panics
/// If the result is an error.
#[track_caller]
pub fn must<T, E>(result: Result<T, E>) -> T {
    match result {
        Ok(value) => value,
        Err(_) => panic!("the program is not laid out as it should be"),
    }
}

/// Returns task `number` of a mailbox, for use in constants.
///
/// # Panics
/// If there is no such task.
#[must_use]
pub const fn task(number: u8) -> TaskId {
    match TaskId::new(number) {
        Some(task) => task,
        None => panic!("not a task number"),
    }
}

/// Names the function that each hart calls after the start, and after each reset of the hart.
#[macro_export]
macro_rules! entry {
    ($main:path) => {
        #[allow(unsafe_code, reason = "the start-up code finds it by its name")]
        #[unsafe(no_mangle)]
        extern "C" fn tandem_hart_main(hart: usize) -> ! {
            let main: fn(usize) -> ! = $main;
            main(hart)
        }
    };
}
