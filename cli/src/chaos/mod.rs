//! `tandem chaos`: faults on real processes, one after the other in a run that drives.

mod campaign;
mod inject;
mod judge;
mod leg;
mod report;

use std::path::Path;

use anyhow::{Context as _, bail};
use tandem_board::Duration;
use tandem_sim::faults::{MATRIX, Sequence, cell_of_matrix, drawn};

use crate::chaos_args::ChaosArgs;
use crate::failure::Failure;

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

    /// A sequence of faults by its number; if it matters, when in the control cycle it begins.
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
