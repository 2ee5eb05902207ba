//! Core 0 of a run: its tasks under FreeRTOS, and the thread that waits at its doorbell.

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use std::thread;

use anyhow::Context as _;
use tandem_board::{Board, Instant, Wake};
use tandem_board_host::HostBoard;
use tandem_board_host::realtime::{self, Claim, Grant};
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
/// This thread is more urgent than the core. It sleeps after each ring, so a doorbell that rings
/// without a pause cannot take the CPU from the core. Rings in that time are merged into one.
fn listen(board: &HostBoard, grant: Grant) -> ! {
    // More urgent than the core, whose task it is to interrupt; the CPU is inherited.
    let _ = realtime::claim(Claim {
        priority: grant.fifo.map(|priority| priority.saturating_add(1)),
        cpu: None,
        lock_memory: false,
    });
    loop {
        board.wait(Instant::NEVER);
        loop {
            host::raise(Interrupt::DOORBELL);
            thread::sleep(core::time::Duration::from_nanos(DOORBELL_DISTANCE.as_ns()));
            // Does not wait: the deadline has passed.
            if board.wait(Instant::ORIGIN) == Wake::Deadline {
                break;
            }
            HELD_BACK.fetch_add(1, Relaxed);
        }
    }
}
