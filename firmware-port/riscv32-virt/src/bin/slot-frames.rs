//! The smallest application, for slot A: its three cores each send a CAN frame with their number.
//! T-BOOT-8
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board::{
    Board, Can, CanFrame, CanId, CoreId, Duration, Instant, Supply, watchdog_answer,
};
use tandem_board_riscv32_virt::board::{VirtBoard, run_in_slot};
use tandem_board_riscv32_virt::entry;

entry!(main);

/// The id of core 0's frames; those of the others follow.
const FIRST_ID: u16 = 0x700;
/// How often each core sends, and core 0 serves the watchdog.
const PERIOD: Duration = Duration::from_ms(10);

fn main(hart: usize) -> ! {
    run_in_slot(hart, 0, core)
}

fn core(board: &VirtBoard) {
    let core = board.identity().core;
    let number = core.index() as u8;
    let id = CanId::Standard(FIRST_ID + u16::from(number));
    let Ok(frame) = CanFrame::new(id, false, &[number]) else {
        return;
    };
    if core == CoreId::CONTROL {
        board.release_core(CoreId::PERCEPTION);
        board.release_core(CoreId::PLANNING);
    }
    let mut due = Instant::ORIGIN;
    loop {
        let now = board.now();
        if now >= due {
            due = now + PERIOD;
            // Full: the bus is slower, and the next one will do.
            let _ = board.can().try_send(&frame);
            if core == CoreId::CONTROL {
                let supply = board.supply();
                supply.service_watchdog(watchdog_answer(supply.watchdog_question()));
            }
        }
        board.wait(due);
    }
}
