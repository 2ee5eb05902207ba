//! Nothing but the start-up: what `cargo xtask firmware size` takes off the other images.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board_riscv32_virt::{entry, hart};

entry!(main);

fn main(_: usize) -> ! {
    loop {
        hart::sleep();
    }
}
