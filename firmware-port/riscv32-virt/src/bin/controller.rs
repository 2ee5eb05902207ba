//! The whole controller without a bootloader: the three cores of each system, and the carrier,
//! which exchanges messages with a vehicle on the host. The straps are those of [`kernel`].
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board_riscv32_virt::board::run;
use tandem_board_riscv32_virt::controller::SLICE_TICKS;
use tandem_board_riscv32_virt::peripherals::Peripherals;
use tandem_board_riscv32_virt::{entry, kernel};

entry!(main);

fn main(hart: usize) -> ! {
    run(hart, SLICE_TICKS, kernel::core, Peripherals::play_for_world)
}
