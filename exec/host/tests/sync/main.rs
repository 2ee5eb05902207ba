//! Clients and candidates of the sync master as real processes that are killed, frozen, restarted
//! or lie (E-3). The program starts itself again as each of them.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test")]
#![allow(clippy::print_stdout, reason = "a process tells its test what it did")]

mod cases;
mod driving;
mod group;
mod roles;

use std::process::ExitCode;

use libtest_mimic::{Arguments, Trial};

fn main() -> ExitCode {
    let argv: Vec<String> = std::env::args().skip(1).collect();
    if argv.first().is_some_and(|first| first == roles::ROLE) {
        return roles::play(&argv[1..]);
    }
    let all = cases::ALL.iter().chain(driving::ALL);
    let trials = all.map(|&(name, case)| {
        Trial::test(name, move || {
            case();
            Ok(())
        })
    });
    libtest_mimic::run(&Arguments::from_args(), trials.collect()).exit_code()
}
