//! The smallest application: its three cores each send a CAN frame with their number. T-BOOT-8

use anyhow::{Context as _, anyhow};
use tandem_board::{
    Board, Can, CanFrame, CanId, CoreId, Duration, Instant, Supply, watchdog_answer,
};
use tandem_board_host::{CoreArgs, HostBoard, HostSupply};

/// What a slot names it.
pub(crate) const NAME: &str = "three-frames";
/// The id of core 0's frames; those of the others follow.
pub(crate) const FIRST_ID: u16 = 0x700;
/// How often each core sends.
const PERIOD: Duration = Duration::from_ms(20);

/// Is a core of it, until its supply ends it.
///
/// # Errors
/// If the run is over.
pub(crate) fn run(args: &CoreArgs) -> anyhow::Result<()> {
    let board = HostBoard::attach(args).context("the core cannot attach to its board")?;
    let core = args.identity.core;
    let number = core.index() as u8;
    let id = CanId::Standard(FIRST_ID + u16::from(number));
    let frame = CanFrame::new(id, false, &[number]);
    let frame = frame.map_err(|_| anyhow!("the frame of a core"))?;
    if core == CoreId::CONTROL {
        board.release_core(CoreId::PERCEPTION);
        board.release_core(CoreId::PLANNING);
    }
    const { assert!(HostSupply::WINDOW_CLOSES_US as u64 * 1_000 > PERIOD.as_ns()) };
    let mut due = Instant::ORIGIN;
    loop {
        let now = board.now();
        if now >= due {
            due = now + PERIOD;
            // Full: the bus is slower, and the next one will do.
            let _ = board.can().try_send(&frame);
            if core == CoreId::CONTROL {
                let supply = board.supply();
                supply.service_watchdog(watchdog_answer(supply.watchdog_question()));
            }
        }
        board.wait(due);
    }
}
