//! The whole controller for both systems, and the carrier, which exchanges messages with a vehicle
//! on the host. Each core runs its tasks to completion. The straps are those of [`controller`].
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board_riscv64_virt::board::run;
use tandem_board_riscv64_virt::controller::{self, SLICE_TICKS};
use tandem_board_riscv64_virt::entry;
use tandem_board_riscv64_virt::peripherals::Peripherals;

entry!(main);

fn main(hart: usize) -> ! {
    run(
        hart,
        SLICE_TICKS,
        controller::core,
        Peripherals::play_for_world,
    )
}
