//! A station for tests of the Ethernet: core 0 of each system greets everyone, and sends back what
//! it receives to the sender.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board::{Board, Channel, CoreId, Duration, Network, Recipient, Supply, watchdog_answer};
use tandem_board_riscv32_virt::board::{VirtBoard, VirtNetwork, run};
use tandem_board_riscv32_virt::controller::SLICE_TICKS;
use tandem_board_riscv32_virt::entry;
use tandem_board_riscv32_virt::peripherals::Peripherals;

entry!(main);

/// Time from one greeting to the next, in the window of the watchdog.
const PERIOD: Duration = Duration::from_ms(10);

fn main(hart: usize) -> ! {
    run(hart, SLICE_TICKS, core, Peripherals::play_for_world)
}

fn core(board: &VirtBoard) {
    let of = board.identity();
    if of.core != CoreId::CONTROL {
        return;
    }
    let mut next = board.now();
    loop {
        let supply = board.supply();
        supply.service_watchdog(watchdog_answer(supply.watchdog_question()));
        let greeting = [of.system.index() as u8; 3];
        for channel in Channel::ALL {
            // A full buffer loses it.
            let _ = board
                .network()
                .try_send(channel, Recipient::Everyone, &greeting);
            let mut bytes = [0; VirtNetwork::MAX_BYTES];
            while let Some(received) = board.network().try_receive(channel, &mut bytes) {
                let to = Recipient::One(received.from);
                // Not a greeting: two systems would never end.
                if received.len != greeting.len() {
                    let _ = board
                        .network()
                        .try_send(channel, to, &bytes[..received.len]);
                }
            }
        }
        next += PERIOD;
        while board.now() < next {
            board.wait(next);
        }
    }
}
