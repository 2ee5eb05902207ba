//! The contexts from which each method may be called.

use core::sync::atomic::{AtomicU32, Ordering};

use tandem_board::{
    Board, Can, CanFrame, CanId, Channel, DataFlash, Edge, Line, Lines, Link, Network, Recipient,
    RoleLamp, Supply,
};

use crate::case::{CaseFailure, check};

/// First word of a handler's trace records. The second word counts the handler's runs, from 0.
const FROM_HANDLER: u32 = 0xC0_0001;
/// First word of the trace records of a task.
const FROM_TASK: u32 = 0xC0_0002;

/// A handler for tests: it calls each method that may be called from any context.
#[derive(Debug, Default)]
pub struct Handler {
    runs: AtomicU32,
}

impl Handler {
    /// First word of the handler's trace records.
    pub const TRACE_CODE: u32 = FROM_HANDLER;
    /// First word of the trace records of [`in_task`].
    pub const TASK_TRACE_CODE: u32 = FROM_TASK;

    /// Makes a handler that has not run.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            runs: AtomicU32::new(0),
        }
    }

    /// Returns how many times the handler has run to its end.
    #[must_use]
    pub fn runs(&self) -> u32 {
        self.runs.load(Ordering::Relaxed)
    }

    /// Runs the handler once. It calls everything except `request_reset`, which would end the test.
    /// It asserts nothing: an error shows in the task, in the trace, or as a deadlock.
    pub fn run<B: Board>(&self, board: &B) {
        let run = self.runs.load(Ordering::Relaxed);
        let identity = board.identity();
        board.trace([FROM_HANDLER, run, board.now().to_words()[0], 0]);
        board.lmu()[identity.core.index()].load(Ordering::Relaxed);
        board.ring(identity.core);
        let lines = board.lines();
        lines.send(Line::Heartbeat1, Edge::Rising);
        lines.received(Line::Heartbeat2, Edge::Falling);
        lines.send(Line::Time, Edge::Rising);
        lines.time_edge();
        lines.peer_powered();
        board.can().wake_on_receive(run.is_multiple_of(2));
        board.can().overruns();
        board.flash().status();
        board.supply().reset_cause();
        board.supply().show_role(RoleLamp::Standby);
        board.link();
        board.network().address(Channel::Time);
        self.runs.store(run + 1, Ordering::Relaxed);
    }
}

/// The task that the handler interrupts. It calls every method except `request_reset` and those
/// that would reset the system or wear out its flash. `round` counts from 0.
///
/// # Errors
/// [`CaseFailure`] if a call of the handler disturbed a call of the task.
pub fn in_task<B: Board>(board: &B, round: u32) -> Result<(), CaseFailure> {
    board.trace([FROM_TASK, round, 0, 0]);
    let before = board.now();
    board.ring(board.identity().core);
    board.wait(before);
    check(board.now() >= before, "the clock never goes back")?;
    let frame = CanFrame::new(CanId::Standard(0x7F0), false, &round.to_le_bytes());
    if let Ok(frame) = frame {
        // Fails if the buffer is full: the bus may be slower than this loop.
        let _ = board.can().try_send(&frame);
        let _ = board.can().try_send_stamped(&frame);
    }
    board.can().stamp();
    board.can().discard_unsent();
    board.can().try_receive();
    let _ = board.link().try_send(&[round]);
    board.link().try_receive(&mut [0]);
    for channel in Channel::ALL {
        let _ = board
            .network()
            .try_send(channel, Recipient::Everyone, &[0; 8]);
        board.network().sent_at(channel);
        board.network().try_receive(channel, &mut [0; 8]);
    }
    let read = board.flash().read(0, &mut [0; 8]);
    check(read.is_ok(), "an idle flash can be read")?;
    board.supply().watchdog_question();
    let lines = board.lines();
    lines.send(Line::Heartbeat2, Edge::Falling);
    lines.received(Line::Heartbeat1, Edge::Rising);
    lines.send(Line::Time, Edge::Rising);
    lines.time_edge();
    Ok(())
}
