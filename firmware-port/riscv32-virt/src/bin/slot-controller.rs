//! The whole controller, in slot A, for a machine with one system. The bootloader's image starts
//! it. The straps are those of [`kernel`].
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board_riscv32_virt::board::run_in_slot;
use tandem_board_riscv32_virt::controller::SLICE_TICKS;
use tandem_board_riscv32_virt::{entry, kernel};

entry!(main);

fn main(hart: usize) -> ! {
    run_in_slot(hart, SLICE_TICKS, kernel::core_in_slot)
}
