//! How the command ends when it does not end well.

use std::process::ExitCode;

/// Why the command ends with another exit status than 0.
#[derive(Debug)]
pub(crate) enum Failure {
    /// The command line, an input or the machine does not permit it; nothing was started.
    Usage(anyhow::Error),
    /// The run failed.
    Run(anyhow::Error),
    /// The run came to its end, and not all was as it must be. The report says more.
    Objections(Vec<String>),
    /// A person ended it.
    Interrupted,
}

impl Failure {
    /// Says on stderr what was wrong.
    pub(crate) fn say(&self) {
        match self {
            Self::Usage(error) | Self::Run(error) => eprintln!("error: {error:#}"),
            Self::Objections(objections) => eprintln!("run failed: {}", objections.join("; ")),
            Self::Interrupted => {
                eprintln!(
                    "interrupted: everything is stopped, nothing is left, no report was written"
                );
            }
        }
    }

    /// The exit status.
    pub(crate) fn code(&self) -> ExitCode {
        ExitCode::from(match self {
            Self::Run(_) | Self::Objections(_) => 1,
            Self::Usage(_) => 2,
            Self::Interrupted => 130,
        })
    }
}
