//! Prints the digests of sequences of faults, a line for each setting of time: what
//! `cargo xtask campaign sim-digest` compares.
#![allow(clippy::print_stdout, reason = "its output is its purpose")]

use tandem_redundancy::Config;
use tandem_sim::faults::{Group, Profile};
use tandem_sim::timing::Time;

fn main() {
    let count = std::env::args().nth(1).and_then(|count| count.parse().ok());
    for time in Time::ALL {
        let limits = Config::rt();
        let profile = Profile {
            time,
            ..limits.into()
        };
        print!("{time:?}");
        for number in 0..count.unwrap_or(20) {
            let verdict = Group::Swarm.sequence(number).try_run(profile);
            print!(" {:016x}", verdict.digest);
        }
        println!();
    }
}
