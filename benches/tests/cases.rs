//! Every case runs once with a tiny plan, so that none is dead; no figure is judged.
#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "test code")]

use std::collections::HashMap;
use std::ops::RangeInclusive;
use tandem_benches::cases;
use tandem_benches::harness::Plan;
use tandem_board_host::{BareSystem, isolation};

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

/// Without the harness of the test runner: the cases fork, which a process with threads must not.
fn main() {
    let place = isolation::enter().unwrap();
    let system = BareSystem::power_on(&place).unwrap();
    let cpus = core_affinity::get_core_ids().unwrap();
    let cpus = [cpus[0].id, cpus[cpus.len() - 1].id];
    let only: Vec<String> = std::env::args()
        .skip(1)
        .filter(|arg| !arg.starts_with('-'))
        .collect();
    let mut facts = HashMap::new();
    let mut ran = 0;
    for case in cases::all() {
        let name = case.full_name();
        if !only.is_empty() && !only.iter().any(|part| name.contains(part.as_str())) {
            continue;
        }
        let plan = Plan {
            rounds: case.rounds.min(20),
            warm_up: 2,
            cpus,
        };
        let begin = std::time::Instant::now();
        let mut memory = None;
        match (case.run)(&system, &plan) {
            Ok(batch) => {
                memory = batch.memory_bytes;
                assert!(!batch.samples_ps.is_empty(), "{name} has no samples");
                let sum: u64 = batch.samples_ps.iter().sum();
                assert!(sum > 0, "{name} took no time");
                for (fact, value) in batch.facts {
                    assert!(value.is_finite(), "{name}: {fact} is {value}");
                    facts.insert((name.clone(), fact), value);
                }
                ran += 1;
            }
            // What is not installed is skipped by the benchmark, too.
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                println!("{name} skipped: {error}");
            }
            Err(error) => panic!("{name}: {error}"),
        }
        let took_ms = begin.elapsed().as_millis();
        let memory = memory.map_or(String::new(), |bytes| format!(", {} KiB", bytes / 1024));
        println!("{name}: {took_ms} ms{memory}");
    }
    if only.is_empty() {
        for (case, fact, range) in FACTS {
            let value = facts[&(case.to_owned(), fact)];
            assert!(range.contains(&value), "{case}: {fact} is {value}");
        }
        for (case, waiting, awake) in CALLS {
            let of = |fact| facts.get(&(case.to_owned(), fact)).copied();
            let Some(calls) = of("syscalls per send") else {
                println!("{case}: this kernel cannot count system calls");
                continue;
            };
            assert!(waiting.contains(&calls), "{case}: {calls} calls to wake");
            assert_eq!(of("syscalls per send to one awake"), Some(awake), "{case}");
        }
        assert!(ran > 70, "only {ran} cases ran");
    }
    place.wipe();
    println!("{ran} cases ran");
}
