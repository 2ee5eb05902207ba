//! Every case runs once with a tiny plan, so that none is dead; no figure is judged.
#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "test code")]

use std::alloc::System;
use std::collections::HashMap;
use std::ops::RangeInclusive;
use tandem_benches::cases::{self, Case};
use tandem_benches::harness::Plan;
use tandem_board_host::{UnsupervisedSystem, isolation};
use tandem_rtos::host::TaskAllocator;

/// Of the cases that run tasks of FreeRTOS.
#[global_allocator]
static ALLOCATOR: TaskAllocator<System> = TaskAllocator::new(System);

/// Facts that a case must have, with what they may be.
const FACTS: [(&str, &str, RangeInclusive<f64>); 4] = [
    (
        "lock/contended-2",
        "share of the least served, 1 is fair",
        0.0..=1.0,
    ),
    ("noise/cpu0", "lost share of the time", 0.0..=1.0),
    ("rate/tandem", "naive p50, ns", 1.0..=f64::MAX),
    (
        "throughput/broadcast-1-to-2",
        "share received by receiver 2",
        0.0..=1.0,
    ),
];

/// System calls of a send: to a receiver that waits as the case does, and to one that is awake.
/// Counted by the kernel; not there if it cannot. The first rows say that the count is right.
const CALLS: [(&str, RangeInclusive<f64>, f64); 8] = [
    ("sleep/floor", 1.0..=1.0, 1.0),
    ("sleep/pipe", 1.0..=1.0, 1.0),
    ("spin/floor", 0.0..=0.0, 0.0),
    // No system call on a send to an awake receiver, whatever it does when it waits.
    ("spin/tandem", 0.0..=0.0, 0.0),
    ("spin/tandem-channel", 0.0..=0.0, 0.0),
    ("sleep/tandem", 1.0..=1.0, 0.0),
    ("sleep/tandem-adaptive", 1.0..=1.0, 0.0),
    // The woken may run, and sleep again, before its waker has finished: then it is woken twice.
    ("one-cpu/tandem", 1.0..=2.0, 0.0),
];

/// Without the harness of the test runner, whose process has threads: the cases fork. Each case is
/// a test by its name. `cargo nextest` asks for the list and then for one test in each process.
fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let has = |flag: &str| args.iter().any(|arg| arg == flag);
    let wanted = |name: &str| {
        // `--format terse` is the only flag with a value.
        let is_filter = |arg: &&String| !arg.starts_with('-') && *arg != "terse";
        let mut filters = args.iter().filter(is_filter).peekable();
        let fits = |filter: &String| {
            let is_exact = has("--exact");
            name == filter || !is_exact && name.contains(filter.as_str())
        };
        filters.peek().is_none() || filters.any(fits)
    };
    // None is marked as ignored.
    let cases = cases::all().filter(|case| wanted(&case.full_name()) && !has("--ignored"));
    if has("--list") {
        cases.for_each(|case| println!("{}: test", case.full_name()));
        return;
    }
    let place = isolation::enter().unwrap();
    let system: &'static UnsupervisedSystem =
        Box::leak(Box::new(UnsupervisedSystem::power_on(&place).unwrap()));
    let cpus = core_affinity::get_core_ids().unwrap();
    let cpus = [cpus[0].id, cpus[cpus.len() - 1].id];
    let ran = cases.map(|case| run(&case, system, cpus)).count();
    place.wipe();
    println!("test result: ok. {ran} passed; 0 failed");
}

fn run(case: &Case, system: &'static UnsupervisedSystem, cpus: [usize; 2]) {
    let name = case.full_name();
    let plan = Plan {
        rounds: case.rounds.min(20),
        warm_up: 2,
        cpus,
        system: Some(system),
    };
    let batch = match case.run_batch(&plan) {
        Ok(batch) => batch,
        // What is not installed is skipped by the benchmark, too.
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            println!("{name} skipped: {error}");
            return;
        }
        Err(error) => panic!("{name}: {error}"),
    };
    assert!(!batch.samples_ps.is_empty(), "{name} has no samples");
    assert!(
        batch.samples_ps.iter().sum::<u64>() > 0,
        "{name} took no time"
    );
    let facts: HashMap<_, _> = batch.facts.into_iter().collect();
    for (fact, value) in &facts {
        assert!(value.is_finite(), "{name}: {fact} is {value}");
    }
    for (_, fact, range) in FACTS.into_iter().filter(|(case, ..)| *case == name) {
        let value = facts[fact];
        assert!(range.contains(&value), "{name}: {fact} is {value}");
    }
    for (_, waiting, awake) in CALLS.into_iter().filter(|(case, ..)| *case == name) {
        let Some(calls) = facts.get("syscalls per send") else {
            println!("{name}: this kernel cannot count system calls");
            continue;
        };
        assert!(waiting.contains(calls), "{name}: {calls} calls to wake");
        assert_eq!(facts.get("syscalls per send to one awake"), Some(&awake));
    }
    println!("{name}: ok");
}
