//! Only the start-up: `cargo xtask firmware size` subtracts it from the other images.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board_riscv32_virt::{entry, hart};

entry!(main);

fn main(_: usize) -> ! {
    hart::park()
}
