//! `tandem-bench`, which `tandem bench` starts: a program of its own, because no other command
//! needs the peers that it is built with.
#![forbid(unsafe_code)]

use clap::Parser as _;
use std::alloc::System;
use std::io::{self, Write as _};
use std::process::ExitCode;
use tandem_benches::command::{self, BenchArgs, BenchCommand, BenchError};
use tandem_benches::table;
use tandem_rtos::host::TaskAllocator;

/// As in `tandem`: the tasks of a core share its thread, and with it the allocator.
#[global_allocator]
static ALLOCATOR: TaskAllocator<System> = TaskAllocator::new(System);

/// Measures communication between cores, beside the hardware's floor and what else one would use.
#[derive(Debug, clap::Parser)]
#[command(name = "tandem bench", version, max_term_width = 100)]
struct Cli {
    #[command(flatten)]
    args: BenchArgs,
}

fn main() -> ExitCode {
    // `compare` starts the program before the change as `OLD bench ...`: OLD may be a `tandem`.
    let mut words: Vec<_> = std::env::args_os().collect();
    if words.get(1).is_some_and(|word| word == "bench") {
        words.remove(1);
    }
    let (why, code) = match bench(&Cli::parse_from(words).args) {
        Ok(None) => return ExitCode::SUCCESS,
        Ok(Some((why, code))) => (why, code),
        Err(error) => {
            let code = match &error {
                BenchError::Interrupted => 130,
                error if error.is_usage() => 2,
                _ => 1,
            };
            (format!("error: {:#}", anyhow::Error::from(error)), code)
        }
    };
    eprintln!("{why}");
    ExitCode::from(code)
}

/// What there is to say besides the figures, and the exit status for it.
fn bench(args: &BenchArgs) -> Result<Option<(String, u8)>, BenchError> {
    if let Some(BenchCommand::Compare(args)) = &args.command {
        let outcome = command::compare(args)?;
        print(&outcome.shown);
        let slower = outcome.comparison.slower.join(", ");
        let why = format!("slower beyond noise: {slower}");
        return Ok((!slower.is_empty()).then_some((why, 1)));
    }
    let results = command::run(args)?;
    let width = terminal_size::terminal_size().map(|(width, _)| usize::from(width.0));
    print(&results.table(width.unwrap_or(table::USUAL)));
    let why = "interrupted: these are the figures so far";
    Ok(results.interrupted.then(|| (why.to_owned(), 130)))
}

/// Writes to stdout; a reader that has seen enough is no error.
fn print(text: &str) {
    if let Err(error) = io::stdout().write_all(text.as_bytes())
        && error.kind() != io::ErrorKind::BrokenPipe
    {
        eprintln!("stdout: {error}");
    }
}
