//! The process that is one core of one system.

use crate::run_config::{LimitProfile, RunConfig};
use crate::{boot, control_core, three_frames};
use anyhow::{Context as _, bail};
use tandem_board::{Board, CoreId, Wake};
use tandem_board_host::{CoreArgs, HostBoard};
use tandem_cores::core1::Core1;
use tandem_cores::core2::Core2;
use tandem_cores::task_table::IrqCode;
use tandem_cores::trace::Event;
use tandem_cores::{Config, Core};

/// Runs the core until its supply ends the process: first the bootloader, then the application in
/// the slot. Returns only if the core cannot start.
///
/// # Errors
/// If the run has ended, or the arguments are not from this program.
pub fn run(args: &CoreArgs, run: &RunConfig) -> anyhow::Result<()> {
    let grant = args.claim();
    match (&args.application, &run.program_flash) {
        (None, Some(flash)) => return boot::run(args, flash),
        (Some(name), _) if name == three_frames::NAME => return three_frames::run(args),
        (Some(name), _) if name != boot::CONTROLLER => bail!("there is no application {name:?}"),
        (Some(_), _) | (None, None) => {}
    }
    let config = config(run);
    let alarm = run.stall_alarm(grant.cpu);
    let board = HostBoard::attach(args).context("the core cannot attach to its board")?;
    if let Some(error) = board.network().error() {
        eprintln!("{}: no network: {error}", args.identity.address());
    }
    let of = args.identity;
    match of.core {
        CoreId::CONTROL => {
            if let Some(alarm) = alarm {
                control_core::postpone_at_ticks(alarm);
            }
            control_core::go(board, config, grant)
        }
        CoreId::PERCEPTION => go(&board, Core1::new(&board)),
        _ => match &run.program_flash {
            Some(flash) => {
                let desk = boot::desk(&board, args, flash, &flash.testers)?;
                go(&board, Core2::with_desk(&board, desk))
            }
            None => go(&board, Core2::new(&board)),
        },
    }
}

/// Returns the time limits of the cores in a run.
pub fn config(run: &RunConfig) -> Config {
    let mut config = match run.profile {
        LimitProfile::Rt => Config::rt(),
        LimitProfile::Desktop => Config::desktop(),
    };
    config.redundancy = run.budget().config();
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
