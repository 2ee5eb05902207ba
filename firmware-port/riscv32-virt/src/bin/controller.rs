//! The whole controller: the three cores of each system, and the carrier, which exchanges with a
//! vehicle on the host.
//!
//! Strap `First`: which systems are in this machine, 1 A, 2 B, 3 both. Strap `Second`: 1 lets a
//! system that comes back become the standby of the running one.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board::{Board, CoreId};
use tandem_board_riscv32_virt::board::{VirtBoard, run};
use tandem_board_riscv32_virt::carrier::Carrier;
use tandem_board_riscv32_virt::entry;
use tandem_board_riscv32_virt::memory::{Strap, strap};
use tandem_cores::core0::Core0;
use tandem_cores::core1::Core1;
use tandem_cores::core2::Core2;
use tandem_cores::{Config, Core};

entry!(main);

/// Turns of 50 us: the emulator runs one hart at a time, and none must wait long for another.
const SLICE_TICKS: u32 = 500;

fn main(hart: usize) -> ! {
    run(hart, SLICE_TICKS, core, outside)
}

/// One life of one core.
fn core(board: &VirtBoard) {
    let mut config = Config::rt();
    config.redundancy.reintegrate = strap(Strap::Second) & 1 != 0;
    match board.identity().core {
        CoreId::CONTROL => go(board, Core0::new(board, config)),
        CoreId::PERCEPTION => go(board, Core1::new(board)),
        _ => go(board, Core2::new(board)),
    }
}

fn go(board: &VirtBoard, mut core: impl Core) -> ! {
    loop {
        let deadline = core.poll();
        board.wait(deadline);
    }
}

fn outside(carrier: &mut Carrier) -> ! {
    let systems = strap(Strap::First);
    carrier.connect([systems & 1 != 0, systems & 2 != 0]);
    carrier.set_watchdogs(true);
    for system in carrier.systems() {
        carrier.power_off(system);
        carrier.new_flash(system);
    }
    loop {
        // The world connects the battery, and ends the machine.
        carrier.step(u64::MAX);
    }
}
