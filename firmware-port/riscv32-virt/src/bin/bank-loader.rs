//! The bootloader for a bank of the program flash. It runs from the RAM to which the boot ROM (the
//! image `bootloader`) copies it.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board_riscv32_virt::board::{VirtBoard, run_in_slot};
use tandem_board_riscv32_virt::{boot_rom, controller::SLICE_TICKS, entry};

entry!(main);

fn main(hart: usize) -> ! {
    run_in_slot(hart, SLICE_TICKS, core)
}

fn core(board: &VirtBoard) {
    let launch = boot_rom::bootloader(board, None);
    boot_rom::launch(board, &launch);
    board.jump();
}
