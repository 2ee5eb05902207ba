//! See `messages.rs`.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

#[path = "../../../messages.rs"]
mod messages;

use tandem_board::SystemId;
use tandem_board_mps2_an521::{cpu, entry, lmu, mhu};

entry!(main);

fn main(own: usize) -> ! {
    let post = || mhu::interrupt(mhu::Unit::Doorbell, 1);
    messages::run(own, lmu::lmu(SystemId::A), post, cpu::sleep);
    loop {
        cpu::sleep();
    }
}
