//! `tandem chaos`: injects faults into real processes or emulated machines, one after the other
//! while a run drives.

mod campaign;
mod emulated;
mod inject;
mod pipe;
mod processes;
mod recording_judge;
mod report;
mod round;

use anyhow::{Context as _, bail};
use tandem_board::Duration;
use tandem_faults::{Sequence, Site};

use crate::chaos_args::ChaosArgs;
use crate::fault_file::FaultFile;
use tandem::board_kind::DemoBoard;
use tandem::failure::Failure;

/// The source of a campaign's faults, and the site at which they are injected.
struct Source {
    kind: SourceKind,
    site: Site,
}

enum SourceKind {
    Drawn { seed: u64 },
    Matrix,
    File(FaultFile),
}

impl Source {
    fn of(args: &ChaosArgs) -> anyhow::Result<Self> {
        let site = match args.board {
            DemoBoard::Host => Site::Processes,
            DemoBoard::Qemu => Site::Machines,
        };
        let kind = match &args.faults {
            None if args.matrix => SourceKind::Matrix,
            None => SourceKind::Drawn { seed: args.seed },
            Some(path) => SourceKind::File(FaultFile::read(path, site)?),
        };
        Ok(Self { kind, site })
    }

    /// Returns the sequence with this number and, if it matters, its phase in the control cycle.
    fn sequence(&self, number: u64) -> anyhow::Result<(Sequence, Option<Duration>)> {
        Ok(match &self.kind {
            SourceKind::Drawn { seed } => (self.site.drawn(*seed, number), None),
            SourceKind::Matrix => {
                let cell = self.site.cell(number);
                let (sequence, phase) = cell.with_context(|| format!("no cell {number}"))?;
                (sequence, Some(phase))
            }
            SourceKind::File(file) => (file.sequence(number)?, None),
        })
    }

    /// Returns the numbers of the sequences to try.
    fn numbers(&self, args: &ChaosArgs) -> anyhow::Result<Vec<u64>> {
        if let Some(only) = args.only {
            self.sequence(only)?;
            return Ok(vec![only]);
        }
        let all = match self.kind {
            SourceKind::Matrix => args.from..self.site.cells(),
            SourceKind::Drawn { .. } | SourceKind::File(_) => {
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

    /// Returns the arguments with which another process creates the same sequences.
    fn arguments(&self) -> Vec<String> {
        let mut words = match &self.kind {
            SourceKind::Drawn { seed } => vec!["--seed".to_owned(), seed.to_string()],
            SourceKind::Matrix => vec!["--matrix".to_owned()],
            SourceKind::File(file) => vec!["--faults".to_owned(), file.name()],
        };
        if self.site == Site::Machines {
            words.extend(["--board", "qemu"].map(str::to_owned));
        }
        words
    }

    /// Returns the command that repeats the sequence with this number.
    fn repeats(&self, number: u64) -> String {
        let words = self.arguments().join(" ");
        format!("tandem chaos {words} --only {number}")
    }
}

/// Runs the command.
///
/// # Errors
/// Returns the [`Failure`] whose exit status the command documents.
pub(crate) fn run(args: &ChaosArgs) -> Result<(), Failure> {
    let source = Source::of(args).map_err(Failure::Usage)?;
    if let Some(drive) = &args.drive {
        let every = usize::try_from(args.every.get()).unwrap_or(usize::MAX);
        let numbers: Vec<u64> = (drive[0]..drive[1]).step_by(every).collect();
        let drive = match source.site {
            Site::Machines => emulated::run(&source, &numbers),
            Site::Processes | Site::Simulator => processes::run(&source, &numbers),
        };
        return drive.map_err(Failure::Run);
    }
    if source.site == Site::Machines {
        crate::emulated::image("controller", None).map_err(Failure::Usage)?;
    }
    let numbers = source.numbers(args).map_err(Failure::Usage)?;
    campaign::run(&source, &numbers, args)
}
