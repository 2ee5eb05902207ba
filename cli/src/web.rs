//! The process of the live page, which `tandem run --web` starts: `tandem web`.

use std::io::{BufRead as _, BufReader};
use std::os::unix::process::CommandExt as _;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::anyhow;
use rustix::process::{Pid, Signal, kill_process};

use crate::beside::{Program, built, missing};
use crate::failure::Failure;

/// The page tells its readers within this time that the run has ended.
const ENDS_WITHIN: Duration = Duration::from_secs(5);
const POLL_INTERVAL: Duration = Duration::from_millis(10);

/// The process of the page. The run does not depend on it. Dropping it ends the process; if this
/// process is killed, the page ends when the run no longer publishes.
pub(crate) struct WebPage {
    process: Child,
    /// Kept open, so that the process may write.
    _said: BufReader<ChildStdout>,
}

impl WebPage {
    /// Starts the page of this process's run on this port of 127.0.0.1, and prints its address on
    /// stderr. Cargo may first have to build the program.
    ///
    /// # Errors
    /// [`Failure::Usage`] if the program is missing, or the port is in use.
    pub(crate) fn start(port: u16) -> Result<Self, Failure> {
        let path = built(Program::Web).map_err(Failure::Usage)?;
        let mut command = Command::new(&path);
        command
            .args(["web", "--wait", "--run", &std::process::id().to_string()])
            .args(["--port", &port.to_string()])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            // Ctrl-C in the terminal must not reach the page, because the run ends it.
            .process_group(0);
        let started = command.spawn();
        let mut process =
            started.map_err(|error| Failure::Usage(missing(Program::Web, &path, &error)))?;
        let said = process.stdout.take();
        let mut said = BufReader::new(said.ok_or_else(|| anyhow!("the page has no stdout"))?);
        let mut line = String::new();
        let read = said.read_line(&mut line);
        let page = Self {
            process,
            _said: said,
        };
        match read {
            // It has printed its reason.
            Ok(0) | Err(_) => Err(Failure::Usage(anyhow!("--web: the page does not start"))),
            Ok(_) => {
                eprint!("{line}");
                Ok(page)
            }
        }
    }
}

impl Drop for WebPage {
    fn drop(&mut self) {
        let begin = Instant::now();
        if let Some(pid) = i32::try_from(self.process.id())
            .ok()
            .and_then(Pid::from_raw)
        {
            // Fails if it has ended.
            let _ = kill_process(pid, Signal::TERM);
        }
        while matches!(self.process.try_wait(), Ok(None)) {
            if begin.elapsed() > ENDS_WITHIN {
                let _ = self.process.kill();
                let _ = self.process.wait();
            }
            std::thread::sleep(POLL_INTERVAL);
        }
    }
}
