//! Core 0 of a run: its tasks under FreeRTOS, and the thread that waits for its doorbell.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use std::thread;

use anyhow::Context as _;
use tandem_board::{Board, Duration, Instant};
use tandem_board_host::realtime::{self, Claim, Grant};
use tandem_board_host::{Alarm, HostBoard, clock};
use tandem_cores::Config;
use tandem_cores::doorbell::{DoorbellThrottle, RingOutcome};
use tandem_rtos::{Interrupt, Kernel, host};
use tandem_runtime::RuntimeOptions;

/// Size of a task's stack, bytes.
const STACK_BYTES: usize = 64 << 10;
/// Number of times the doorbell's thread has merged several rings into one.
static HELD_BACK: AtomicU32 = AtomicU32::new(0);

/// Sleep time of the thread that watches this CPU for stalls. It is two ticks of core 0, so the
/// timer that core 0 postpones is never the next timer of the CPU. If it were the next one, the
/// kernel would have to reprogram the hardware at each tick.
pub const WATCH_PERIOD: Duration = Duration::from_ms(2);

/// Makes each tick postpone the end of that sleep from now on. Only the first call has an effect.
pub(crate) fn postpone_at_ticks(alarm: Alarm) {
    static ALARM: OnceLock<Alarm> = OnceLock::new();
    if ALARM.set(alarm).is_ok() {
        host::observe_ticks(Some(|_| {
            if let Some(alarm) = ALARM.get() {
                alarm.postpone(WATCH_PERIOD);
            }
        }));
    }
}

/// Runs core 0 until its supply ends the process.
///
/// # Errors
/// If the kernel cannot start.
pub(crate) fn go(board: HostBoard, config: Config, grant: Grant) -> anyhow::Result<()> {
    let board: &'static HostBoard = Box::leak(Box::new(board));
    thread::Builder::new()
        .name("doorbell".to_owned())
        .spawn(move || listen(board, grant))
        .context("the doorbell's thread")?;
    let options = RuntimeOptions {
        stack_bytes: STACK_BYTES,
        held_back: &HELD_BACK,
        overload: None,
    };
    match tandem_runtime::start(Kernel::take()?, board, config, options, || ())? {}
}

/// Raises the core's interrupt when its doorbell rings, at most once in
/// [`DOORBELL_DISTANCE`](tandem_cores::doorbell::DOORBELL_DISTANCE).
///
/// This thread has a higher priority than the core. If a ring follows the previous one too early,
/// the thread sleeps until the distance has passed, so a doorbell that rings without a pause cannot
/// take the CPU from the core. Rings in that time are merged into one.
fn listen(board: &HostBoard, grant: Grant) -> ! {
    // This thread interrupts the core, so it needs a higher priority. It inherits its CPU.
    let _ = realtime::claim(Claim {
        priority: grant.fifo.map(|priority| priority.saturating_add(1)),
        cpu: None,
        lock_memory: false,
    });
    let throttle = DoorbellThrottle::default();
    loop {
        board.wait(Instant::NEVER);
        if throttle.ring(board.now()) == RingOutcome::HeldBack {
            clock::sleep_until(throttle.due());
            // This call does not wait, because the deadline has passed.
            board.wait(Instant::ORIGIN);
            throttle.pass_if_due(board.now());
            HELD_BACK.store(throttle.held_back(), Relaxed);
        }
        host::raise(Interrupt::DOORBELL);
    }
}
