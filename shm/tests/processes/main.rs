//! Tests with several processes that share memory.
//!
//! The children are forked, which is sound only in a process with one thread. The standard test
//! harness has threads, so this program has its own harness: its tests run one after the other.
#![allow(clippy::unwrap_used, reason = "test code")]

#[cfg(all(target_os = "linux", not(loom), not(miri)))]
mod child;
#[cfg(all(target_os = "linux", not(loom), not(miri)))]
mod killed;
#[cfg(all(target_os = "linux", not(loom), not(miri)))]
mod lost_increments;

#[cfg(all(target_os = "linux", not(loom), not(miri)))]
fn main() -> std::process::ExitCode {
    use libtest_mimic::{Arguments, Trial};
    let tests = killed::TESTS.iter().chain(&lost_increments::TESTS);
    let trials = tests.map(|(name, test)| {
        Trial::test(*name, move || {
            test();
            Ok(())
        })
    });
    let mut args = Arguments::from_args();
    args.test_threads = Some(1);
    libtest_mimic::run(&args, trials.collect()).exit_code()
}

#[cfg(not(all(target_os = "linux", not(loom), not(miri))))]
fn main() {}
