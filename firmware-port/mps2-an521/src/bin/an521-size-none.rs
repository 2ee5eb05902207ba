//! Links only the start-up code. `cargo xtask firmware size` subtracts its size from that of the
//! messages.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board_mps2_an521::{cpu, entry};

entry!(main);

fn main(_: usize) -> ! {
    loop {
        cpu::sleep();
    }
}
