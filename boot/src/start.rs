//! Runs the bootloader on a board, from the reset until core 0 leaves it. T-BOOT-1, T-BOOT-7

use crate::loader::{Launch, Loader, Next, Setup};
use crate::map::Bank;
use crate::trust::Trust;
use core::cell::Cell;
use embedded_storage::nor_flash::NorFlash;
use tandem_board::{Board, Can, Duration, Instant, ResetRequest, Supply, watchdog_answer};

/// Where core 0 continues.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Leave {
    /// In the application. Clean up (T-BOOT-7), then jump.
    Jump(Launch),
    /// In the bootloader in this bank. Clean up as for a jump, then start it.
    StartBank(Bank),
}

/// Services the watchdog if the bootloader runs longer than half the limit of the first service.
pub trait Keeper {
    /// Services the watchdog if that is due. Returns the next due time; [`Instant::NEVER`] if no
    /// further call is needed.
    fn keep(&self) -> Instant;

    /// Stops servicing. Returns whether an application may continue from here; if not, the
    /// bootloader ends with a reset.
    fn hand_over(&self) -> bool;
}

/// Services the watchdog between the steps of the bootloader. For boards on which each step is
/// shorter than the watchdog's window. An application may continue only before the first service.
#[derive(Debug)]
pub struct BetweenSteps<'b, B> {
    board: &'b B,
    due: Cell<Instant>,
    served: Cell<bool>,
}

/// Returns the time from the start to the bootloader's first service.
#[must_use]
pub const fn first_service<S: Supply>() -> Duration {
    Duration::from_us((S::FIRST_SERVICE_US / 2) as u64)
}

/// Returns the time between two services of the bootloader.
#[must_use]
pub const fn next_service<S: Supply>() -> Duration {
    Duration::from_us((S::WINDOW_OPENS_US / 2 + S::WINDOW_CLOSES_US / 2) as u64)
}

impl<'b, B: Board> BetweenSteps<'b, B> {
    /// Creates a keeper at the start of the system.
    #[must_use]
    pub fn new(board: &'b B) -> Self {
        Self {
            board,
            due: Cell::new(board.now() + first_service::<B::Supply>()),
            served: Cell::new(false),
        }
    }
}

impl<B: Board> Keeper for BetweenSteps<'_, B> {
    fn keep(&self) -> Instant {
        if self.board.now() >= self.due.get() {
            let supply = self.board.supply();
            supply.service_watchdog(watchdog_answer(supply.watchdog_question()));
            // Read the clock again: the window counts from the service.
            let next = self.board.now() + next_service::<B::Supply>();
            self.due.set(next);
            self.served.set(true);
        }
        self.due.get()
    }

    fn hand_over(&self) -> bool {
        !self.served.get()
    }
}

/// What not every board has.
#[derive(Clone, Copy, Debug, Default)]
pub struct Security {
    /// As in [`Setup::noise`].
    pub noise: [u8; 32],
    /// As in [`Setup::counter`].
    pub counter: u32,
}

/// Runs the bootloader until core 0 leaves it. Resets the system if the bootloader requests a
/// reset. Core 0, task context; blocks.
pub fn start<B: Board>(
    board: &B,
    flash: impl NorFlash,
    trust: Trust<'_>,
    bank: Bank,
    keeper: &impl Keeper,
    security: Security,
) -> Leave {
    let setup = Setup {
        trust,
        system: board.identity().system,
        bank,
        cause: board.supply().reset_cause(),
        starts: board.supply().starts(),
        counter: security.counter,
        noise: security.noise,
    };
    let mut loader = Loader::start(flash, setup, board.now());
    board.can().wake_on_receive(true);
    loop {
        let wait = match loader.next(board.now()) {
            Next::Wait(until) => until,
            Next::Send(frame) => {
                // If the buffer stays full, the host asks again.
                if board.can().try_send(&frame).is_err() {
                    board.wait(board.now() + Duration::from_ms(1));
                    let _lost = board.can().try_send(&frame);
                }
                keeper.keep();
                continue;
            }
            Next::Jump(launch) if keeper.hand_over() => {
                break leave(board, Leave::Jump(launch));
            }
            Next::StartBank(bank) if keeper.hand_over() => {
                break leave(board, Leave::StartBank(bank));
            }
            Next::Jump(_) | Next::StartBank(_) | Next::Reset => reset(board),
        };
        let due = keeper.keep();
        match board.can().try_receive() {
            Some(received) => loader.on_frame(board.now(), &received.frame),
            None => {
                board.wait(wait.min(due));
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
