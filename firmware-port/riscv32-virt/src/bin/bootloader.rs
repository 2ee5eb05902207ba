//! The first program of a machine with one system: boot ROM, bootloader on core 0, and the carrier.
//!
//! Strap `First`: the system, 1 A, 2 B. The emulator loads the program flash and the public key
//! (see `memory`). Core 0 jumps to the image in its slot; cores 1 and 2 jump to it when core 0
//! releases them.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board::{Board, CoreId, MonotonicCounter as _, Supply};
use tandem_board_riscv32_virt::board::{ByTimer, VirtBoard, run};
use tandem_board_riscv32_virt::controller::noise;
use tandem_board_riscv32_virt::memory::{public_key, tester_key};
use tandem_board_riscv32_virt::peripherals::Peripherals;
use tandem_board_riscv32_virt::program_flash::{BEGIN, ProgramFlash};
use tandem_board_riscv32_virt::{entry, log};
use tandem_boot::{
    Bank, COUNTER_PAGES, Leave, OneTimeWords, Security, Trust, TrustMode, rom_choice, start,
};

entry!(main);

/// Length of a turn: 50 us.
const SLICE_TICKS: u32 = 500;

fn main(hart: usize) -> ! {
    run(hart, SLICE_TICKS, core, Peripherals::play_for_world)
}

/// Runs first on each core, in each of its incarnations.
fn core(board: &VirtBoard) {
    if board.identity().core == CoreId::CONTROL {
        let begin = board.now();
        let launch = boot(board);
        log!(
            "{}: {:?}: slot {:?}, version {}, after {} us",
            board.identity().system,
            board.supply().reset_cause(),
            launch.application,
            launch.version,
            board.now().since(begin).as_ns() / 1_000
        );
        board.set_entries(launch.entries.map(|entry| Some(BEGIN + entry?)));
    }
    board.jump();
}

fn boot(board: &VirtBoard) -> tandem_boot::Launch {
    let (keys, tester) = ([public_key()], tester_key());
    let trust = Trust {
        keys: &keys,
        testers: tester.as_slice(),
        mode: TrustMode::Strict,
    };
    let security = Security {
        noise: noise(board),
        counter: OneTimeWords::new(ProgramFlash, COUNTER_PAGES).value(),
    };
    let keeper = ByTimer::new(board);
    // If the flash holds no bootloader, this program runs as the primary one.
    let mut bank = rom_choice(&mut ProgramFlash).unwrap_or(Bank::Primary);
    loop {
        match start(board, ProgramFlash, trust, bank, &keeper, security) {
            Leave::Jump(launch) => return launch,
            Leave::StartBank(other) => bank = other,
        }
    }
}
