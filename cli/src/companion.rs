//! A process beside a run, which `tandem run` starts: the SoC, or the grandmaster of time.
//!
//! The launcher of `tandem exec` runs it, in a thread of `tandem run`. The run does not depend on
//! the process, and does not wait for it. It ends by SIGTERM: at the end of the run, and from the
//! kernel if `tandem run` is killed.

use std::ffi::OsString;
use std::fs;
use std::io::Write as _;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::channel;
use std::thread::JoinHandle;

use anyhow::{Context as _, anyhow};
use signal_hook::consts::SIGTERM;
use tandem_board_host::process_report;
use tandem_board_host::realtime::{Claim, claim};
use tandem_exec_host::launcher::{LaunchEvent, ProcessLauncher, Told};

/// Priority under SCHED_FIFO, below those of all cores: an ADAS computer keeps its periods.
const PRIORITY: u8 = 20;

/// Which process, and what `tandem run` says if it ends before the run.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CompanionKind {
    /// Its command, a hidden one of `tandem`.
    pub(crate) command: &'static str,
    /// Whose process it is.
    pub(crate) whose: &'static str,
    /// What its end causes.
    pub(crate) causes: &'static str,
}

/// The process, as seen by `tandem run`. Dropping it ends the process.
pub(crate) struct Companion {
    stop: UnixStream,
    thread: Option<JoinHandle<Option<String>>>,
}

impl Companion {
    /// Starts the process, with these arguments. `leaves` is the file that it leaves; its manifest
    /// and what it says are beside it. Also returns its id.
    ///
    /// # Errors
    /// If the process does not start.
    pub(crate) fn start(
        kind: CompanionKind,
        leaves: &Path,
        args: impl IntoIterator<Item = OsString>,
    ) -> anyhow::Result<(Self, u32)> {
        let said = leaves.with_extension("said");
        let path = leaves.with_extension("manifest");
        let text = manifest(kind, &said, args)?;
        fs::write(&path, text).with_context(|| path.display().to_string())?;
        let launcher = ProcessLauncher::open(&path, None)?;
        let (stop, stops) = UnixStream::pair().context("a socket")?;
        let (started, has_started) = channel();
        let run = move || {
            let mut died = None;
            let ended = launcher.run(stops, false, &mut |told: &Told| match &told.event {
                // The run may have ended since.
                LaunchEvent::Started { pid, .. } => drop(started.send(*pid)),
                LaunchEvent::Failed { why, .. } => died = Some(last_words(kind, why, &said)),
                _ => {}
            });
            died.or_else(|| ended.err().map(|error| error.to_string()))
        };
        let thread = std::thread::Builder::new().name(kind.command.to_owned());
        let thread = thread.spawn(run);
        let thread = thread.with_context(|| format!("a thread for {}", kind.whose))?;
        match has_started.recv() {
            Ok(pid) => Ok((
                Self {
                    stop,
                    thread: Some(thread),
                },
                pid,
            )),
            Err(_) => {
                let why = thread.join().ok().flatten().unwrap_or_default();
                Err(anyhow!("the process of {}: {why}", kind.whose))
            }
        }
    }

    /// Ends the process. Kills it if it does not end. Returns how it ended, if that was before.
    pub(crate) fn end(&mut self) -> Option<String> {
        // Fails if it has ended.
        let _ = self.stop.write_all(b"x");
        self.thread.take()?.join().ok().flatten()
    }
}

impl Drop for Companion {
    fn drop(&mut self) {
        self.end();
    }
}

/// Returns the manifest of a process that is not restarted: what it drove is over with it.
fn manifest(
    kind: CompanionKind,
    said: &Path,
    args: impl IntoIterator<Item = OsString>,
) -> anyhow::Result<String> {
    let this = tandem_board_host::this_program();
    let program = this.get_program().to_string_lossy().into_owned();
    let words = this.get_args().map(ToOwned::to_owned);
    let words = words.chain([OsString::from(kind.command)]).chain(args);
    let words = words
        .map(OsString::into_string)
        .collect::<Result<Vec<_>, _>>();
    let words = words.map_err(|word| anyhow!("{}: not UTF-8", word.display()))?;
    let environment = std::env::vars_os().filter_map(|(name, value)| {
        let pair = (name.into_string().ok()?, value.into_string().ok()?);
        Some(pair)
    });
    let environment: std::collections::BTreeMap<_, _> = environment.collect();
    let manifest = serde_json::json!({
        "version": 1,
        "initial": "run",
        "process": [{
            "name": kind.command,
            "program": program,
            "arguments": words,
            "environment": environment,
            "directory": std::env::current_dir().context("the current folder")?,
            "output": said,
            "ready-within": "60s",
        }],
        "target": [{ "name": "run", "processes": [kind.command] }],
    });
    toml::to_string(&manifest).context("the manifest of a process")
}

/// Returns how the process ended, and what it said. Prints it.
fn last_words(kind: CompanionKind, why: &str, said: &Path) -> String {
    let how = why.strip_prefix("it ended: ").unwrap_or(why);
    let said = fs::read_to_string(said).unwrap_or_default();
    let died = match said.trim() {
        "" => how.to_owned(),
        said => format!("{how}: {said}"),
    };
    let CompanionKind { whose, causes, .. } = kind;
    eprintln!("{whose}'s process ended ({died}): {causes}");
    died
}

/// In the process: returns what becomes true when the run is over. Claims real time if it is to.
///
/// # Errors
/// If SIGTERM cannot be handled, or the launcher cannot be told.
pub(crate) fn begin(realtime: bool) -> anyhow::Result<Arc<AtomicBool>> {
    let over = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(SIGTERM, Arc::clone(&over)).context("SIGTERM")?;
    // Whoever starts it without a launcher needs no report.
    process_report::ready().context("the launcher")?;
    if realtime {
        claim_realtime();
    }
    Ok(over)
}

/// Claims the priority of a process beside a run. The run says what the machine grants.
pub(crate) fn claim_realtime() {
    let _ = claim(Claim {
        priority: Some(PRIORITY),
        cpu: None,
        lock_memory: true,
    });
}
