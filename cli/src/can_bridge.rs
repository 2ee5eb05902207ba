//! `tandem run --can INTERFACE`: starts the program that connects the bus of the run with a
//! SocketCAN interface. The run does not depend on it.

use std::io::{BufRead as _, BufReader};
use std::os::unix::process::CommandExt as _;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow};
use serde::{Deserialize, Serialize};
use tandem_board_host::RunName;

use crate::args::{CanBus, RunArgs};
use crate::beside::{self, Program};
use crate::failure::Failure;
use tandem_processes::open_bus::OpenBusPlace;

/// The program ends within this time after the run.
const ENDS_WITHIN: Duration = Duration::from_secs(1);
const POLL_INTERVAL: Duration = Duration::from_millis(5);

/// What the program says when it has opened the interface.
#[derive(Debug, Serialize, Deserialize)]
pub enum BridgeAnswer {
    /// It waits for the vehicle.
    Ready,
    /// The interface cannot be used; why.
    Refused(String),
}

/// The program between a run and an interface. Dropping it ends the program.
pub(crate) struct CanBridge {
    process: Child,
    name: String,
}

impl CanBridge {
    /// Starts the program; `None` if the arguments name no interface. Cargo may first have to build
    /// it.
    ///
    /// # Errors
    /// [`Failure::Usage`] if the program does not start, or the interface cannot be used. Then
    /// nothing is left behind.
    pub(crate) fn start(args: &RunArgs) -> Result<Option<Self>, Failure> {
        let Some(CanBus::Interface(interface)) = &args.can else {
            return Ok(None);
        };
        let path = beside::built(Program::Can).map_err(Failure::Usage)?;
        let name = format!("{}-can", RunName::unique());
        let mut command = Command::new(&path);
        command.arg(interface).arg(&name);
        // Ctrl-C in the terminal must not reach the program, because it ends with the run.
        command.process_group(0);
        let child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
        let missing = |error| Failure::Usage(beside::missing(Program::Can, &path, &error));
        let process = child.map_err(missing)?;
        let mut bridge = Self { process, name };
        match bridge.answer().map_err(Failure::Usage)? {
            BridgeAnswer::Ready => Ok(Some(bridge)),
            BridgeAnswer::Refused(why) => Err(Failure::Usage(anyhow!("--can {interface}: {why}"))),
        }
    }

    fn answer(&mut self) -> anyhow::Result<BridgeAnswer> {
        let out = self.process.stdout.take().context("a pipe")?;
        let mut line = String::new();
        BufReader::new(out).read_line(&mut line)?;
        serde_json::from_str(&line).context("the program for SocketCAN ended")
    }

    /// Returns where the vehicle finds it.
    pub(crate) fn place(&self) -> OpenBusPlace {
        OpenBusPlace::Bridge(self.name.clone())
    }
}

impl Drop for CanBridge {
    fn drop(&mut self) {
        // The program ends when its stdin closes.
        drop(self.process.stdin.take());
        let begin = Instant::now();
        while matches!(self.process.try_wait(), Ok(None)) {
            if begin.elapsed() > ENDS_WITHIN {
                let _ = self.process.kill();
                let _ = self.process.wait();
            }
            std::thread::sleep(POLL_INTERVAL);
        }
    }
}
