//! The code that `tandem` shares with its separate programs: a run with its processes, its
//! recording and its report.
#![forbid(unsafe_code)]

mod alone;
pub mod args;
pub mod beside;
pub mod board_kind;
pub mod boot_demo;
mod can_bridge;
pub mod clock_view;
pub mod collected;
mod companion;
pub mod dflash;
pub mod exec;
pub mod exec_sign;
pub mod failure;
mod gptp;
pub mod grandmaster;
pub mod injection;
pub mod live;
pub mod metrics;
pub mod output;

pub mod ps;
pub mod publish;
mod report;
pub mod run;
pub mod soc;
pub mod stall_watch;
mod summary;
mod time_figures;
mod timeline;
pub mod topics;
pub mod viewer;

use std::io::{self, Write as _};
use std::process::ExitCode;

use anyhow::Context as _;
use tandem_board_host::{InvalidArgs, ProcessArgs, supply};
use tandem_processes::run_config::RunConfig;
use tandem_processes::{core_process, vehicle};

use failure::Failure;
/// Runs a process of a run if the arguments request one, otherwise `command`. Every program that
/// starts a run must call this, because the program starts itself again, with hidden arguments, for
/// each process of the run.
pub fn program(command: impl FnOnce() -> Result<(), Failure>) -> ExitCode {
    if let Some(args) = ProcessArgs::parse(std::env::args_os().skip(1)) {
        return match process(args) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                eprintln!("{error:#}");
                ExitCode::FAILURE
            }
        };
    }
    Failure::status(command().map(|()| ExitCode::SUCCESS))
}

/// Runs one process of a run until it ends.
fn process(args: Result<ProcessArgs, InvalidArgs>) -> anyhow::Result<()> {
    match args? {
        ProcessArgs::Supply(args) => {
            let system = args.system;
            supply::run(&args, &run::core_command).with_context(|| format!("supply {system}"))
        }
        ProcessArgs::Core(args) => {
            let of = args.identity;
            let run = RunConfig::from_extra(&args.common.extra)?;
            core_process::run(&args, &run).with_context(|| format!("core {}{}", of.system, of.core))
        }
        ProcessArgs::Vehicle(args) => {
            let config = RunConfig::from_extra(&args.common.extra)?;
            match &config.demo {
                Some(files) => boot_demo::play(&args, files),
                None => vehicle::run(&args, &config).and_then(|is_alone| match is_alone {
                    true => alone::report_alone(&args.common.run, &config),
                    false => Ok(()),
                }),
            }
            .context("vehicle")
        }
    }
}

/// Writes to stdout. A closed pipe is not an error.
///
/// # Errors
/// If stdout cannot be written.
pub fn print(text: &str) -> anyhow::Result<()> {
    match io::stdout().write_all(text.as_bytes()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(error).context("stdout"),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    pub(crate) mod synthetic;
}
