//! What the launcher tells: lines for people, and the same for programs.

use core::fmt;

use serde::{Deserialize, Serialize, Serializer};

use super::Recovery;

/// An event, and when it happened.
#[derive(Clone, Debug, Serialize)]
pub struct Told {
    /// Time since the launcher began, ms.
    pub after_ms: f64,
    /// The event.
    #[serde(flatten)]
    pub event: LaunchEvent,
}

/// An event of the launcher. Processes and run targets have the names of the manifest.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "event", rename_all = "kebab-case")]
#[allow(missing_docs)]
pub enum LaunchEvent {
    /// A process was started.
    Started { process: String, pid: u32 },
    /// The machine does not grant a process this, and it runs without; or it runs unchecked, in
    /// monitor mode.
    NotGranted { process: String, what: String },
    /// A process is ready.
    Ready { process: String },
    /// A process has failed; what is next.
    Failed {
        process: String,
        why: String,
        #[serde(serialize_with = "text")]
        next: Recovery,
    },
    /// A switch to this run target has begun.
    Switching { target: String },
    /// All processes of this run target are ready.
    Reached { target: String },
}

fn text<S: Serializer>(it: &impl fmt::Display, to: S) -> Result<S::Ok, S::Error> {
    to.collect_str(it)
}

impl fmt::Display for Told {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:9.1} ms  ", self.after_ms)?;
        match &self.event {
            LaunchEvent::Started { process, pid } => write!(f, "{process}: started, pid {pid}"),
            LaunchEvent::NotGranted { process, what } => {
                write!(f, "{process}: not granted: {what}")
            }
            LaunchEvent::Ready { process } => write!(f, "{process}: ready"),
            LaunchEvent::Failed { process, why, next } => {
                write!(f, "{process}: {why}; next: {next}")
            }
            LaunchEvent::Switching { target } => write!(f, "run target {target} …"),
            LaunchEvent::Reached { target } => write!(f, "run target {target}: all ready"),
        }
    }
}

/// The answer to `ps`, as JSON in one line.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PlatformState {
    /// The run target; `None` when all is to end.
    pub target: Option<String>,
    /// All of its processes are ready.
    pub reached: bool,
    /// All processes of the manifest.
    pub processes: Vec<ProcessRow>,
}

/// A process in the answer to `ps`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ProcessRow {
    /// Its name.
    pub process: String,
    /// Its state, in a word.
    pub state: String,
    /// Its process id, if it exists.
    pub pid: Option<u32>,
    /// How often it was restarted.
    pub restarts: u32,
    /// What it last said of itself.
    pub status: String,
}
