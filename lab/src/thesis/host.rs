//! The experiments with processes of this machine, in real time.

use std::time::{Duration, Instant};

use anyhow::{Context as _, ensure};
use clap::Parser as _;
use rustix::process::Signal;
use tandem_board::{CoreId, RoleLamp, SystemId};
use tandem_board_host::injection::{Injection, Target};
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

/// Returns the arguments of the run in which the faults happen.
fn arguments() -> anyhow::Result<RunArgs> {
    let line =
        "tandem run --scenario free-lane --duration 90s --reintegrate --quiet --stagger 40ms";
    match Cli::try_parse_from(line.split(' '))?.command {
        Command::Run(args) => Ok(args),
        _ => anyhow::bail!("`{line}` is not a run"),
    }
}

/// Records a staggered start and two takeovers. Core 0 of A is killed, which resets A. After A has
/// returned as standby, the supply of B is killed.
pub(super) fn takeovers() -> anyhow::Result<(RunLog, Beside, Done)> {
    let recorded = run::recorded(&arguments()?, |injection, _| {
        let done = act(&injection);
        injection.backplane().request_stop();
        done
    })?;
    Ok((recorded.log, recorded.around.beside, recorded.done))
}

fn act(injection: &Injection) -> anyhow::Result<Done> {
    let backplane = injection.backplane();
    let kill = |target| {
        let killed = injection.signal(target, Signal::KILL);
        killed.then_some(()).context("there is no process")
    };
    wait(backplane, [RoleLamp::Master, RoleLamp::Standby])?;
    std::thread::sleep(PAUSE);
    let reset_ns = clock::now().as_ns();
    kill(Target::Core(SystemId::A, CoreId::CONTROL))?;
    wait(backplane, [RoleLamp::Standby, RoleLamp::Master])?;
    std::thread::sleep(PAUSE);
    let off_ns = clock::now().as_ns();
    kill(Target::Supply(SystemId::B))?;
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

/// Returns two CPUs for the experiments between two cores, or the only CPU twice.
pub(super) fn cpus() -> anyhow::Result<[usize; 2]> {
    let ids = core_affinity::get_core_ids().context("cannot list the CPUs")?;
    let first = ids.first().context("there is no CPU")?;
    Ok([first.id, ids.get(1).unwrap_or(first).id])
}
