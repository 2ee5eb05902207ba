//! See `messages.rs`.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

#[path = "../../../messages.rs"]
mod messages;

use tandem_board::SystemId;
use tandem_board_riscv32_virt::{clint, entry, hart, memory};

entry!(main);

fn main(hart: usize) -> ! {
    messages::run(
        hart,
        memory::lmu(SystemId::A),
        || clint::post(1),
        hart::sleep,
    );
    hart::park()
}
