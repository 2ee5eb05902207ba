//! The scenarios of a platform's life, with real processes. Their names are those of the
//! integration tests of S-CORE's lifecycle (Eclipse, commit eee9685); the programs are ours.
// A test without the standard harness is no `#[test]`, and processes print.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stdout)]

mod actor;
mod hostile;
mod more;
mod rig;
mod score;
mod unrecoverable;

use std::process::ExitCode;

use libtest_mimic::{Arguments, Trial};

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    match words.split_first() {
        Some((mode, rest)) if mode == "actor" => return actor::run(rest),
        Some((mode, rest)) if mode == "guardian" => return rig::guardian(rest),
        Some((mode, rest)) if mode == "flood" => hostile::flood(&rest[0]),
        Some((mode, rest)) if mode == "launcher" => return rig::launcher(rest),
        _ => {}
    }
    let all = score::ALL.iter().chain(more::ALL).chain(unrecoverable::ALL);
    let all = all.chain(hostile::ALL);
    let trials = all.map(|(name, test)| {
        Trial::test(*name, || {
            test();
            Ok(())
        })
    });
    libtest_mimic::run(&Arguments::from_args(), trials.collect()).exit_code()
}
