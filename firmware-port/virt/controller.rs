//! The three cores of the whole controller, each of which runs its tasks to completion.
//!
//! Strap `First`: the systems in this machine, 1 A, 2 B, 3 both.
//! Strap `Second`, bit 0: a system that returns becomes the standby of the running one. Bit 1: the
//! timing profile is `chip`, otherwise `rt`. The limits of `chip` hold only with both systems in
//! one machine: between two machines, edges and datagrams take up to 2 ms.

use crate::board::VirtBoard;
use crate::memory::{Strap, strap};
use tandem_board::{Board, CoreId};
use tandem_cores::core0::Core0;
use tandem_cores::core1::Core1;
use tandem_cores::core2::Core2;
use tandem_cores::{Config, Core};

/// Bits of strap `Second`.
const REINTEGRATE: u32 = 1;
const CHIP: u32 = 2;
/// A turn, 50 us: the emulator runs one hart at a time, so a long turn delays the other harts.
pub const SLICE_TICKS: u32 = 500;

/// Runs one incarnation of one core.
pub fn core(board: &VirtBoard) {
    match board.identity().core {
        CoreId::CONTROL => go(board, Core0::new(board, config())),
        CoreId::PERCEPTION => go(board, Core1::new(board)),
        _ => go(board, Core2::new(board)),
    }
}

/// Returns the configuration from the straps.
pub fn config() -> Config {
    let options = strap(Strap::Second);
    let mut config = match options & CHIP {
        0 => Config::rt(),
        _ => Config::chip(),
    };
    config.redundancy.reintegrate = options & REINTEGRATE != 0;
    config
}

/// Runs a core for ever.
pub fn go(board: &VirtBoard, mut core: impl Core) -> ! {
    loop {
        let deadline = core.poll();
        board.wait(deadline);
    }
}
