//! `tandem-bench`, which `tandem bench` starts: a separate program, because no other command needs
//! the peers that it links.
#![forbid(unsafe_code)]

use std::alloc::System;
use std::io::{self, Write as _};
use std::process::ExitCode;
use tandem_benches::command::{BenchArgs, bench};
use tandem_page::command_line;
use tandem_rtos::host::TaskAllocator;

/// As in `tandem`: the tasks of a core share its thread, and therefore its allocator.
#[global_allocator]
static ALLOCATOR: TaskAllocator<System> = TaskAllocator::new(System);

/// Measures communication between cores, beside the hardware's floor and the alternatives.
#[derive(Debug, clap::Parser)]
#[command(name = "tandem bench", version, max_term_width = 100)]
struct Cli {
    #[command(flatten)]
    args: BenchArgs,
}

fn main() -> ExitCode {
    // `compare` runs `OLD bench ...`, because OLD may be a `tandem`; here `bench` is dropped.
    let mut words: Vec<_> = std::env::args_os().collect();
    if words.get(1).is_some_and(|word| word == "bench") {
        words.remove(1);
    }
    let (shown, besides) = match bench(&command_line::parse::<Cli>(words).args) {
        Ok(outcome) => outcome,
        Err(failure) => {
            eprintln!("error: {:#}", failure.why);
            return ExitCode::from(failure.status);
        }
    };
    // A closed stdout is not an error.
    if let Err(error) = io::stdout().write_all(shown.as_bytes())
        && error.kind() != io::ErrorKind::BrokenPipe
    {
        eprintln!("stdout: {error}");
    }
    besides.map_or(ExitCode::SUCCESS, |(why, status)| {
        eprintln!("{why}");
        ExitCode::from(status)
    })
}
