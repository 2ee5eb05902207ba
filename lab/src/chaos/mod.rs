//! `tandem chaos`: faults on real processes or emulated machines, one after the other in a run that
//! drives.

mod campaign;
mod emulated;
mod inject;
mod judge;
mod leg;
mod report;

use std::path::Path;

use anyhow::{Context as _, bail};
use tandem_board::Duration;
use tandem_sim::faults::{Sequence, Victim};

use crate::chaos_args::ChaosArgs;
use tandem::board_kind::DemoBoard;
use tandem::failure::Failure;

/// Which faults a campaign has.
struct Source<'a> {
    kind: SourceKind<'a>,
    victim: Victim,
}

enum SourceKind<'a> {
    Drawn { seed: u64 },
    Matrix,
    File { path: &'a Path, text: String },
}

impl<'a> Source<'a> {
    fn of(args: &'a ChaosArgs) -> anyhow::Result<Self> {
        let kind = match &args.faults {
            None if args.matrix => SourceKind::Matrix,
            None => SourceKind::Drawn { seed: args.seed },
            Some(path) => {
                let text = std::fs::read_to_string(path);
                let text = text.with_context(|| path.display().to_string())?;
                SourceKind::File { path, text }
            }
        };
        let victim = match args.board {
            DemoBoard::Host => Victim::Processes,
            DemoBoard::Qemu => Victim::Machines,
        };
        let source = Self { kind, victim };
        // So that what is wrong with a file is told before anything starts.
        source.sequence(0)?;
        Ok(source)
    }

    /// A sequence of faults by its number; if it matters, when in the control cycle it begins.
    fn sequence(&self, number: u64) -> anyhow::Result<(Sequence, Option<Duration>)> {
        match &self.kind {
            SourceKind::Drawn { seed } => Ok((self.victim.drawn(*seed, number), None)),
            SourceKind::Matrix => {
                let cell = self.victim.cell(number);
                let (sequence, phase) = cell.with_context(|| format!("no cell {number}"))?;
                Ok((sequence, Some(phase)))
            }
            SourceKind::File { path, text } => {
                let sequence = Sequence::from_toml(text, number)
                    .with_context(|| path.display().to_string())?;
                let path = path.display();
                if sequence.from_power_on {
                    bail!("{path}: from-power-on: only `tandem sim`");
                }
                let mut kinds = sequence.faults.iter().map(|fault| fault.kind);
                if let Some(kind) = kinds.find(|kind| !self.victim.suffers(*kind)) {
                    let (what, victims) = (kind.label(), self.victims());
                    bail!(
                        "{path}: {what}: {victims} cannot suffer it; docs/faults.md says what can"
                    );
                }
                Ok((sequence, None))
            }
        }
    }

    const fn victims(&self) -> &'static str {
        match self.victim {
            Victim::Processes => "processes",
            Victim::Machines => "emulated machines",
        }
    }

    /// The numbers of its sequences.
    fn numbers(&self, args: &ChaosArgs) -> anyhow::Result<Vec<u64>> {
        if let Some(only) = args.only {
            self.sequence(only)?;
            return Ok(vec![only]);
        }
        let all = match self.kind {
            SourceKind::Matrix => args.from..self.victim.cells(),
            SourceKind::Drawn { .. } | SourceKind::File { .. } => {
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
        let mut words = match &self.kind {
            SourceKind::Drawn { seed } => vec!["--seed".to_owned(), seed.to_string()],
            SourceKind::Matrix => vec!["--matrix".to_owned()],
            SourceKind::File { path, .. } => {
                vec!["--faults".to_owned(), path.display().to_string()]
            }
        };
        if self.victim == Victim::Machines {
            words.extend(["--board", "qemu"].map(str::to_owned));
        }
        words
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
        let every = usize::try_from(args.every.get()).unwrap_or(usize::MAX);
        let numbers: Vec<u64> = (leg[0]..leg[1]).step_by(every).collect();
        let leg = match source.victim {
            Victim::Processes => leg::run(&source, &numbers),
            Victim::Machines => emulated::run(&source, &numbers),
        };
        return leg.map_err(Failure::Run);
    }
    if source.victim == Victim::Machines {
        crate::emulated::image("controller", None).map_err(Failure::Usage)?;
    }
    let numbers = source.numbers(args).map_err(Failure::Usage)?;
    campaign::run(&source, &numbers, args)
}
