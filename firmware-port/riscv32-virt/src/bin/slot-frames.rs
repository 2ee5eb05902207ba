//! The smallest application, for slot A: see `tandem_boot::three_frames`. T-BOOT-8
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board::{Board, CoreId, Duration};
use tandem_board_riscv32_virt::board::{VirtBoard, run_in_slot};
use tandem_board_riscv32_virt::{boot_rom, entry};

entry!(main);

/// Period in which each core sends a frame, and core 0 services the watchdog.
const PERIOD: Duration = Duration::from_ms(10);

fn main(hart: usize) -> ! {
    run_in_slot(hart, 0, core)
}

fn core(board: &VirtBoard) {
    if board.identity().core == CoreId::PLANNING {
        let mut desk = boot_rom::desk(board);
        tandem_boot::three_frames(board, PERIOD, &mut desk)
    }
    tandem_boot::three_frames(board, PERIOD, &mut ())
}
