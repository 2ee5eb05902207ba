//! `tandem chaos`: faults on real processes, one after the other in a run that drives.

mod campaign;
mod inject;
mod judge;
mod leg;
mod report;

use std::num::NonZero;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use clap::Args;
use tandem_board::Duration;
use tandem_sim::faults::{MATRIX, Sequence, cell_of_matrix, drawn};

use crate::failure::Failure;

/// Arguments of `tandem chaos`.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct ChaosArgs {
    /// How many faults
    #[arg(long, value_name = "N", default_value_t = 60)]
    count: u64,

    /// Decides which faults
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,

    /// The number of the first fault
    #[arg(long, value_name = "N", default_value_t = 0)]
    from: u64,

    /// Try the faults of this TOML file, --count times
    #[arg(long, value_name = "FILE")]
    faults: Option<PathBuf>,

    /// Each fault, of the master and of the standby, at 20 phases of the control cycle
    #[arg(long, conflicts_with_all = ["faults", "count"])]
    matrix: bool,

    /// Of the matrix, every N-th cell only
    #[arg(long, value_name = "N", default_value_t = NonZero::<u64>::MIN, requires = "matrix")]
    every: NonZero<u64>,

    /// Only the fault of this number
    #[arg(long, value_name = "NUMBER", conflicts_with_all = ["from", "count", "every"])]
    only: Option<u64>,

    /// Write {faults, violations, classes: [{name, n, detection_p99_ms, gap_p99_ms, gap_max_ms,
    /// bound_ms, ...}]} to this file
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,

    /// Inject these faults in one run and end: what the campaign starts
    #[arg(long, hide = true, num_args = 2, value_names = ["FROM", "TO"])]
    leg: Option<Vec<u64>>,
}

const EXAMPLES: &str = "\
The faults are those of `tandem sim`. In one run after the other, each fault meets a master and a
standby, and is mended. Then the systems must be master and standby again before the next one. The
report has, for each class of faults, how long the other system needed to notice, and how long the
vehicle was without control, beside the bound that is computed. A gap beyond its bound is no
violation if the evidence shows that the machine itself stood still for that long.

  tandem chaos --count 200 --seed 7          random faults, about 4 s each
  tandem chaos --only 137 --seed 7           one of them again
  tandem chaos --matrix --every 10           each fault at some phases of the 10 ms cycle
  tandem chaos --faults my.toml --count 20   a file of `tandem sim --save`, where A is the system
                                             that drives, and B the standby

Exit status: 0 if all was as it must be, 1 if not, 2 if an argument or a file is wrong, 130 after
Ctrl-C, with the report of what was done.";

impl ChaosArgs {
    /// The arguments by which a leg leaves out the same cells.
    fn every_arguments(&self) -> Vec<String> {
        match self.matrix {
            true => vec!["--every".to_owned(), self.every.to_string()],
            false => vec![],
        }
    }
}

/// Which faults a campaign has.
enum Source<'a> {
    Drawn { seed: u64 },
    Matrix,
    File { path: &'a Path, text: String },
}

impl<'a> Source<'a> {
    fn of(args: &'a ChaosArgs) -> anyhow::Result<Self> {
        let Some(path) = &args.faults else {
            return Ok(match args.matrix {
                true => Self::Matrix,
                false => Self::Drawn { seed: args.seed },
            });
        };
        let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
        let source = Self::File { path, text };
        // So that what is wrong with it is told before anything starts.
        source.sequence(0)?;
        Ok(source)
    }

    /// A sequence of faults by its number, and when in the control cycle it begins, if that matters.
    fn sequence(&self, number: u64) -> anyhow::Result<(Sequence, Option<Duration>)> {
        match self {
            Self::Drawn { seed } => Ok((drawn(*seed, number), None)),
            Self::Matrix => {
                let cell = cell_of_matrix(number);
                let (sequence, phase) = cell.with_context(|| format!("no cell {number}"))?;
                Ok((sequence, Some(phase)))
            }
            Self::File { path, text } => {
                let sequence = Sequence::from_toml(text, number)
                    .with_context(|| path.display().to_string())?;
                if sequence.from_power_on {
                    bail!("{}: from-power-on: only `tandem sim`", path.display());
                }
                if let Some(fault) = sequence
                    .faults
                    .iter()
                    .find(|it| !it.kind.is_for_processes())
                {
                    let (path, what) = (path.display(), fault.kind.label());
                    bail!("{path}: {what}: processes cannot suffer it, only `tandem sim` can");
                }
                Ok((sequence, None))
            }
        }
    }

    /// The numbers of its sequences.
    fn numbers(&self, args: &ChaosArgs) -> anyhow::Result<Vec<u64>> {
        if let Some(only) = args.only {
            self.sequence(only)?;
            return Ok(vec![only]);
        }
        let all = match self {
            Self::Matrix => args.from..MATRIX,
            Self::Drawn { .. } | Self::File { .. } => {
                let to = args.from.checked_add(args.count);
                args.from..to.context("--from and --count are too large")?
            }
        };
        let every = usize::try_from(args.every.get())?;
        if all.is_empty() {
            bail!("there is no fault to inject");
        }
        Ok(all.step_by(every).collect())
    }

    /// The arguments by which another process finds the same sequences.
    fn arguments(&self) -> Vec<String> {
        match self {
            Self::Drawn { seed } => vec!["--seed".to_owned(), seed.to_string()],
            Self::Matrix => vec!["--matrix".to_owned()],
            Self::File { path, .. } => vec!["--faults".to_owned(), path.display().to_string()],
        }
    }

    /// The command that repeats one of them.
    fn repeats(&self, number: u64) -> String {
        let words = self.arguments().join(" ");
        format!("tandem chaos {words} --only {number}")
    }
}

/// Runs the command.
///
/// # Errors
/// [`Failure`] with the exit status that the command documents.
pub(crate) fn run(args: &ChaosArgs) -> Result<(), Failure> {
    let source = Source::of(args).map_err(Failure::Usage)?;
    if let Some(leg) = &args.leg {
        return leg::run(&source, leg[0]..leg[1], args.every).map_err(Failure::Run);
    }
    let numbers = source.numbers(args).map_err(Failure::Usage)?;
    campaign::run(&source, &numbers, args)
}
