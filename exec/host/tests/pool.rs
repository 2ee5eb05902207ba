//! The worker pool: results, panics, and a worker that hangs (E-2).
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test")]

use std::os::unix::process::ExitStatusExt as _;
use std::process::{Command, Stdio};
use std::time::Duration;

use tandem_exec::client::Random;
use tandem_exec_client::pool::{PoolError, WorkerPool};

/// A run on a loaded machine is never mistaken for one that hangs.
const PATIENCE: Duration = Duration::from_secs(60);
const SEED: u64 = 42;

fn start(len: usize) -> Vec<u64> {
    (0..len as u64).map(|k| k.wrapping_mul(0x1_0001)).collect()
}

/// Uneven work that depends on the element and on its random numbers.
fn work(element: &mut u64, random: &mut Random) {
    for _ in 0..=*element % 50 {
        *element = element.rotate_left(7) ^ random.draw();
    }
}

fn sequential(len: usize) -> Vec<u64> {
    let mut elements = start(len);
    for (index, element) in elements.iter_mut().enumerate() {
        work(element, &mut Random::of_element(SEED, index as u64));
    }
    elements
}

/// E-2: the result is that of a loop over the list, for each number of workers from 1 to 64 and
/// lists that are shorter and longer than the number of workers and of blocks; also in later runs.
#[test]
fn results_do_not_depend_on_the_number_of_workers() {
    let lengths = [0, 1, 2, 7, 63, 64, 65, 511, 512, 513, 1000];
    let expected = lengths.map(sequential);
    for workers in 1..=64 {
        let mut pool = WorkerPool::new(workers, 1000, PATIENCE, work).unwrap();
        for (len, expected) in lengths.into_iter().zip(&expected) {
            let mut elements = start(len);
            assert_eq!(pool.run(&mut elements, SEED), Ok(()));
            assert_eq!(elements, *expected, "{workers} workers, {len} elements");
        }
    }
}

/// E-2: each element has a seed of its own, which depends on the run's seed too.
#[test]
fn each_element_has_its_own_seed() {
    let mut pool = WorkerPool::new(
        3,
        1000,
        PATIENCE,
        |element: &mut u64, random: &mut Random| {
            *element = random.draw();
        },
    );
    let mut draw = |seed| {
        let mut elements = vec![0; 1000];
        pool.as_mut().unwrap().run(&mut elements, seed).unwrap();
        elements
    };
    let (mut one, two) = (draw(1), draw(2));
    assert_eq!(one, draw(1));
    assert!(one.iter().zip(&two).all(|(one, two)| one != two));
    one.sort_unstable();
    one.dedup();
    assert_eq!(one.len(), 1000, "no two elements have the same seed");
}

/// E-2: a panic is an error of the run that names the first element. All other elements are
/// processed, whatever the number of workers, and the pool stays usable.
#[test]
fn a_panic_is_an_error_and_the_pool_stays_usable() {
    for workers in [1, 2, 5, 64] {
        let mut pool = WorkerPool::new(
            workers,
            100,
            PATIENCE,
            |element: &mut u64, _: &mut Random| {
                // Without the hook's message: resume_unwind does not call it.
                if *element == 30 || *element == 77 {
                    std::panic::resume_unwind(Box::new(()));
                }
                *element += 1000;
            },
        )
        .unwrap();
        for _ in 0..3 {
            let mut elements: Vec<u64> = (0..100).collect();
            let panicked = pool.run(&mut elements, SEED);
            assert_eq!(panicked, Err(PoolError::Panicked { index: 30 }));
            for (index, element) in (0..).zip(elements) {
                let expected = if [30, 77].contains(&index) {
                    index
                } else {
                    index + 1000
                };
                assert_eq!(element, expected);
            }
            let mut elements = vec![5; 100];
            assert_eq!(pool.run(&mut elements, SEED), Ok(()));
            assert_eq!(elements, [1005; 100]);
        }
    }
}

#[test]
fn a_list_that_is_too_long_is_refused_untouched() {
    let mut pool = WorkerPool::new(2, 10, PATIENCE, work).unwrap();
    let mut elements = start(11);
    let refused = Err(PoolError::TooMany {
        len: 11,
        capacity: 10,
    });
    assert_eq!(pool.run(&mut elements, SEED), refused);
    assert_eq!(elements, start(11));
}

/// Set in the process that hangs.
const HANGS: &str = "TANDEM_TEST_POOL_HANGS";

/// E-2: a worker that hangs ends the process, and what hangs is told.
#[test]
fn a_worker_that_hangs_ends_the_process() {
    if std::env::var_os(HANGS).is_some() {
        let patience = Duration::from_millis(200);
        let mut pool = WorkerPool::new(3, 64, patience, |element: &mut u64, _: &mut Random| {
            if *element == 17 {
                loop {
                    std::thread::park();
                }
            }
        })
        .unwrap();
        let _ = pool.run(&mut (0..64).collect(), SEED);
        // Only a broken watchdog gets here, if at all; the test of the other process fails then.
        std::process::exit(0);
    }
    let child = Command::new("timeout")
        .args(["-s", "KILL", "60"])
        .arg(std::env::current_exe().unwrap())
        .args([
            "--exact",
            "a_worker_that_hangs_ends_the_process",
            "--nocapture",
        ])
        .env(HANGS, "1")
        .stdin(Stdio::null())
        .output()
        .unwrap();
    let told = String::from_utf8_lossy(&child.stderr);
    // `timeout` ends by the signal of its child, or with 128 and its number.
    let signal = child
        .status
        .signal()
        .or(child.status.code().map(|code| code - 128));
    assert_eq!(signal, Some(6), "SIGABRT: {:?} {told}", child.status);
    assert!(told.contains("hangs"), "{told}");
}
