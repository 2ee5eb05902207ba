//! The first program of a machine with one system: boot ROM, bootloader on core 0, and the carrier.
//!
//! Strap `First`: the system, 1 A, 2 B. The emulator loads the program flash and the public key
//! (see `memory`). Core 0 jumps to the image in its slot; cores 1 and 2 jump to it when core 0
//! releases them.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board::{Board, CoreId, Supply};
use tandem_board_riscv32_virt::board::{ByTimer, VirtBoard, run};
use tandem_board_riscv32_virt::memory::public_key;
use tandem_board_riscv32_virt::peripherals::Peripherals;
use tandem_board_riscv32_virt::program_flash::{BEGIN, ProgramFlash};
use tandem_board_riscv32_virt::{entry, log};
use tandem_boot::{Bank, Leave, Trust, TrustMode, rom_choice, start};

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

/// Returns bytes that differ at each start. This machine has no random numbers: its clock alone can
/// be foreseen.
fn noise(board: &VirtBoard) -> [u8; 32] {
    let mut noise = [0; 32];
    noise[..8].copy_from_slice(&board.now().as_ns().to_le_bytes());
    noise[8] = board.supply().starts();
    noise
}

fn boot(board: &VirtBoard) -> tandem_boot::Launch {
    let keys = [public_key()];
    let trust = Trust {
        keys: &keys,
        testers: &[],
        mode: TrustMode::Strict,
    };
    let keeper = ByTimer::new(board);
    // If the flash holds no bootloader, this program runs as the primary one.
    let mut bank = rom_choice(&mut ProgramFlash).unwrap_or(Bank::Primary);
    loop {
        match start(board, ProgramFlash, trust, bank, &keeper, noise(board)) {
            Leave::Jump(launch) => return launch,
            Leave::StartPrimary => bank = Bank::Primary,
        }
    }
}
