//! The smallest application, on any board: its three cores each send a CAN frame with their number.
//! T-BOOT-8

use tandem_board::{
    Board, Can, CanFrame, CanId, CoreId, Duration, Instant, Supply, watchdog_answer,
};

/// The id of core 0's frames; those of the others follow.
pub const FIRST_ID: u16 = 0x700;

/// Is this board's core of it, for ever: sends every `period`, in which core 0 also services the
/// watchdog. The period must lie in the watchdog's window.
pub fn three_frames<B: Board>(board: &B, period: Duration) -> ! {
    let core = board.identity().core;
    let number = core.index() as u8;
    let id = CanId::Standard(FIRST_ID + u16::from(number));
    // One byte fits.
    let frame = CanFrame::new(id, false, &[number]).ok();
    if core == CoreId::CONTROL {
        board.release_core(CoreId::PERCEPTION);
        board.release_core(CoreId::PLANNING);
    }
    let mut due = Instant::ORIGIN;
    loop {
        let now = board.now();
        if now >= due {
            due = now + period;
            if let Some(frame) = &frame {
                // Full: the bus is slower, and the next one will do.
                let _ = board.can().try_send(frame);
            }
            if core == CoreId::CONTROL {
                let supply = board.supply();
                supply.service_watchdog(watchdog_answer(supply.watchdog_question()));
            }
        }
        board.wait(due);
    }
}
