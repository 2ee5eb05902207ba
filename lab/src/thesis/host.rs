//! The experiments with processes of this machine, in real time.

use std::time::{Duration, Instant};

use anyhow::{Context as _, ensure};
use clap::Parser as _;
use rustix::process::{Pid, Signal, kill_process};
use tandem_board::{CoreId, RoleLamp, SystemId};
use tandem_board_host::{Backplane, clock};
use tandem_record::RunLog;
use tandem_record::verdict::Beside;

use super::outputs::Done;
use crate::args::{Cli, Command};
use tandem::args::RunArgs;
use tandem::run;

const POLL_INTERVAL: Duration = Duration::from_millis(5);
/// Longest wait for a state of the systems.
const PATIENCE: Duration = Duration::from_secs(40);
/// Time of undisturbed driving between two faults.
const PAUSE: Duration = Duration::from_millis(1_500);

/// The run in which the faults happen.
fn arguments() -> anyhow::Result<RunArgs> {
    let line =
        "tandem run --scenario free-lane --duration 90s --reintegrate --quiet --stagger 40ms";
    match Cli::try_parse_from(line.split(' '))?.command {
        Command::Run(args) => Ok(args),
        _ => anyhow::bail!("`{line}` is not a run"),
    }
}

/// Records a staggered start and two takeovers: core 0 of A is killed, which resets A; when A has
/// returned as standby, the supply of B is killed.
pub(super) fn takeovers() -> anyhow::Result<(RunLog, Beside, Done)> {
    let recorded = run::recorded(&arguments()?, |injection, _| {
        let done = act(injection.backplane());
        injection.backplane().request_stop();
        done
    })?;
    Ok((recorded.log, recorded.around.beside, recorded.done))
}

fn act(backplane: Backplane) -> anyhow::Result<Done> {
    wait(backplane, [RoleLamp::Master, RoleLamp::Standby])?;
    std::thread::sleep(PAUSE);
    let core = backplane.core_pid(SystemId::A, CoreId::CONTROL);
    let reset_ns = clock::now().as_ns();
    kill(core)?;
    wait(backplane, [RoleLamp::Standby, RoleLamp::Master])?;
    std::thread::sleep(PAUSE);
    let supply = backplane.supply_pid(SystemId::B);
    let off_ns = clock::now().as_ns();
    kill(supply)?;
    std::thread::sleep(PAUSE);
    Ok(Done { reset_ns, off_ns })
}

fn wait(backplane: Backplane, lamps: [RoleLamp; 2]) -> anyhow::Result<()> {
    let begin = Instant::now();
    let shown = || SystemId::ALL.map(|system| backplane.role(system));
    while shown() != lamps {
        let late = begin.elapsed() > PATIENCE;
        ensure!(!late, "the systems are {:?} instead of {lamps:?}", shown());
        std::thread::sleep(POLL_INTERVAL);
    }
    Ok(())
}

fn kill(pid: u32) -> anyhow::Result<()> {
    let pid = i32::try_from(pid).ok().and_then(Pid::from_raw);
    kill_process(pid.context("there is no process")?, Signal::KILL).context("kill")
}

/// Returns two CPUs for the experiments between two cores; the same one twice if there is only one.
pub(super) fn cpus() -> anyhow::Result<[usize; 2]> {
    let ids = core_affinity::get_core_ids().context("cannot list the CPUs")?;
    let first = ids.first().context("there is no CPU")?;
    Ok([first.id, ids.get(1).unwrap_or(first).id])
}
