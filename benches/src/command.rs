//! `tandem bench`: runs the cases in turn and prints what they took.

use crate::cases::{CASES, Case, Group};
use crate::clock;
use crate::harness::Plan;
use crate::result::{Machine, Measured, Results};
use hdrhistogram::Histogram;
use indicatif::{ProgressBar, ProgressStyle};
use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
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

static INTERRUPTED: AtomicBool = AtomicBool::new(false);

extern "C" fn interrupt(_signal: libc::c_int) {
    INTERRUPTED.store(true, Ordering::Relaxed);
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
    // SAFETY: the handler only stores to an atomic.
    unsafe {
        let handler: extern "C" fn(libc::c_int) = interrupt;
        libc::signal(libc::SIGINT, handler as libc::sighandler_t);
    }
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

/// A case with what was measured so far.
struct Running {
    case: Case,
    times: Histogram<u64>,
    failed: Option<String>,
}

fn measure(system: &BareSystem, args: &BenchArgs, cpus: [usize; 2]) -> Results {
    let ns_per_tick = clock::ns_per_tick();
    let wanted = |case: &Case| args.groups.is_empty() || args.groups.contains(&case.group);
    let mut running: Vec<Running> = CASES
        .into_iter()
        .filter(wanted)
        .filter_map(|case| {
            Some(Running {
                case,
                times: Histogram::new(3).ok()?,
                failed: None,
            })
        })
        .collect();
    let span = Duration::from_secs(if args.quick { 12 } else { 90 });
    let bar = ProgressBar::new(span.as_millis() as u64);
    if let Ok(style) = ProgressStyle::with_template("{bar:30} {msg}") {
        bar.set_style(style);
    }
    let begin = Instant::now();
    // Cases take turns, so that each sees the same of the machine's moods.
    while begin.elapsed() < span && !INTERRUPTED.load(Ordering::Relaxed) {
        for running in running
            .iter_mut()
            .filter(|running| running.failed.is_none())
        {
            if INTERRUPTED.load(Ordering::Relaxed) {
                break;
            }
            bar.set_position(begin.elapsed().as_millis() as u64);
            bar.set_message(format!(
                "{}/{}",
                running.case.group.name(),
                running.case.name
            ));
            let rounds = running.case.group.rounds();
            let plan = Plan {
                rounds,
                warm_up: rounds / 10,
                cpus,
            };
            match (running.case.run)(system, &plan) {
                Ok(ticks) => {
                    for way in ticks {
                        // The histogram grows as needed; only memory could refuse.
                        let _ = running.times.record((f64::from(way) * ns_per_tick) as u64);
                    }
                }
                Err(_) if INTERRUPTED.load(Ordering::Relaxed) => {}
                Err(error) => running.failed = Some(error.to_string()),
            }
        }
    }
    bar.finish_and_clear();
    summarise(&running, cpus)
}

fn summarise(running: &[Running], cpus: [usize; 2]) -> Results {
    let floor = |group| {
        let of = |running: &&Running| running.case.group == group && running.case.name == "floor";
        running.iter().find(of).map(|running| &running.times)
    };
    let measured = running.iter().filter(|running| !running.times.is_empty());
    let failed = running.iter().filter_map(|running| {
        let name = format!("{}/{}", running.case.group.name(), running.case.name);
        running.failed.as_ref().map(|why| format!("{name}: {why}"))
    });
    Results {
        machine: Machine::this(cpus),
        interrupted: INTERRUPTED.load(Ordering::Relaxed),
        results: measured
            .map(|running| Measured::new(&running.case, &running.times, floor(running.case.group)))
            .collect(),
        skipped: failed.collect(),
    }
}
