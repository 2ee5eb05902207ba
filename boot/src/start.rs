//! The bootloader on its board, from the reset to where core 0 goes next. T-BOOT-1, T-BOOT-7

use crate::loader::{Launch, Loader, Next, Setup};
use crate::map::Bank;
use crate::trust::Trust;
use embedded_storage::nor_flash::NorFlash;
use tandem_board::{Board, Can, Duration, Instant, ResetRequest, Supply, watchdog_answer};

/// Where core 0 goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Leave {
    /// To the application. Clean up (T-BOOT-7), then jump.
    Jump(Launch),
    /// To the bootloader in the primary bank, which is on trial. Clean up as before a jump.
    StartPrimary,
}

/// Runs the bootloader until core 0 leaves it. Resets the system where the bootloader asks for it,
/// and when the flash fails. Core 0, task context; blocks.
///
/// The watchdog is served only while the bootloader waits for a host longer than half the limit of
/// the first service. It then leaves by a reset, so the application always begins with a watchdog
/// that has not been served.
pub fn start<B: Board>(board: &B, flash: impl NorFlash, trust: Trust<'_>, bank: Bank) -> Leave {
    let setup = Setup {
        trust,
        system: board.identity().system,
        bank,
        cause: board.supply().reset_cause(),
    };
    let begin = board.now();
    let Ok(mut loader) = Loader::start(flash, setup, begin) else {
        reset(board)
    };
    board.can().wake_on_receive(true);
    let first = Duration::from_us(u64::from(B::Supply::FIRST_SERVICE_US / 2));
    let mut dog = Dog {
        due: begin + first,
        served: false,
    };
    loop {
        let wait = match loader.next(board.now()) {
            Ok(Next::Wait(until)) => until,
            Ok(Next::Send(frame)) => {
                while board.can().try_send(&frame).is_err() {
                    board.wait(board.now() + Duration::from_ms(1));
                }
                continue;
            }
            Ok(Next::Jump(launch)) if !dog.served => break leave(board, Leave::Jump(launch)),
            Ok(Next::StartPrimary) if !dog.served => break leave(board, Leave::StartPrimary),
            Ok(Next::Jump(_) | Next::StartPrimary | Next::Reset) | Err(_) => reset(board),
        };
        dog.serve(board);
        match board.can().try_receive() {
            Some(received) => loader.on_frame(board.now(), &received.frame),
            None => {
                board.wait(wait.min(dog.due));
            }
        }
    }
}

fn leave<B: Board>(board: &B, to: Leave) -> Leave {
    board.can().wake_on_receive(false);
    to
}

fn reset<B: Board>(board: &B) -> ! {
    board.supply().request_reset(ResetRequest::Software);
    loop {
        board.wait(Instant::NEVER);
    }
}

/// When the watchdog is to be served.
struct Dog {
    due: Instant,
    served: bool,
}

impl Dog {
    fn serve<B: Board>(&mut self, board: &B) {
        if board.now() < self.due {
            return;
        }
        let supply = board.supply();
        supply.service_watchdog(watchdog_answer(supply.watchdog_question()));
        let middle = B::Supply::WINDOW_OPENS_US / 2 + B::Supply::WINDOW_CLOSES_US / 2;
        // Read the clock again: the window counts from the service.
        self.due = board.now() + Duration::from_us(u64::from(middle));
        self.served = true;
    }
}
