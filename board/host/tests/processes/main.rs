//! Tests the host board as real processes: connections, failures, and what a run leaves behind.
//!
//! Each case is a separate run. The harness starts this program again as the launcher of the run;
//! the launcher starts it again as supplies and vehicle, and the supplies as cores. The vehicle
//! runs the script of the case: it can observe and kill all processes, and a panic in it fails the
//! case. The conformance suite of the board runs in the same way.
#![allow(clippy::expect_used, reason = "a test")]

mod cases;
mod conformance;
mod deaths;
mod environment;
mod fixture;
mod launcher;
mod residue;

use std::net::Ipv4Addr;
use std::process::ExitCode;

use libtest_mimic::{Arguments, Trial};
use tandem_board_host::{ProcessArgs, UdpPlace};

fn main() -> ExitCode {
    let argv: Vec<_> = std::env::args_os().skip(1).collect();
    if let Some(args) = ProcessArgs::parse(argv.iter().cloned()) {
        return fixture::play(args.expect("arguments made by this program"));
    }
    if argv.first().is_some_and(|first| first == launcher::LAUNCH) {
        return launcher::launch(&argv[1..], Some(network()), fixture::claims_realtime);
    }
    let mut trials: Vec<Trial> = fixture::all_cases()
        .map(|case| {
            Trial::test(case.name, move || {
                fixture::run_case(case).map_err(Into::into)
            })
        })
        .collect();
    trials.extend(residue::trials());
    trials.extend(environment::trials());
    libtest_mimic::run(&Arguments::from_args(), trials).exit_code()
}

/// Returns a domain that no other run of this program has at the same time.
fn network() -> UdpPlace {
    let domain = std::process::id() % 229;
    UdpPlace::new(domain as u16, Ipv4Addr::LOCALHOST).expect("a domain")
}
