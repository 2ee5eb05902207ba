//! A process beside a run, which `tandem run` starts: the SoC, or the grandmaster of time.
//!
//! The run does not depend on the process, and does not wait for it. The process ends when its
//! standard input closes: so it ends with the run, and also if `tandem run` is killed.

use std::ffi::OsString;
use std::io::{self, Read as _};
use std::os::unix::process::CommandExt as _;
use std::process::{Child, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use tandem_board_host::realtime::{Claim, claim};

/// Priority under SCHED_FIFO, below those of all cores: an ADAS computer keeps its periods.
const PRIORITY: u8 = 20;
/// Interval at which the run checks whether the process still exists.
const LOOKS_EVERY: Duration = Duration::from_millis(100);
/// Time within which the process must end.
const ENDS_WITHIN: Duration = Duration::from_secs(1);

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
    /// Dropped to end the process.
    over: Option<Sender<()>>,
    thread: Option<JoinHandle<Option<String>>>,
}

impl Companion {
    /// Starts the process, with these arguments. Also returns its id.
    ///
    /// # Errors
    /// If the process does not start.
    pub(crate) fn start(
        kind: CompanionKind,
        args: impl IntoIterator<Item = OsString>,
    ) -> anyhow::Result<(Self, u32)> {
        let process = tandem_board_host::this_program()
            .arg0("tandem")
            .arg(kind.command)
            .args(args)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            // Ctrl-C in the terminal must not reach the process, because the run ends it.
            .process_group(0)
            .spawn()
            .with_context(|| format!("the process of {}", kind.whose))?;
        let pid = process.id();
        let (over, is_over) = channel();
        let thread = std::thread::Builder::new().name(kind.command.to_owned());
        let thread = thread.spawn(move || watch(process, kind, &is_over));
        let thread = thread.with_context(|| format!("a thread for {}", kind.whose))?;
        let started = Self {
            over: Some(over),
            thread: Some(thread),
        };
        Ok((started, pid))
    }

    /// Ends the process. Kills it if it does not end. Returns how it ended, if that was before.
    pub(crate) fn end(&mut self) -> Option<String> {
        self.over = None;
        self.thread.take()?.join().ok().flatten()
    }
}

impl Drop for Companion {
    fn drop(&mut self) {
        self.end();
    }
}

/// Waits for the end of the run, and ends the process. If the process ends before, says so, and
/// returns how it ended.
fn watch(mut process: Child, kind: CompanionKind, over: &Receiver<()>) -> Option<String> {
    while over.recv_timeout(LOOKS_EVERY) == Err(RecvTimeoutError::Timeout) {
        if let Ok(Some(status)) = process.try_wait() {
            let died = last_words(&mut process, status);
            let CompanionKind { whose, causes, .. } = kind;
            eprintln!("{whose}'s process ended ({died}): {causes}");
            return Some(died);
        }
    }
    let ended = process.try_wait().ok().flatten();
    // Tells the process to end.
    drop(process.stdin.take());
    let begin = Instant::now();
    while matches!(process.try_wait(), Ok(None)) {
        if begin.elapsed() > ENDS_WITHIN {
            // Fails if the process has just ended.
            let _ = process.kill();
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    ended.map(|status| last_words(&mut process, status))
}

/// Returns how the process ended, and what it said.
fn last_words(process: &mut Child, status: ExitStatus) -> String {
    let mut said = String::new();
    if let Some(stderr) = &mut process.stderr {
        // Without its words, the status remains.
        let _ = stderr.read_to_string(&mut said);
    }
    match said.trim() {
        "" => status.to_string(),
        said => format!("{status}: {said}"),
    }
}

/// In the process: returns what becomes true when the run is over. Claims real time if it is to.
pub(crate) fn begin(realtime: bool) -> Arc<AtomicBool> {
    let over = Arc::new(AtomicBool::new(false));
    let is_over = Arc::clone(&over);
    std::thread::spawn(move || {
        // An error is the end, too.
        let _ = io::copy(&mut io::stdin(), &mut io::sink());
        over.store(true, Ordering::Relaxed);
    });
    if realtime {
        claim_realtime();
    }
    is_over
}

/// Claims the priority of a process beside a run. The run says what the machine grants.
pub(crate) fn claim_realtime() {
    let _ = claim(Claim {
        priority: Some(PRIORITY),
        cpu: None,
        lock_memory: true,
    });
}
