//! Links only the start-up code. `cargo xtask firmware size` subtracts its size from other images.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board_riscv32_virt::{entry, hart};

entry!(main);

fn main(_: usize) -> ! {
    hart::park()
}
