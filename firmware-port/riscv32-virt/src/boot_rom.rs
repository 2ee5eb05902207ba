//! What a chip's boot ROM does: it chooses a bank of the program flash, copies the bootloader in it
//! to the RAM that code runs from, and jumps. There a bootloader may erase its own bank. It also
//! verifies signatures, as the security module of an AURIX does: with that and its drivers, the
//! bootloader would need 36 KiB of this instruction set.

use crate::board::VirtBoard;
use crate::boot_memory::{LOADER_RAM, public_key, testers};
use crate::keeper::ByTimer;
use crate::program_flash::{BEGIN, ProgramFlash};
use crate::slot::boot_registers;
use core::sync::atomic::Ordering::Relaxed;
use embedded_storage::nor_flash::ReadNorFlash as _;
use tandem_board::{Board, Instant, MonotonicCounter as _, ResetRequest, Supply};
use tandem_boot::{
    BODY_OFFSET, Bank, BootDesk, COUNTER_PAGES, DeskSetup, FlashRegion, ImageTarget, Launch, Leave,
    OneTimeWords, PAGE_BYTES, Security, Slot, Trust, TrustMode, rom_choice, start,
};

/// Starts the bootloader in the flash, if there is one, and returns if there is none.
pub fn start_from_flash(board: &VirtBoard) {
    let registers = boot_registers(board.identity().system);
    let asked = bank_of(registers.asked_bank.swap(0, Relaxed));
    let Some(bank) = asked.or_else(|| rom_choice(&mut ProgramFlash)) else {
        return;
    };
    load(bank);
    registers.bank.store(bank as u32 + 1, Relaxed);
    let entry = LOADER_RAM.as_ptr().addr() as u32 + BODY_OFFSET;
    board.set_entries([Some(entry), None, None]);
    board.jump();
}

const fn bank_of(code: u32) -> Option<Bank> {
    match code {
        1 => Some(Bank::Primary),
        2 => Some(Bank::Backup),
        _ => None,
    }
}

/// Copies a bank to the RAM. The first page of a bank on trial is missing, so nothing of its
/// manifest counts: code begins behind that.
fn load(bank: Bank) {
    let place = FlashRegion::Bank(bank).range();
    let mut cells = LOADER_RAM.iter();
    for at in place.step_by(PAGE_BYTES) {
        let mut page = [0; PAGE_BYTES];
        // This flash can always be read.
        let _read = ProgramFlash.read(at, &mut page);
        for (byte, cell) in page.into_iter().zip(cells.by_ref()) {
            cell.store(byte, Relaxed);
        }
    }
}

/// Has the boot ROM verify a signature.
fn rom_verify(key: &[u8; 32], message: &[u8], signature: &[u8; 64]) -> bool {
    unsafe extern "C" {
        fn __rom_verify(
            key: *const [u8; 32],
            message: *const u8,
            length: usize,
            signature: *const [u8; 64],
        ) -> bool;
    }
    // SAFETY: the linker scripts name the function of the boot ROM; the arguments are references.
    unsafe { __rom_verify(key, message.as_ptr(), message.len(), signature) }
}

/// Runs the bootloader on core 0 until it starts an application. `bank`: the one that runs; `None`
/// if it is the one that the boot ROM has copied.
pub fn bootloader(board: &VirtBoard, bank: Option<Bank>) -> Launch {
    let registers = boot_registers(board.identity().system);
    let copied = || bank_of(registers.bank.load(Relaxed));
    let bank = bank.or_else(copied).unwrap_or(Bank::Primary);
    let keys = [public_key()];
    let trust = Trust {
        keys: &keys,
        testers: testers(),
        mode: TrustMode::Strict,
        verify: rom_verify,
    };
    let security = Security {
        noise: noise(board),
        counter: OneTimeWords::new(ProgramFlash, COUNTER_PAGES).value(),
    };
    let keeper = ByTimer::new(board);
    match start(board, ProgramFlash, trust, bank, &keeper, security) {
        Leave::Jump(launch) => launch,
        Leave::StartBank(other) => {
            // The boot ROM does it, after a reset that keeps this register.
            registers.asked_bank.store(other as u32 + 1, Relaxed);
            board.supply().request_reset(ResetRequest::Software);
            loop {
                board.wait(Instant::NEVER);
            }
        }
    }
}

/// Starts the cores of an application.
pub fn launch(board: &VirtBoard, launch: &Launch) {
    board.set_entries(launch.entries.map(|entry| Some(BEGIN + entry?)));
}

/// Returns the bootloader's desk beside an application.
#[must_use]
pub fn desk(board: &VirtBoard) -> BootDesk<'static, ProgramFlash, OneTimeWords<ProgramFlash>> {
    // Both slots have one entry for all cores, inside the slot.
    let entries = &boot_registers(board.identity().system).entries;
    let at = entries[0].load(Relaxed).wrapping_sub(BEGIN);
    let running = match ImageTarget::at(at) {
        Some(ImageTarget::Application(slot)) => slot,
        _ => Slot::A,
    };
    let setup = DeskSetup {
        trust: Trust {
            keys: &[],
            testers: testers(),
            mode: TrustMode::Strict,
            verify: rom_verify,
        },
        system: board.identity().system,
        running,
        starts: board.supply().starts(),
        noise: noise(board),
    };
    let counter = OneTimeWords::new(ProgramFlash, COUNTER_PAGES);
    BootDesk::new(ProgramFlash, counter, setup, board.now())
}

/// Returns bytes that differ at each start. This machine has no random numbers: its clock alone can
/// be foreseen.
fn noise(board: &VirtBoard) -> [u8; 32] {
    let mut noise = [0; 32];
    noise[..8].copy_from_slice(&board.now().as_ns().to_le_bytes());
    noise[8] = board.supply().starts();
    noise
}
