//! Core 0 with its tasks under FreeRTOS, if the machine has one system: in every incarnation.
//!
//! The kernel's statics exist once in an image, so with both systems in one machine each core 0
//! runs its tasks to completion instead. Cores 1 and 2 have no kernel. The straps are those of
//! [`controller`], and strap `Third`: an overload of core 0's tasks for tests, see [`overload`]; 0
//! means none.

use crate::board::VirtBoard;
use crate::controller::{self, config, go};
use crate::memory::{Strap, strap};
use crate::{boot_rom, doorbell, heap, log, trap};
use alloc::boxed::Box;
use core::sync::atomic::AtomicU32;
use core::time::Duration;
use tandem_board::{Board, CoreId};
use tandem_cores::core0::Core0Task;
use tandem_cores::core2::Core2;
use tandem_rtos::Kernel;
use tandem_runtime::{Overload, RuntimeOptions};

/// Value of strap `First`.
const BOTH_SYSTEMS: u32 = 3;
/// Bytes of the stack of each task of core 0.
const STACK_BYTES: usize = 16 << 10;
/// The heap has room for the stacks, and for what core 0 keeps beside them.
const _: () = assert!(heap::BYTES >= Core0Task::ALL.len() * STACK_BYTES + (32 << 10));
/// Number of doorbells that were held back.
static HELD_BACK: AtomicU32 = AtomicU32::new(0);

/// Runs one incarnation of one core.
pub fn core(board: &VirtBoard) {
    match board.identity().core {
        CoreId::CONTROL if strap(Strap::First) != BOTH_SYSTEMS => under_kernel(board),
        _ => controller::core(board),
    }
}

/// Runs one incarnation of one core of an image in a slot. Core 2 has the bootloader's desk. U-3
pub fn core_in_slot(board: &VirtBoard) {
    if board.identity().core != CoreId::PLANNING {
        return core(board);
    }
    let desk = boot_rom::desk(board);
    go(board, Core2::with_desk(board, desk))
}

/// Returns the overload from strap `Third`: bits 0 to 7 are the task's index in the table plus 1,
/// bits 8 to 15 the extra time of a job in ms, bits 16 to 31 the interval of such jobs, in jobs.
fn overload() -> Option<Overload> {
    let [task, ms, low, high] = strap(Strap::Third).to_le_bytes();
    Some(Overload {
        task: *Core0Task::ALL.get(usize::from(task).checked_sub(1)?)?,
        every: u16::from_le_bytes([low, high]).into(),
        span: Duration::from_millis(ms.into()),
    })
}

/// Returns the kernel, which is new in every incarnation of the core.
fn kernel() -> Kernel {
    if let Ok(first) = Kernel::take() {
        return first;
    }
    // SAFETY: only this hart uses the kernel and the heap, and its start-up code has discarded the
    // stack of its last incarnation. Data that it shares with other harts is not on the heap.
    unsafe {
        tandem_rtos::riscv32::after_reset();
        heap::restart();
    }
    match Kernel::take() {
        Ok(next) => next,
        Err(error) => panic!("{error}"),
    }
}

/// Runs core 0 with its tasks under FreeRTOS.
fn under_kernel(board: &VirtBoard) -> ! {
    log!(
        "core 0 of {} runs its tasks under FreeRTOS, incarnation {}",
        board.identity().system,
        board.identity().generation.0
    );
    tandem_rtos::riscv32::on_fatal(|message| panic!("{message}"));
    // The kernel uses the timer.
    doorbell::set_slice(0);
    let kernel = kernel();
    let board: &'static VirtBoard = Box::leak(Box::new(board.clone()));
    let options = RuntimeOptions {
        stack_bytes: STACK_BYTES,
        held_back: &HELD_BACK,
        overload: overload(),
    };
    match tandem_runtime::start(kernel, board, config(), options, trap::end_if_held) {
        Ok(never) => match never {},
        Err(error) => panic!("{error}"),
    }
}
