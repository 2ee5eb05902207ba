//! Tests of core 0 in a separate process, as `tandem run` starts it, beside misbehaving processes.
//!
//! Each case is a separate run. The harness starts this program again as the launcher of the run,
//! the launcher starts it as supplies and vehicle, and the supplies start it as cores. The vehicle
//! is the script of the case, and a panic in the script fails the case.
//!
//! This is a test of the package `tandem`, so that it can use the same code as the command.
#![allow(
    clippy::expect_used,
    clippy::print_stderr,
    clippy::print_stdout,
    reason = "a test ends where something is not as it must be"
)]

mod calls;
#[expect(unreachable_pub, reason = "the module is public in its own crate")]
#[path = "../../cli/processes/src/control_core.rs"]
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
        return launcher::launch(&argv[1..], None, |_| false);
    }
    let trials = run::all_cases()
        .map(|case| Trial::test(case.name, move || run::run_case(&case).map_err(Into::into)));
    libtest_mimic::run(&Arguments::from_args(), trials.collect()).exit_code()
}
