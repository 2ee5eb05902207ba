//! Mutates valid inputs at random and passes them to the readers: `cargo xtask campaign fuzz`.
//!
//! Each input must be processed in 5 s of CPU time, and all inputs of a target in 1 GB. A panic
//! ends the campaign, and a line names the input.
#![forbid(unsafe_code)]
#![allow(clippy::print_stdout, reason = "a command line prints")]

use std::process::ExitCode;

use rustix::time::{ClockId, clock_gettime};
use tandem_fuzz::{Mutator, TARGETS, Target};

/// Largest CPU time for one input, s, and largest memory of the process, KiB.
const TIME_MAX_S: f64 = 5.0;
const MEMORY_MAX_KIB: u64 = 1 << 20;

fn memory_kib() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("VmHWM:"))?;
    line.split_whitespace().next()?.parse().ok()
}

/// Returns the CPU time, s. Wall-clock time would include other work of a busy machine.
fn cpu_s() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// Prints the name of the input if its check panics.
struct Trying<'a>(&'a Target, u64);

impl Drop for Trying<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            println!("{}: the input of seed {} fails", self.0.name, self.1);
        }
    }
}

fn run(target: &Target, first: u64, count: u64) -> std::io::Result<bool> {
    let mutator = Mutator::new(target)?;
    let (mut accepted, mut slowest) = (0_u64, (0.0, first));
    for seed in first..first + count {
        let input = mutator.input(seed);
        let trying = Trying(target, seed);
        let begin = cpu_s();
        accepted += u64::from((target.body)(&input));
        let took = cpu_s() - begin;
        drop(trying);
        if took > slowest.0 {
            slowest = (took, seed);
        }
    }
    let memory = memory_kib().unwrap_or(0);
    let (slow_s, seed) = slowest;
    println!(
        "{:12} {count} inputs: {accepted} accepted, {} refused; slowest {slow_s:.3} s (seed \
         {seed}), memory {} MiB",
        target.name,
        count - accepted,
        memory >> 10
    );
    Ok(slow_s <= TIME_MAX_S && memory <= MEMORY_MAX_KIB)
}

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let mut number = || arguments.next()?.parse().ok();
    let (Some(first), Some(count)) = (number(), number()) else {
        println!("usage: mutate FIRST-SEED COUNT [TARGET…]");
        return ExitCode::from(2);
    };
    let wanted: Vec<String> = arguments.collect();
    if let Some(unknown) = wanted.iter().find(|it| tandem_fuzz::target(it).is_none()) {
        println!("there is no target {unknown:?}: {}", names().join(", "));
        return ExitCode::from(2);
    }
    let is_wanted =
        |target: &&Target| wanted.is_empty() || wanted.iter().any(|it| it == target.name);
    let mut good = true;
    for target in TARGETS.iter().filter(is_wanted) {
        match run(target, first, count) {
            Ok(held) => good &= held,
            Err(error) => {
                println!("{}: {error}", target.folder().display());
                good = false;
            }
        }
    }
    ExitCode::from(u8::from(!good))
}

fn names() -> Vec<&'static str> {
    TARGETS.iter().map(|target| target.name).collect()
}
