//! What the process of a drive reports to its campaign, a line each.

use std::io::Write as _;

use anyhow::Context as _;
use serde::{Deserialize, Serialize};

use super::recording_judge::Outcome;

/// A line that a drive reports.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Line {
    /// The number of faults that are done.
    Done(u64),
    /// Stop this process for this number of milliseconds, then continue it.
    Hold(i32),
    /// The run has ended: what became of each fault, and what was wrong with the run as a whole.
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
