//! Tests that the worker pool does not allocate in a run (E-2).

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tandem_exec::client::Random;
use tandem_exec_client::pool::WorkerPool;

use crate::allocator::{counted, watch_this_thread};

/// The requests that a worker has made since its first element, the largest of all workers.
static REQUESTS: AtomicU64 = AtomicU64::new(0);

/// What the caller and the workers do in a run, after the first one has started each worker, calls
/// the allocator not once: neither the function nor the pool around it.
#[test]
fn a_run_of_the_worker_pool_does_not_allocate() {
    for workers in [1, 2, 7] {
        let patience = Duration::from_secs(60);
        let mut pool = WorkerPool::new(
            workers,
            500,
            patience,
            |element: &mut u64, random: &mut Random| {
                // What this worker did since its last element counts too.
                REQUESTS.fetch_max(watch_this_thread(), Ordering::Relaxed);
                *element ^= random.draw();
            },
        )
        .expect("threads");
        let mut elements = (0..500).collect();
        for run in 0..20 {
            let (requests, done) = counted(|| pool.run(&mut elements, run));
            assert_eq!(done, Ok(()));
            assert_eq!(requests, 0, "the caller, {workers} workers, run {run}");
        }
        assert_eq!(REQUESTS.load(Ordering::Relaxed), 0, "a worker of {workers}");
    }
}
