//! The process that is one core of one system.

use crate::control_core;
use crate::run_config::{Profile, RunConfig};
use anyhow::Context as _;
use tandem_board::{Board, CoreId, Wake};
use tandem_board_host::{CoreArgs, HostBoard};
use tandem_cores::core1::Core1;
use tandem_cores::core2::Core2;
use tandem_cores::task_table::IrqCode;
use tandem_cores::trace::Event;
use tandem_cores::{Config, Core};

/// Runs the core until its supply ends it. Returns only if it cannot start.
///
/// # Errors
/// If the run that it belongs to is gone, or its arguments are not this program's.
pub(crate) fn run(args: &CoreArgs) -> anyhow::Result<()> {
    let grant = args.claim();
    let config = config(&RunConfig::from_extra(&args.common.extra)?);
    let board = HostBoard::attach(args).context("the core cannot attach to its board")?;
    match args.identity.core {
        CoreId::CONTROL => control_core::go(board, config, grant),
        CoreId::PERCEPTION => go(&board, Core1::new(&board)),
        _ => go(&board, Core2::new(&board)),
    }
}

/// The limits of a run.
pub(crate) fn config(run: &RunConfig) -> Config {
    let mut config = match run.profile {
        Profile::Rt => Config::rt(),
        Profile::Desktop => Config::desktop(),
    };
    config.redundancy.reintegrate = run.reintegrate;
    config
}

fn go(board: &HostBoard, mut core: impl Core) -> ! {
    loop {
        let deadline = core.poll();
        if board.wait(deadline) == Wake::Interrupt {
            let irq = IrqCode::DOORBELL;
            board.trace(Event::Interrupted { irq }.encode());
        }
    }
}
