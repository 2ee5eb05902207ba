//! What QEMU's `virt` machines have in common: harts as cores, the carrier, its emulated hardware.
//!
//! Each RISC-V board includes this folder and provides at its root what differs: `interrupts`
//! (doorbell, timer and clock), and the macros of `start.S` for its registers. The board of another
//! machine takes over the emulated hardware with this folder, and writes these two.

pub mod board;
pub mod conformance;
pub mod controller;
pub mod doorbell;
pub mod exit;
pub mod golden_replay;
pub mod hart;
#[path = "../log.rs"]
mod log;
pub mod memory;
pub mod peripherals;
pub(crate) mod semihosting;
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
