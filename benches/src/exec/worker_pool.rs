//! The worker pool beside rayon: one run over the elements of a slice, by two workers.

use crate::clock::{ticks, to_ps};
use crate::harness::{Batch, BatchPlan};
use crate::shared::SharedPage;
use crate::worker::{BatchPart, perform};
use rayon::prelude::*;
use rustix::thread::{CpuSet, sched_setaffinity};
use std::hint::black_box;
use std::io;
use std::time::Duration;
use tandem_exec::client::Random;
use tandem_exec_client::pool::WorkerPool;

/// Elements of a run.
const ELEMENTS: usize = 512;
/// Workers, one on each CPU.
const WORKERS: usize = 2;
/// Steps of the computation of an element: about 2 us.
const STEPS: u32 = 2_000;

/// The computation of an element: a generator's steps, which no compiler can shorten.
fn compute(element: &mut u64, seed: u64) {
    let mut state = (*element ^ seed) | 1;
    for _ in 0..black_box(STEPS) {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
    }
    *element = state;
}

/// Times runs in a process of its own. `prepare` starts the workers, and returns what one run does.
fn timed<F: FnMut(&mut Vec<u64>) -> io::Result<()>>(
    plan: &BatchPlan,
    prepare: impl FnOnce() -> io::Result<F>,
) -> io::Result<Batch> {
    let shared = SharedPage::new()?;
    let part = BatchPart::on(plan.cpus[0], |role| {
        // Workers inherit this.
        let mut both = CpuSet::new();
        plan.cpus.iter().for_each(|cpu| both.set(*cpu));
        sched_setaffinity(None, &both)?;
        let mut run = prepare()?;
        let mut elements = vec![0_u64; ELEMENTS];
        for round in 0..plan.warm_up + plan.rounds {
            let begin = ticks();
            run(&mut elements)?;
            let took = ticks().wrapping_sub(begin);
            if round >= plan.warm_up {
                role.log.push(0, took);
            }
        }
        black_box(&elements);
        Ok(())
    });
    perform(&shared, vec![part])?;
    let samples_ps = shared.log(0).samples(0).map(to_ps).collect();
    Ok(Batch {
        samples_ps,
        ..Batch::default()
    })
}

/// One after the other: what two workers halve at best.
pub(crate) fn sequential(plan: &BatchPlan) -> io::Result<Batch> {
    timed(plan, || {
        Ok(|elements: &mut Vec<u64>| {
            let all = elements.iter_mut().enumerate();
            all.for_each(|(index, element)| compute(element, index as u64));
            Ok(())
        })
    })
}

/// By the worker pool. Each element also gets its own seed.
pub(crate) fn tandem(plan: &BatchPlan) -> io::Result<Batch> {
    timed(plan, || {
        let work = |element: &mut u64, random: &mut Random| compute(element, random.draw());
        let mut pool = WorkerPool::new(WORKERS, ELEMENTS, Duration::from_secs(10), work)?;
        Ok(move |elements: &mut Vec<u64>| pool.run(elements, 1).map_err(io::Error::other))
    })
}

/// By rayon, with the same number of workers.
pub(crate) fn rayon(plan: &BatchPlan) -> io::Result<Batch> {
    timed(plan, || {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(WORKERS);
        let pool = pool.build().map_err(io::Error::other)?;
        Ok(move |elements: &mut Vec<u64>| {
            pool.install(|| {
                let all = elements.par_iter_mut().enumerate();
                all.for_each(|(index, element)| compute(element, index as u64));
            });
            Ok(())
        })
    })
}
