//! `tandem bench`: its arguments, and what it writes.

use crate::cases::{self, Case, Group};
use crate::measure;
use crate::result::Results;
use indicatif::{ProgressBar, ProgressStyle};
use std::io;
use std::path::PathBuf;
use std::time::Duration;
use tandem_board_host::{AttachError, BareSystem, IsolationError, isolation};

/// Arguments of `tandem bench`.
#[derive(Clone, Debug, clap::Args)]
pub struct BenchArgs {
    /// Take some 15 seconds instead of 90: fewer samples, the same cases
    #[arg(long)]
    pub quick: bool,

    /// Write the figures and a description of the machine to this file
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,

    /// Which groups to measure [default: all]
    #[arg(value_enum, value_name = "GROUP")]
    pub groups: Vec<Group>,
}

/// Why nothing could be measured.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// No place for the shared memory.
    #[error(transparent)]
    Isolation(#[from] IsolationError),
    /// The system cannot be powered.
    #[error(transparent)]
    Board(#[from] AttachError),
    /// The ends need a CPU each.
    #[error("the benchmark needs two CPUs, and this process may use {0}")]
    TooFewCpus(usize),
    /// The file of the figures cannot be written.
    #[error("cannot write {path}: {source}")]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
}

/// Measures, prints the table, and returns the results. Ctrl-C ends the measurement early; what was
/// measured so far is printed all the same.
///
/// To be called before the process has threads.
///
/// # Errors
/// [`BenchError`]
pub fn run(args: &BenchArgs) -> Result<Results, BenchError> {
    if let Some(path) = &args.json {
        // Before the measuring, not after it.
        let touched = std::fs::OpenOptions::new()
            .create(true)
            .append(true)
            .open(path);
        touched.map_err(|source| BenchError::Write {
            path: path.clone(),
            source,
        })?;
    }
    let cpus = core_affinity::get_core_ids().unwrap_or_default();
    let [near, far, ..] = cpus.as_slice() else {
        return Err(BenchError::TooFewCpus(cpus.len()));
    };
    let cpus = [near.id, far.id];
    let isolation = isolation::enter()?;
    let system = BareSystem::power_on(&isolation)?;
    let results = measure(&system, args, cpus);
    isolation.wipe();
    if let Some(path) = &args.json {
        let text = serde_json::to_string_pretty(&results).map_err(io::Error::from);
        let written = text.and_then(|text| std::fs::write(path, text + "\n"));
        written.map_err(|source| BenchError::Write {
            path: path.clone(),
            source,
        })?;
    }
    Ok(results)
}

fn measure(system: &BareSystem, args: &BenchArgs, cpus: [usize; 2]) -> Results {
    let wanted = |case: &&Case| args.groups.is_empty() || args.groups.contains(&case.group);
    let span = measure::Span {
        at_least: Duration::from_secs(if args.quick { 12 } else { 90 }),
        turns: 3,
        at_most: Duration::from_secs(if args.quick { 30 } else { 240 }),
    };
    let bar = ProgressBar::new(1000);
    if let Ok(style) = ProgressStyle::with_template("{bar:30} {msg}") {
        bar.set_style(style);
    }
    let all = measure::run(
        system,
        cases::all().filter(wanted),
        cpus,
        span,
        |passed, case| {
            bar.set_position((passed * 1000.0) as u64);
            bar.set_message(case.full_name());
        },
    );
    bar.finish_and_clear();
    Results::new(&all, cpus, measure::was_interrupted())
}
