//! The ways in which a command can fail, and their exit statuses.

use std::process::ExitCode;

/// The reason why a command ends with an exit status other than 0.
#[derive(Debug)]
pub enum Failure {
    /// The command line, an input or the machine does not permit the command. Nothing was started.
    Usage(anyhow::Error),
    /// The run failed.
    Run(anyhow::Error),
    /// The run ended, but broke these rules. The report has the details.
    Objections(Vec<String>),
    /// The user ended the command before anything was driven.
    Interrupted,
    /// The user ended the drive after this scenario time, s; the report shows the drive until then.
    DrivenUntil(f64),
    /// The user ended the command; the figures until then are shown.
    CutShort,
    /// The command listened, and heard nothing. The text says what to do.
    NothingHeard(String),
}

/// Errors that are not classified otherwise are errors of the run.
impl<E: Into<anyhow::Error>> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::Run(error.into())
    }
}

impl Failure {
    /// Makes a [`Failure::Usage`] from an error that occurred before anything was started.
    pub fn usage(error: impl Into<anyhow::Error>) -> Self {
        Self::Usage(error.into())
    }

    /// Prints the reason on stderr.
    pub fn say(&self) {
        match self {
            Self::Usage(error) | Self::Run(error) => eprintln!("error: {error:#}"),
            Self::Objections(objections) => eprintln!("run failed: {}", objections.join("; ")),
            Self::NothingHeard(text) => eprintln!("error: {text}"),
            Self::CutShort => eprintln!("interrupted: these are the figures so far"),
            Self::DrivenUntil(driven_s) => {
                eprintln!("interrupted after {driven_s:.1} s: the report shows what was driven");
            }
            Self::Interrupted => {
                eprintln!("interrupted: everything is stopped and removed, no report was written");
            }
        }
    }

    /// Prints the reason if a program has failed. Returns its exit status.
    pub fn status(result: Result<ExitCode, Self>) -> ExitCode {
        result.unwrap_or_else(|failure| {
            failure.say();
            failure.code()
        })
    }

    /// Returns the exit status.
    pub fn code(&self) -> ExitCode {
        ExitCode::from(match self {
            Self::Run(_) | Self::Objections(_) => 1,
            Self::Usage(_) => 2,
            Self::NothingHeard(_) => 3,
            Self::Interrupted | Self::DrivenUntil(_) | Self::CutShort => 130,
        })
    }
}
