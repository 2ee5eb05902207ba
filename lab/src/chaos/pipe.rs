//! The reports of a drive's process to its campaign, one line each.

use std::io::Write as _;

use anyhow::Context as _;
use serde::{Deserialize, Serialize};

use super::recording_judge::Outcome;

/// One report of a drive.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Line {
    /// The number of completed faults.
    Done(u64),
    /// Request to stop the drive's process for this number of milliseconds.
    Hold(i32),
    /// The run has ended: the outcome of each fault, and the violations of the run as a whole.
    Ended(Vec<Outcome>, Vec<String>),
}

/// Writes a line.
///
/// # Errors
/// If the campaign has ended.
pub(super) fn report(line: &Line) -> anyhow::Result<()> {
    let text = serde_json::to_string(line).context("a line")?;
    let mut stdout = std::io::stdout().lock();
    writeln!(stdout, "{text}").context("stdout")?;
    stdout.flush().context("stdout")
}
