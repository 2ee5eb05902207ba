//! A program that shows a run beside it: in Foxglove, or as the live page. `tandem run` starts it;
//! it is an observer like any other, and the run does not depend on it.
//!
//! The program says in one line of JSON on stdout whether it is ready ([`Ready`]). `tandem run`
//! then names the run in one line on stdin ([`RunToShow`]), and ends the program by closing stdin.

use std::ffi::OsString;
use std::io::{BufRead as _, BufReader, Read as _, Write as _, stdin};
use std::os::unix::process::CommandExt as _;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow};
use serde::{Deserialize, Serialize};
use tandem_board_host::RunName;
use tandem_observers::Observer;

use crate::args::RunArgs;
use crate::beside::{self, Program};
use crate::failure::Failure;

/// Time within which the program must end, and complete its file.
const ENDS_WITHIN: Duration = Duration::from_secs(20);
/// Delay of the next look whether the program has ended, or whether the run publishes.
const POLL: Duration = Duration::from_millis(5);

/// What the program says when it has opened its files and ports.
#[derive(Debug, Serialize, Deserialize)]
pub enum Ready {
    /// It is ready; where the run is shown, in words, if it is shown live.
    At(Option<String>),
    /// It cannot open one of them; why.
    Refused(String),
}

impl Ready {
    /// Says it to `tandem run`.
    ///
    /// # Errors
    /// If stdout cannot be written.
    pub fn say(&self) -> anyhow::Result<()> {
        let line = serde_json::to_string(self).context("an answer")?;
        crate::print(&(line + "\n"))
    }
}

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

/// A program that shows a run, as seen by `tandem run`. Dropping it ends the program.
pub(crate) struct Viewer {
    process: Child,
    /// What it is, in words.
    what: &'static str,
}

impl Viewer {
    /// Starts the programs that the arguments ask for. They open their files and ports before the
    /// run gets its own `/dev/shm`. Cargo may first have to build them. Prints on stderr where the
    /// run is shown.
    ///
    /// # Errors
    /// [`Failure::Usage`] if a program does not start, or a file or port cannot be opened. Then
    /// nothing is left behind.
    pub(crate) fn all(args: &RunArgs) -> Result<Vec<Self>, Failure> {
        let mut viewers = Vec::new();
        if args.mcap.is_some() || args.foxglove.is_some() {
            let mut words = Vec::new();
            if let Some(file) = &args.mcap {
                words.extend(["--mcap".into(), file.into()]);
            }
            words.extend(port(args.foxglove));
            viewers.push(Self::start(
                Program::Foxglove,
                "program for Foxglove",
                "foxglove",
                words,
            )?);
        }
        if args.web.is_some() {
            let words = port(args.web);
            viewers.push(Self::start(Program::Web, "live page", "web", words)?);
        }
        Ok(viewers)
    }

    fn start(
        program: Program,
        what: &'static str,
        command: &str,
        words: Vec<OsString>,
    ) -> Result<Self, Failure> {
        let path = beside::built(program).map_err(Failure::Usage)?;
        let process = Command::new(&path)
            .args([command, "--beside"])
            .args(words)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            // Ctrl-C in the terminal must not reach the program, because the run ends it.
            .process_group(0)
            .spawn();
        let missing = |error| Failure::Usage(beside::missing(program, &path, &error));
        let process = process.map_err(missing)?;
        let mut viewer = Self { process, what };
        match viewer.answer().map_err(Failure::Usage)? {
            Ready::Refused(why) => Err(Failure::Usage(anyhow!("{why}"))),
            Ready::At(place) => {
                // Also with `--quiet`: nothing else tells a port that the program has chosen.
                if let Some(place) = place {
                    eprintln!("{place}");
                }
                Ok(viewer)
            }
        }
    }

    fn answer(&mut self) -> anyhow::Result<Ready> {
        let out = self.process.stdout.take().context("a pipe")?;
        let mut line = String::new();
        BufReader::new(out).read_line(&mut line)?;
        serde_json::from_str(&line).with_context(|| format!("the {} ended", self.what))
    }

    /// Tells the program which run to show.
    pub(crate) fn begin(&mut self, run: &RunName, realtime: bool, is_virtual: bool) {
        let begin = RunToShow {
            run: run.to_string(),
            is_virtual,
            realtime,
        };
        let line = serde_json::to_string(&begin);
        if let (Some(stdin), Ok(line)) = (&mut self.process.stdin, line) {
            // If the program has died, its end says so. One line always fits into the pipe.
            let _ = writeln!(stdin, "{line}");
        }
    }

    /// Ends the program after it has passed on what was published. Says if it has failed.
    pub(crate) fn end(mut self) {
        match self.close() {
            Ok(status) if !status.success() => {
                eprintln!("warning: the {} ended with {status}", self.what);
            }
            _ => {}
        }
    }

    /// Closes its stdin. Kills it if it does not end.
    fn close(&mut self) -> std::io::Result<ExitStatus> {
        drop(self.process.stdin.take());
        let begin = Instant::now();
        while self.process.try_wait()?.is_none() {
            if begin.elapsed() > ENDS_WITHIN {
                self.process.kill()?;
            }
            std::thread::sleep(POLL);
        }
        self.process.wait()
    }
}

impl Drop for Viewer {
    fn drop(&mut self) {
        // If it has ended, this has no effect.
        let _ = self.close();
    }
}

fn port(port: Option<u16>) -> Vec<OsString> {
    let words = port.map(|port| ["--port".into(), port.to_string().into()]);
    words.into_iter().flatten().collect()
}
