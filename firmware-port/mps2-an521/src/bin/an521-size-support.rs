//! Links the start-up code, and what each image has that copies memory and has an index that may be
//! wrong: `memcpy`, `memset`, and the text of a panic. `cargo xtask firmware size` subtracts it.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::hint::black_box;
use tandem_board_mps2_an521::{cpu, entry};

entry!(main);

fn main(own: usize) -> ! {
    let mut words = [0_u32; 64];
    let other: [u32; 64] = black_box([1; 64]);
    words[..black_box(own)].copy_from_slice(&other[black_box(own)..]);
    black_box(words[black_box(own)]);
    loop {
        cpu::sleep();
    }
}
