//! The controller's participant: it hears, publishes and takes what it is sent. Its state counts as
//! RAM.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::hint::black_box;
use core::sync::atomic::AtomicU8;
use tandem_board::{Instant, NetworkAddress, Recipient};
use tandem_board_riscv32_virt::{clint, entry, hart};
use tandem_topics::endpoints::{INPUTS, OUTPUTS, controller_prefix};
use tandem_topics::{CanFrame, Controller, Outlet, TopicType as _};

entry!(main);

/// As large as the participant, which lies on the stack.
#[used]
static STATE: [AtomicU8; size_of::<Controller>()] =
    [const { AtomicU8::new(0) }; size_of::<Controller>()];

struct Port;

impl Outlet for Port {
    fn send(&mut self, to: Recipient, message: &[u8]) {
        black_box((to, message));
    }
}

fn main(_: usize) -> ! {
    let at = NetworkAddress {
        address: black_box([10, 0, 0, 1]),
        port: 7_410,
    };
    let prefix = controller_prefix(0, black_box([0; 5]));
    let mut participant = Controller::new(prefix, at, &OUTPUTS, &INPUTS);
    let mut datagram = [0; 1_472];
    loop {
        let now = black_box(Instant::ORIGIN);
        participant.poll(now, &mut Port);
        let datagram = black_box(&mut datagram);
        participant.hear(now, datagram, &mut Port);
        let _ended = participant.write(0, black_box(&[0; CanFrame::PAYLOAD_LEN]), &mut Port);
        for reader in 0..INPUTS.len() {
            black_box(participant.take(reader));
        }
        clint::post(0);
        hart::sleep();
    }
}
