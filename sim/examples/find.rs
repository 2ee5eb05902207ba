//! Runs sequences of one group until one violates a rule, and shrinks it. `cargo xtask broken` runs
//! this on a broken variant. Arguments: group, number of sequences. Fails if no rule is violated.
#![allow(clippy::print_stdout, reason = "its output is its purpose")]

use std::process::ExitCode;
use tandem_faults::{Group, known};
use tandem_redundancy::Config;
use tandem_sim::Profile;

/// The program fails if the shrunk sequence has more faults than this.
const FAULTS: usize = 3;

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let named = arguments.next().and_then(|name| Group::of_name(&name));
    let group = named.unwrap_or(Group::Swarm);
    let seeds = arguments.next().and_then(|seeds| seeds.parse().ok());
    let seeds: u64 = seeds.unwrap_or(1_000);
    let profile = Profile::from(Config::rt());
    // The sequences are spread evenly over a finite group.
    let step = group.count().map_or(1, |count| count.div_ceil(seeds));
    // A panic of a broken variant counts as a violation.
    std::panic::set_hook(Box::new(|_| {}));
    let count = group.count().unwrap_or(u64::MAX);
    for seed in (0..seeds).take_while(|seed| seed * step < count) {
        let sequence = group.sequence(seed * step);
        let new = |rule: &_| known(&sequence, *rule, None).is_none();
        let trial = profile.try_run(&sequence);
        if let Some(rule) = trial.violations.into_iter().find(new) {
            let least = profile.shrunk(&sequence, rule);
            println!(
                "{rule:?} in {group:?} {} after {} sequences: {}",
                sequence.number,
                seed + 1,
                least.kinds()
            );
            return match least.faults.len() {
                0..=FAULTS => ExitCode::SUCCESS,
                _ => ExitCode::FAILURE,
            };
        }
    }
    println!("none of {seeds} {group:?} sequences is violated");
    ExitCode::FAILURE
}
