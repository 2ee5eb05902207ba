//! Every case runs once with a tiny plan, to show that it works; no figure is checked. Also tests
//! the processes of a batch: how they end, and the counts taken in them.
//!
//! They are forked, which is sound only in a process with one thread: the tests run one after the
//! other on the main thread.
#![allow(clippy::unwrap_used, reason = "test code")]
#![allow(clippy::print_stdout, reason = "skipped cases are told")]

use libtest_mimic::{Arguments, Trial};
use std::alloc::System;
use std::collections::HashMap;
use std::io;
use std::ops::RangeInclusive;
use std::process::ExitCode;
use std::time::Duration;
use tandem_benches::cases::{self, Candidate, Comparison};
use tandem_benches::harness::BatchPlan;
use tandem_benches::mutual_exclusion::{Exclusion, contended};
use tandem_benches::shared::SharedPage;
use tandem_benches::system_calls::count;
use tandem_benches::worker::{BatchPart, perform, perform_within};
use tandem_board_host::{UnsupervisedSystem, isolation};
use tandem_rtos::host::TaskAllocator;

/// The allocator of the cases that run tasks of FreeRTOS.
#[global_allocator]
static ALLOCATOR: TaskAllocator<System> = TaskAllocator::new(System);

/// Facts that a case must have, with their permitted values.
#[rustfmt::skip]
const FACTS: [(&str, &str, RangeInclusive<f64>); 3] = [
    ("lock/contended-2", "share of the least served, 1 is fair", 0.0..=1.0),
    ("noise/cpu0", "lost share of the time", 0.0..=1.0),
    ("throughput/broadcast-1-to-2", "share received by receiver 2", 0.0..=1.0),
];

/// System calls of a send: to a receiver that waits as the case does, and to one that is awake.
/// Counted by the kernel; absent if it cannot count. The first rows show that the count is right.
const CALLS: [(&str, RangeInclusive<f64>, f64); 8] = [
    ("sleep/floor", 1.0..=1.0, 1.0),
    ("sleep/pipe", 1.0..=1.0, 1.0),
    ("spin/floor", 0.0..=0.0, 0.0),
    // A send to an awake receiver makes no system call under any waiting policy.
    ("spin/tandem", 0.0..=0.0, 0.0),
    ("spin/tandem-channel", 0.0..=0.0, 0.0),
    ("sleep/tandem", 1.0..=1.0, 0.0),
    ("sleep/tandem-adaptive", 1.0..=1.0, 0.0),
    // The receiver may run and sleep again before the sender's call ends: then it is woken twice.
    ("one-cpu/tandem", 1.0..=2.0, 0.0),
];

/// Functions with their names.
macro_rules! named {
    ($($test:ident),* $(,)?) => {
        [$((concat!("processes/", stringify!($test)), $test as fn())),*]
    };
}

fn main() -> ExitCode {
    let test = |name: &str, test: Box<dyn FnOnce() + Send>| {
        Trial::test(name, || {
            test();
            Ok(())
        })
    };
    let processes = named![
        a_part_that_fails_ends_the_others,
        a_part_that_panics_says_so,
        a_dead_end_ends,
        calls_are_counted_and_made,
        stays_that_get_lost_are_noticed,
    ];
    let mut trials: Vec<Trial> = processes
        .into_iter()
        .map(|(name, run)| test(name, Box::new(run)))
        .collect();
    trials.extend(cases::all().map(|case| test(&case.full_name(), Box::new(move || run(&case)))));
    let mut args = Arguments::from_args();
    args.test_threads = Some(1);
    libtest_mimic::run(&args, trials).exit_code()
}

/// Runs a case once: each part ends, and there are samples. The cases of `topics` measure what D-6
/// asks for.
fn run(case: &Candidate) {
    let name = case.full_name();
    // The machine's `/dev/shm`: tests beside this one see the nodes of iceoryx2 there, too.
    let place = isolation::enter_shared().unwrap();
    let system: &'static UnsupervisedSystem =
        Box::leak(Box::new(UnsupervisedSystem::power_on(&place).unwrap()));
    let cpus = core_affinity::get_core_ids().unwrap();
    // Each word of a payload is written and read.
    let most_rounds = if name.ends_with("MiB") { 3 } else { 20 };
    let plan = BatchPlan {
        rounds: case.rounds.min(most_rounds),
        warm_up: 2,
        cpus: [cpus[0].id, cpus[cpus.len() - 1].id],
        system: Some(system),
    };
    let batch = case.run_batch(&plan);
    place.wipe();
    let is_missing = |error: &io::Error| {
        let why = error.to_string();
        why.contains("is not installed") || why.contains("cannot run here")
    };
    if let Some(why) = batch.as_ref().err().filter(|why| is_missing(why)) {
        let others = ["ddsperf", "-s6", "-runit", "-systemd"];
        assert!(
            others.iter().any(|end| name.ends_with(end)),
            "{name}: {why}"
        );
        println!("SKIPPED: {why}");
        return;
    }
    let batch = batch.unwrap_or_else(|error| panic!("{name}: {error}"));
    assert!(!batch.samples_ps.is_empty(), "{name} has no samples");
    assert!(
        batch.samples_ps.iter().sum::<u64>() > 0,
        "{name} took no time"
    );
    let at_fixed_times = case.group == Comparison::Rate;
    assert_eq!(!batch.naive_ps.is_empty(), at_fixed_times, "{name}");
    let facts: HashMap<_, _> = batch.facts.into_iter().collect();
    for (fact, value) in &facts {
        assert!(value.is_finite(), "{name}: {fact} is {value}");
    }
    for (_, fact, range) in FACTS.into_iter().filter(|(case, ..)| *case == name) {
        let value = facts[fact];
        assert!(range.contains(&value), "{name}: {fact} is {value}");
    }
    for (_, waiting, awake) in CALLS.into_iter().filter(|(case, ..)| *case == name) {
        // Not every kernel can count system calls.
        if let Some(calls) = facts.get("syscalls per send") {
            assert!(waiting.contains(calls), "{name}: {calls} calls to wake");
            assert_eq!(facts.get("syscalls per send to one awake"), Some(&awake));
        }
    }
}

fn sleep_for_ever() -> ! {
    loop {
        std::thread::sleep(Duration::from_secs(60));
    }
}

fn a_part_that_fails_ends_the_others() {
    let shared = SharedPage::new().unwrap();
    let parts = vec![
        BatchPart::on(0, |_| sleep_for_ever()),
        BatchPart::on(0, |_| Err(io::Error::other("no line"))),
    ];
    let error = perform(&shared, parts).unwrap_err();
    assert_eq!(error.to_string(), "no line");
}

fn a_part_that_panics_says_so() {
    let shared = SharedPage::new().unwrap();
    let parts = vec![BatchPart::on(0, |_| panic!("cannot start: {}", 7))];
    let error = perform(&shared, parts).unwrap_err();
    assert_eq!(error.to_string(), "cannot start: 7");
}

fn a_dead_end_ends() {
    let shared = SharedPage::new().unwrap();
    let parts = vec![BatchPart::on(0, |_| sleep_for_ever())];
    let error = perform_within(Duration::from_millis(50), &shared, parts).unwrap_err();
    assert_eq!(error.kind(), io::ErrorKind::TimedOut);
}

/// Runs in a separate process, because each process has one counter.
fn calls_are_counted_and_made() {
    let shared = SharedPage::new().unwrap();
    let part = BatchPart::on(0, |role| {
        let none = count(|| drop(std::hint::black_box(vec![1u8, 2, 3])));
        let mut parents = [0; 3];
        let some = count(|| {
            for parent in &mut parents {
                *parent = std::os::unix::process::parent_id();
            }
        });
        assert_eq!(parents, [std::os::unix::process::parent_id(); 3]);
        role.log.note(0, none.map_or(-1.0, f64::from));
        role.log.note(1, some.map_or(-1.0, f64::from));
        Ok(())
    });
    perform(&shared, vec![part]).unwrap();
    let noted = [0, 1].map(|at| shared.log(0).noted(at));
    assert!(noted == [0.0, 3.0] || noted == [-1.0; 2], "{noted:?}");
}

/// Never runs the critical section, but reports that it did.
struct Absent;

impl Exclusion for Absent {
    fn inside(&mut self, _stay: impl FnOnce()) {}
}

/// The guarded word reveals a lock that does not work.
fn stays_that_get_lost_are_noticed() {
    let plan = BatchPlan {
        rounds: 100,
        warm_up: 0,
        cpus: [0, 0],
        system: None,
    };
    let shared = SharedPage::new().unwrap();
    let error = contended(&plan, &shared, 2, |_| Absent).unwrap_err();
    assert_eq!(error.to_string(), "two were inside at once");
}
