//! The smallest application on the host: see [`tandem_boot::three_frames`]. T-BOOT-8

use anyhow::Context as _;
use tandem_board::{Duration, Supply};
use tandem_board_host::{CoreArgs, HostBoard, HostSupply};

/// Name of the application in a slot.
pub const NAME: &str = "three-frames";
/// Period at which each core sends a frame, and core 0 services the watchdog.
const PERIOD: Duration = Duration::from_ms(20);

/// Runs a core of the application until its supply ends it.
///
/// # Errors
/// If the run has ended.
pub(crate) fn run(args: &CoreArgs) -> anyhow::Result<()> {
    const { assert!(HostSupply::WINDOW_CLOSES_US as u64 * 1_000 > PERIOD.as_ns()) };
    let board = HostBoard::attach(args).context("the core cannot attach to its board")?;
    tandem_boot::three_frames(&board, PERIOD, &mut ())
}
