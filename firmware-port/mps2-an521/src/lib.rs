//! Bare metal: QEMU's `mps2-an521`. Two Cortex-M33 are two cores, the message handling unit is the
//! doorbell, and a bank of the internal SRAM is the LMU.
//!
//! The controller has six cores and this machine two processors, so it runs any two of the cores.
//! Both processors run one image. A program names its main with [`entry!`]; each processor calls it
//! with its number. The facts about the machine are from Arm's documents DAI 0521 (AN521) and
//! 101104 (SSE-200) and from QEMU's behaviour.
#![no_std]

pub mod board;
pub mod cpu;
pub mod exit;
#[path = "../../lmu.rs"]
pub mod lmu;
#[path = "../../log.rs"]
mod log;
pub mod mhu;
mod start;
pub mod straps;
pub mod timers;
pub mod uart;

/// Names the function that each processor calls after its start.
#[macro_export]
macro_rules! entry {
    ($main:path) => {
        #[allow(unsafe_code, reason = "the start-up code finds it by its name")]
        #[unsafe(no_mangle)]
        extern "C" fn tandem_main(cpu: usize) -> ! {
            let main: fn(usize) -> ! = $main;
            main(cpu)
        }
    };
}
