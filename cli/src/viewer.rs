//! A program that shows a run beside it: in Foxglove, or as the live page. `tandem run` starts it;
//! it is an observer like any other, and the run does not depend on it.
//!
//! When the program is ready, `tandem run` names the run in one line on its stdin ([`RunToShow`]).

use std::ffi::OsString;
use std::io::{BufRead as _, Read as _, stdin};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::Context as _;
use serde::{Deserialize, Serialize};
use tandem_board_host::RunName;
use tandem_observers::Observer;

use crate::args::RunArgs;
use crate::beside::{Attendant, Program};
use crate::failure::Failure;

/// Time within which the program must end, and complete its file.
const ENDS_WITHIN: Duration = Duration::from_secs(20);
/// Delay of the next look whether the run publishes.
const POLL: Duration = Duration::from_millis(5);

/// What `tandem run` tells the program when the run begins.
#[derive(Debug, Serialize, Deserialize)]
pub struct RunToShow {
    /// The name of the run.
    pub run: String,
    /// The run's time is not that of this machine.
    pub is_virtual: bool,
    /// The run's processes have a real-time priority.
    pub realtime: bool,
}

/// A run beside which this program was started.
pub struct ShownRun {
    /// The connection to its services.
    pub observer: Observer,
    /// The run's time is not that of this machine.
    pub is_virtual: bool,
}

/// Waits until `tandem run` names the run, and until it publishes. Lets the run's processes have
/// precedence on the CPUs. Sets `over` as soon as `tandem run` closes stdin, or has died.
///
/// Returns `None` if the run ends before it publishes, or has not started.
///
/// # Errors
/// If stdin cannot be read, or another program than `tandem run` wrote to it.
pub fn run_to_show(over: &Arc<AtomicBool>) -> anyhow::Result<Option<ShownRun>> {
    let mut line = String::new();
    stdin().lock().read_line(&mut line).context("stdin")?;
    let ends = Arc::clone(over);
    std::thread::spawn(move || {
        let _ = stdin().lock().read_to_end(&mut Vec::new());
        ends.store(true, Ordering::Relaxed);
    });
    if line.is_empty() {
        return Ok(None);
    }
    let begin: RunToShow = serde_json::from_str(&line).context("the first line")?;
    if !begin.realtime {
        // All processes of the run have precedence. A real-time priority gives it anyway.
        let _ = rustix::process::nice(10);
    }
    let run = begin.run.parse().context("the name of the run")?;
    while !over.load(Ordering::Relaxed) {
        if let Ok(observer) = Observer::of(&run) {
            return Ok(Some(ShownRun {
                observer,
                is_virtual: begin.is_virtual,
            }));
        }
        std::thread::sleep(POLL);
    }
    Ok(None)
}

/// Starts the programs that the arguments ask for. They open their files and ports before the run
/// gets its own `/dev/shm`.
///
/// # Errors
/// See [`Attendant::start`].
pub(crate) fn start(args: &RunArgs) -> Result<Vec<Attendant>, Failure> {
    let mut viewers = Vec::new();
    let mut add = |program, what, command: &str, words| {
        let words = [vec![command.into(), "--beside".into()], words].concat();
        viewers.push(Attendant::start(program, what, words, ENDS_WITHIN)?);
        Ok::<_, Failure>(())
    };
    if args.mcap.is_some() || args.foxglove.is_some() {
        let mut words = port(args.foxglove);
        if let Some(file) = &args.mcap {
            words.extend(["--mcap".into(), file.into()]);
        }
        add(Program::Foxglove, "program for Foxglove", "foxglove", words)?;
    }
    if args.web.is_some() {
        add(Program::Web, "live page", "web", port(args.web))?;
    }
    Ok(viewers)
}

/// Tells a program which run to show.
pub(crate) fn begin(viewer: &mut Attendant, run: &RunName, realtime: bool, is_virtual: bool) {
    let begin = RunToShow {
        run: run.to_string(),
        is_virtual,
        realtime,
    };
    if let Ok(line) = serde_json::to_string(&begin) {
        viewer.tell(&line);
    }
}

fn port(port: Option<u16>) -> Vec<OsString> {
    let words = port.map(|port| ["--port".into(), port.to_string().into()]);
    words.into_iter().flatten().collect()
}
