//! How the command ends when it does not end well.

use std::process::ExitCode;

/// Why the command ends with another exit status than 0.
#[derive(Debug)]
pub enum Failure {
    /// The command line, an input or the machine does not permit it; nothing was started.
    Usage(anyhow::Error),
    /// The run failed.
    Run(anyhow::Error),
    /// The run came to its end, and not all was as it must be. The report says more.
    Objections(Vec<String>),
    /// A person ended it before anything was driven.
    Interrupted,
    /// A person ended the drive after this scenario time, s; the report has what was driven.
    DrivenUntil(f64),
    /// A person ended it, and what there was until then is shown.
    CutShort,
}

impl Failure {
    /// Says on stderr what was wrong.
    pub fn say(&self) {
        match self {
            Self::Usage(error) | Self::Run(error) => eprintln!("error: {error:#}"),
            Self::Objections(objections) => eprintln!("run failed: {}", objections.join("; ")),
            Self::CutShort => eprintln!("interrupted: these are the figures so far"),
            Self::DrivenUntil(driven_s) => {
                eprintln!("interrupted after {driven_s:.1} s: the report shows what was driven");
            }
            Self::Interrupted => {
                eprintln!(
                    "interrupted: everything is stopped, nothing is left, no report was written"
                );
            }
        }
    }

    /// The exit status.
    pub fn code(&self) -> ExitCode {
        ExitCode::from(match self {
            Self::Run(_) | Self::Objections(_) => 1,
            Self::Usage(_) => 2,
            Self::Interrupted | Self::DrivenUntil(_) | Self::CutShort => 130,
        })
    }
}
