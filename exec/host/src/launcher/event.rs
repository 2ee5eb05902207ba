//! What the launcher tells: lines for people, and the same for programs.

use core::fmt;

use serde::{Deserialize, Serialize};

/// An event, and when it happened.
#[derive(Clone, Debug, Serialize)]
pub struct Told {
    /// Time since the launcher began, ms.
    pub after_ms: f64,
    /// The event.
    #[serde(flatten)]
    pub event: LaunchEvent,
}

/// An event of the launcher.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "event", rename_all = "kebab-case")]
pub enum LaunchEvent {
    /// A process was started.
    #[allow(missing_docs)]
    Started { process: String, pid: u32 },
    /// The machine does not grant a process this; it runs without.
    #[allow(missing_docs)]
    NotGranted { process: String, what: &'static str },
    /// A process runs although it is not what was signed, in monitor mode.
    #[allow(missing_docs)]
    Unchecked { process: String, why: String },
    /// A process is ready.
    #[allow(missing_docs)]
    Ready { process: String },
    /// A process has failed; what is next.
    #[allow(missing_docs)]
    Failed {
        process: String,
        why: String,
        next: String,
    },
    /// A switch to this run target has begun.
    #[allow(missing_docs)]
    Switching { target: String },
    /// All processes of this run target are ready.
    #[allow(missing_docs)]
    Reached { target: String },
}

impl fmt::Display for Told {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:9.1} ms  ", self.after_ms)?;
        match &self.event {
            LaunchEvent::Started { process, pid } => write!(f, "{process}: started, pid {pid}"),
            LaunchEvent::NotGranted { process, what } => {
                write!(f, "{process}: not granted by this machine: {what}")
            }
            LaunchEvent::Unchecked { process, why } => write!(f, "{process}: {why}"),
            LaunchEvent::Ready { process } => write!(f, "{process}: ready"),
            LaunchEvent::Failed { process, why, next } => {
                write!(f, "{process}: {why}; next: {next}")
            }
            LaunchEvent::Switching { target } => write!(f, "run target {target} …"),
            LaunchEvent::Reached { target } => write!(f, "run target {target}: all ready"),
        }
    }
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

/// Returns the answer to `ps`: one line of JSON.
pub(super) fn state(target: Option<&str>, reached: bool, rows: &[ProcessRow]) -> String {
    serde_json::json!({ "target": target, "reached": reached, "processes": rows }).to_string()
}
