//! Prints the digests of sequences of faults, one line for each pair of [`Around`] and [`Time`].
//! `cargo xtask campaign sim-digest` compares them.
#![allow(clippy::print_stdout, reason = "its output is its purpose")]

use tandem_faults::Group;
use tandem_redundancy::Config;
use tandem_sim::timing::Time;
use tandem_sim::{Around, Profile};

fn main() {
    let count = std::env::args().nth(1).and_then(|count| count.parse().ok());
    let arounds = [Around::Core0, Around::CLOSED_LOOP];
    for (around, time) in arounds
        .into_iter()
        .flat_map(|around| Time::ALL.map(|time| (around, time)))
    {
        let profile = Profile {
            time,
            around,
            ..Config::rt().into()
        };
        print!("{around:?} {time:?}");
        for number in 0..count.unwrap_or(20) {
            let trial = profile.try_run(&Group::Swarm.sequence(number));
            print!(" {:016x}", trial.digest);
        }
        println!();
    }
}
