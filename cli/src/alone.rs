//! What the vehicle's process does after `tandem run` has died: it ends the run and reports it.

use std::process;
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use tandem_board_host::realtime::give_back;
use tandem_board_host::{RunName, process_list};
use tandem_processes::files::RunFiles;
use tandem_processes::run_config::{LastReport, RunConfig};

use crate::collected::Collected;
use crate::output::ReportFolder;
use crate::run::surroundings;

/// Time for the processes of a run to end without power.
const POWERED_DOWN: Duration = Duration::from_millis(500);

/// Writes the report of this run in the process of the vehicle, because the process that had
/// started the run has died. Does nothing if that process would not have written one.
///
/// # Errors
/// If the run left no recording, or the folder cannot be written.
pub(crate) fn report_alone(run: &RunName, config: &RunConfig) -> anyhow::Result<()> {
    // Nothing depends on this process any longer: it must not keep others from running.
    give_back();
    end_others(run);
    let Some(LastReport { out, granted }) = &config.report else {
        return Ok(());
    };
    let out = ReportFolder::check(out)?;
    let collected = Collected::new(&out, &RunFiles::of(run), &|| "ended alone".to_owned())?;
    // As if it had been interrupted: without a drive an older report stays.
    if collected.log.driven_s() <= 0.0 {
        return Ok(());
    }
    let around = surroundings(config, granted.clone()).after_launcher();
    collected.write(&out, &around).map(drop)
}

/// Kills the processes that have not ended with their power: one that is stopped does not see that
/// the ignition is off.
fn end_others(run: &RunName) {
    let own = process::id();
    let others = || {
        process_list::of_run(run)
            .into_iter()
            .filter(|it| it.pid != own)
    };
    let until = Instant::now() + POWERED_DOWN;
    while others().next().is_some() && Instant::now() < until {
        thread::sleep(POWERED_DOWN / 10);
    }
    for other in others() {
        let pid = i32::try_from(other.pid).ok().and_then(Pid::from_raw);
        // It may have ended since.
        let _ = pid.map(|pid| kill_process(pid, Signal::KILL));
    }
}
