//! The smallest application, for any board: each of its three cores sends a CAN frame with its
//! number. T-BOOT-8

use tandem_board::{
    Board, Can, CanFrame, CanId, CoreId, DeskAction, Duration, Instant, Supply, TesterDesk,
    watchdog_answer,
};

/// The id of core 0's frames; the other cores use the next ids.
pub const FIRST_ID: u16 = 0x700;

/// Runs the application on this core and never returns. Sends a frame every `period`; core 0 also
/// services the watchdog then, so the period must lie in the watchdog's window. The desk
/// answers a tester, and approves the image after a second. It is not core 0's if a signature takes
/// longer than the window.
pub fn three_frames<B: Board>(board: &B, period: Duration, desk: &mut impl TesterDesk) -> ! {
    let core = board.identity().core;
    let number = core.index() as u8;
    let id = CanId::Standard(FIRST_ID + u16::from(number));
    // One byte always fits.
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
                // If the buffer is full, skip this frame: the next period sends another.
                let _ = board.can().try_send(frame);
            }
            if core == CoreId::CONTROL {
                let supply = board.supply();
                supply.service_watchdog(watchdog_answer(supply.watchdog_question()));
            }
            serve(board, desk);
        }
        board.wait(due);
    }
}

/// Passes the frames that have arrived to the desk, and does what it wants.
fn serve<B: Board>(board: &B, desk: &mut impl TesterDesk) {
    let carry_out = |action| match action {
        Some(DeskAction::Send(frame)) => {
            let _ = board.can().try_send(&frame);
        }
        // No vehicle needs this application.
        Some(DeskAction::Leave(request)) => board.supply().request_reset(request),
        Some(DeskAction::ConfirmStart) => board.supply().confirm_start(),
        None => {}
    };
    while let Some(received) = board.can().try_receive() {
        carry_out(desk.hear(board.now(), &received.frame));
    }
    carry_out(desk.poll(board.now(), true));
}
