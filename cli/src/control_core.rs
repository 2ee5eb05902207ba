//! Core 0 of a run: its tasks under FreeRTOS, and the thread that waits at its doorbell.

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use std::thread;

use anyhow::Context as _;
use tandem_board::{Board, Instant};
use tandem_board_host::realtime::{self, Claim, Grant};
use tandem_board_host::{HostBoard, clock};
use tandem_cores::Config;
use tandem_cores::core0::DOORBELL_DISTANCE;
use tandem_rtos::{Interrupt, Kernel, host};
use tandem_runtime::Options;

/// Bytes of a task's stack.
const STACK_BYTES: usize = 64 << 10;
/// How many times the doorbell's thread has merged rings into one.
static HELD_BACK: AtomicU32 = AtomicU32::new(0);

/// Runs core 0 until its supply ends it.
///
/// # Errors
/// If the kernel cannot start.
pub(crate) fn go(board: HostBoard, config: Config, grant: Grant) -> anyhow::Result<()> {
    let board: &'static HostBoard = Box::leak(Box::new(board));
    thread::Builder::new()
        .name("doorbell".to_owned())
        .spawn(move || listen(board, grant))
        .context("the thread at the doorbell")?;
    let options = Options {
        stack_bytes: STACK_BYTES,
        held_back: &HELD_BACK,
        overload: None,
    };
    match tandem_runtime::start(Kernel::take()?, board, config, options, || ())? {}
}

/// Raises the core's interrupt when its doorbell rings, at most once in [`DOORBELL_DISTANCE`].
///
/// This thread is more urgent than the core. A ring that follows the last one too early makes it
/// sleep until the distance is over, so a doorbell that rings without a pause cannot take the CPU
/// from the core. Rings in that time are merged into one.
fn listen(board: &HostBoard, grant: Grant) -> ! {
    // More urgent than the core, whose task it is to interrupt; the CPU is inherited.
    let _ = realtime::claim(Claim {
        priority: grant.fifo.map(|priority| priority.saturating_add(1)),
        cpu: None,
        lock_memory: false,
    });
    let mut open = Instant::ORIGIN;
    loop {
        board.wait(Instant::NEVER);
        if board.now() < open {
            clock::sleep_until(open);
            // Does not wait: the deadline has passed.
            board.wait(Instant::ORIGIN);
            HELD_BACK.fetch_add(1, Relaxed);
        }
        host::raise(Interrupt::DOORBELL);
        open = board.now() + DOORBELL_DISTANCE;
    }
}
