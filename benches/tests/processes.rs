//! The processes of a batch: how they end, and what is counted in them.
//!
//! They are forked, which is sound only in a process with one thread. The harness of the test
//! runner has threads, so this program is its own: its tests run one after the other.
#![allow(clippy::unwrap_used, reason = "test code")]

use libtest_mimic::{Arguments, Trial};
use std::io;
use std::process::ExitCode;
use std::time::Duration;
use tandem_benches::harness::Plan;
use tandem_benches::mutual_exclusion::{Exclusion, contended};
use tandem_benches::shared::Shared;
use tandem_benches::system_calls::Counter;
use tandem_benches::worker::{Part, perform, perform_within};

fn main() -> ExitCode {
    let tests: [(&str, fn()); 5] = [
        (
            "a_part_that_fails_says_why_and_the_others_are_ended",
            a_part_that_fails_says_why_and_the_others_are_ended,
        ),
        ("a_part_that_panics_says_so", a_part_that_panics_says_so),
        ("a_dead_end_ends", a_dead_end_ends),
        ("calls_are_counted_and_made", calls_are_counted_and_made),
        (
            "stays_that_get_lost_are_noticed",
            stays_that_get_lost_are_noticed,
        ),
    ];
    let trials = tests.map(|(name, test)| {
        Trial::test(name, move || {
            test();
            Ok(())
        })
    });
    let mut args = Arguments::from_args();
    args.test_threads = Some(1);
    libtest_mimic::run(&args, trials.into()).exit_code()
}

fn sleep_for_ever() -> ! {
    loop {
        std::thread::sleep(Duration::from_secs(60));
    }
}

fn a_part_that_fails_says_why_and_the_others_are_ended() {
    let shared = Shared::new().unwrap();
    let parts = vec![
        Part::on(0, |_| sleep_for_ever()),
        Part::on(0, |_| Err(io::Error::other("no line"))),
    ];
    let error = perform(&shared, parts).unwrap_err();
    assert_eq!(error.to_string(), "no line");
}

fn a_part_that_panics_says_so() {
    let shared = Shared::new().unwrap();
    let parts = vec![Part::on(0, |_| panic!("cannot start: {}", 7))];
    let error = perform(&shared, parts).unwrap_err();
    assert_eq!(error.to_string(), "cannot start: 7");
}

fn a_dead_end_ends() {
    let shared = Shared::new().unwrap();
    let parts = vec![Part::on(0, |_| sleep_for_ever())];
    let error = perform_within(Duration::from_millis(50), &shared, parts).unwrap_err();
    assert_eq!(error.kind(), io::ErrorKind::TimedOut);
}

/// In a process of its own: the counter is the process's.
fn calls_are_counted_and_made() {
    let shared = Shared::new().unwrap();
    let part = Part::on(0, |role| {
        let Some(mut counter) = Counter::new() else {
            role.log.note(0, -1.0);
            return Ok(());
        };
        let none = counter.count(|| drop(std::hint::black_box(vec![1u8, 2, 3])));
        let mut parents = [0; 3];
        let some = counter.count(|| {
            for parent in &mut parents {
                // SAFETY: takes no pointer.
                *parent = unsafe { libc::getppid() };
            }
        });
        drop(counter);
        // SAFETY: takes no pointer.
        assert_eq!(parents, [unsafe { libc::getppid() }; 3]);
        role.log.note(0, f64::from(none));
        role.log.note(1, f64::from(some));
        Ok(())
    });
    perform(&shared, vec![part]).unwrap();
    let noted = [0, 1].map(|at| shared.log(0).noted(at));
    assert!(noted == [0.0, 3.0] || noted[0] == -1.0, "{noted:?}");
}

/// Lets nobody in and says that it has.
struct Absent;

impl Exclusion for Absent {
    fn inside(&mut self, _stay: impl FnOnce()) {}
}

/// The guarded word finds out whether the lock works.
fn stays_that_get_lost_are_noticed() {
    let plan = Plan {
        rounds: 100,
        warm_up: 0,
        cpus: [0, 0],
        system: None,
    };
    let shared = Shared::new().unwrap();
    let error = contended(&plan, &shared, 2, 0, |_| Absent).unwrap_err();
    assert_eq!(error.to_string(), "two were inside at once");
}
