//! Core 0 in a process of its own, as `tandem run` starts it, beside others that misbehave.
//!
//! Each case is a run of its own. The harness starts this program again as the launcher of the run;
//! that starts it again as supplies and vehicle, and the supplies as cores. The vehicle is the
//! script of the case, and a panic in it fails the case.
//!
//! This is a test of the package `tandem`, so that it may use the very code of the command.
#![allow(
    clippy::expect_used,
    clippy::print_stderr,
    clippy::print_stdout,
    reason = "a test ends where something is not as it must be"
)]

mod calls;
#[path = "../../cli/src/control_core.rs"]
mod control_core;
mod flood;
#[path = "../../board/host/tests/processes/launcher.rs"]
mod launcher;
mod run;
mod tracer;

use libtest_mimic::{Arguments, Trial};
use std::process::ExitCode;
use tandem_board_host::ProcessArgs;
use tandem_rtos::host::TaskAllocator;

#[global_allocator]
static ALLOCATOR: TaskAllocator<tracer::Marked> = TaskAllocator::new(tracer::Marked);

fn main() -> ExitCode {
    let argv: Vec<_> = std::env::args_os().skip(1).collect();
    if let Some(args) = ProcessArgs::parse(argv.iter().cloned()) {
        return run::play(args.expect("arguments made by this program"));
    }
    if argv.first().is_some_and(|first| first == launcher::LAUNCH) {
        return launcher::launch(&argv[1..], |_| false);
    }
    let trials = run::all_cases()
        .map(|case| Trial::test(case.name, move || run::run_case(&case).map_err(Into::into)));
    libtest_mimic::run(&Arguments::from_args(), trials.collect()).exit_code()
}
