//! The first program of a machine with one system: boot ROM, bootloader on core 0, and the carrier.
//!
//! Strap `First`: the system, 1 A, 2 B. The emulator loads the program flash and the public key
//! (see `memory`). Core 0 jumps to the image in its slot; cores 1 and 2 jump to it when core 0
//! releases them.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board::{Board, CoreId, Supply};
use tandem_board_riscv32_virt::board::{VirtBoard, run};
use tandem_board_riscv32_virt::peripherals::Peripherals;
use tandem_board_riscv32_virt::{boot_rom, entry, log};
use tandem_boot::Bank;

entry!(main);

/// Length of a turn: 50 us.
const SLICE_TICKS: u32 = 500;

fn main(hart: usize) -> ! {
    run(hart, SLICE_TICKS, core, Peripherals::play_for_world)
}

/// Runs first on each core, in each of its incarnations.
fn core(board: &VirtBoard) {
    if board.identity().core == CoreId::CONTROL {
        boot_rom::start_from_flash(board);
        let begin = board.now();
        // If the flash holds no bootloader, this program runs as the primary one.
        let launch = boot_rom::bootloader(board, Some(Bank::Primary));
        log!(
            "{}: {:?}: slot {:?}, version {}, after {} us",
            board.identity().system,
            board.supply().reset_cause(),
            launch.application,
            launch.version,
            board.now().since(begin).as_ns() / 1_000
        );
        boot_rom::launch(board, &launch);
    }
    board.jump();
}

/// The service of the boot ROM that `boot_rom` calls from an image in the flash.
///
/// # Safety
/// The arguments are valid for reads: a key of 32 bytes, a message, a signature of 64 bytes.
#[allow(unsafe_code, reason = "the start-up code finds it by its name")]
#[unsafe(no_mangle)]
unsafe extern "C" fn tandem_rom_verify(
    key: *const [u8; 32],
    message: *const u8,
    length: usize,
    signature: *const [u8; 64],
) -> bool {
    // SAFETY: the caller's contract.
    let (key, message, signature) = unsafe {
        (
            &*key,
            core::slice::from_raw_parts(message, length),
            &*signature,
        )
    };
    tandem_boot::ed25519(key, message, signature)
}
