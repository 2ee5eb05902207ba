//! Prints the digests of sequences of faults, a line for each surrounding and setting of time: what
//! `cargo xtask campaign sim-digest` compares.
#![allow(clippy::print_stdout, reason = "its output is its purpose")]

use tandem_redundancy::Config;
use tandem_sim::faults::{Around, Group, Profile};
use tandem_sim::timing::Time;

fn main() {
    let count = std::env::args().nth(1).and_then(|count| count.parse().ok());
    let arounds = [Around::Core0, Around::ClosedLoop];
    for (around, time) in arounds
        .into_iter()
        .flat_map(|around| Time::ALL.map(|time| (around, time)))
    {
        let limits = Config::rt();
        let profile = Profile {
            limits,
            time,
            around,
        };
        print!("{around:?} {time:?}");
        for number in 0..count.unwrap_or(20) {
            let verdict = Group::Swarm.sequence(number).try_run(profile);
            print!(" {:016x}", verdict.digest);
        }
        println!();
    }
}
