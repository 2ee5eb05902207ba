//! Runs the driving functions over recorded frames in the emulator's memory, and prints the digest
//! of their outputs. A host prints the same digest. Strap `First`: duration in milliseconds.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board_riscv32_virt::memory::{Strap, strap};
use tandem_board_riscv32_virt::{entry, exit, hart, log, memory};

entry!(main);

fn main(hart: usize) -> ! {
    if hart != 0 {
        hart::park()
    }
    let recording = memory::recording();
    let begin = hart::cycles();
    let digest = tandem_golden::play(recording, strap(Strap::First).into());
    log!("{digest:?}");
    log!("{} kilocycles", hart::cycles().wrapping_sub(begin) / 1_000);
    exit::exit(0)
}
