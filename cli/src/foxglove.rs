//! `tandem run --mcap` and `--foxglove`: starts the program that shows the run, an observer like
//! any other. The run does not depend on it.

use std::io::{BufRead as _, BufReader, Write as _};
use std::os::unix::process::CommandExt as _;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow};
use serde::{Deserialize, Serialize};
use tandem_board_host::RunName;

use crate::args::RunArgs;
use crate::beside::{self, Program};
use crate::failure::Failure;

/// Time within which the program must complete its file.
const ENDS_WITHIN: Duration = Duration::from_secs(20);

/// What the program says when it has opened the file and the port.
#[derive(Debug, Serialize, Deserialize)]
pub enum Ready {
    /// It is ready; the port, if it shows the run live.
    At(Option<u16>),
    /// It cannot open one of them; why.
    Refused(String),
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

/// The program that shows a run.
pub(crate) struct Showing(Child);

impl Showing {
    /// Starts the program, which opens the file and the port, before the run gets its own
    /// `/dev/shm`; `None` if the arguments ask for neither.
    ///
    /// # Errors
    /// [`Failure::Usage`] if the program does not start, or a file or port cannot be opened. Then
    /// nothing is left behind.
    pub(crate) fn prepare(args: &RunArgs) -> Result<Option<Self>, Failure> {
        if args.mcap.is_none() && args.foxglove.is_none() {
            return Ok(None);
        }
        let path = beside::built(Program::Foxglove).map_err(Failure::Usage)?;
        let mut command = Command::new(&path);
        command.args(["foxglove", "--beside"]);
        if let Some(file) = &args.mcap {
            command.arg("--mcap").arg(file);
        }
        if let Some(port) = args.foxglove {
            command.arg("--port").arg(port.to_string());
        }
        // Ctrl-C in the terminal must not reach the program, because the run ends it.
        command.process_group(0);
        let child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
        let missing = |error| Failure::Usage(beside::missing(Program::Foxglove, &path, &error));
        let mut showing = Self(child.map_err(missing)?);
        match showing.answer().map_err(Failure::Usage)? {
            Ready::Refused(why) => Err(Failure::Usage(anyhow!("{why}"))),
            Ready::At(port) => {
                if let (Some(port), false) = (port, args.quiet) {
                    eprintln!("{}", address(port));
                }
                Ok(Some(showing))
            }
        }
    }

    fn answer(&mut self) -> anyhow::Result<Ready> {
        let out = self.0.stdout.take().context("a pipe")?;
        let mut line = String::new();
        BufReader::new(out).read_line(&mut line)?;
        serde_json::from_str(&line).context("the program for Foxglove ended")
    }

    /// Tells the program which run to show.
    pub(crate) fn begin(&mut self, run: &RunName, realtime: bool, is_virtual: bool) {
        let begin = RunToShow {
            run: run.to_string(),
            is_virtual,
            realtime,
        };
        let line = serde_json::to_string(&begin);
        if let (Some(stdin), Ok(line)) = (&mut self.0.stdin, line) {
            // If the program has died, its end says so.
            let _ = writeln!(stdin, "{line}");
        }
    }

    /// Ends the program after it has passed on what was published, and completed the file.
    pub(crate) fn end(mut self) {
        match self.close() {
            Ok(status) if !status.success() => {
                eprintln!("warning: the program for Foxglove ended with {status}");
            }
            _ => {}
        }
    }

    /// Closes its stdin. Kills it if it does not end.
    fn close(&mut self) -> std::io::Result<ExitStatus> {
        drop(self.0.stdin.take());
        let begin = Instant::now();
        while self.0.try_wait()?.is_none() {
            if begin.elapsed() > ENDS_WITHIN {
                self.0.kill()?;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        self.0.wait()
    }
}

impl Drop for Showing {
    fn drop(&mut self) {
        // If it has ended, this has no effect.
        let _ = self.close();
    }
}

/// Returns where Foxglove finds the run.
#[must_use]
pub fn address(port: u16) -> String {
    format!("Foxglove: open a connection to ws://localhost:{port}")
}
