//! The pool: borrowing and giving back 16 words, a cache line.

use crate::floor::cas::CHUNK;
use crate::harness::{Batch, Plan, alone, time_chunks};
use crate::shared::Shared;
use crate::worker::{Part, perform};
use std::hint::black_box;
use std::io;
use tandem_shm::incarnation::{Incarnation, Incarnations};
use tandem_shm::pool::{self, Pool};

const BLOCKS: usize = 64;
const POOL_AT: usize = Incarnations::WORDS;
const OWN_BYTES: u64 = 4 * (POOL_AT + pool::words(BLOCKS)) as u64;
const WORDS: usize = 16;

fn attach(shared: &Shared, core: usize) -> Pool<'static> {
    let words = shared.case();
    let incarnations = Incarnations::attach(words).expect("it fits");
    let incarnation = Incarnation::new(core, 1).expect("an incarnation");
    incarnations
        .announce(incarnation)
        .expect("the first incarnation");
    Pool::attach(&words[POOL_AT..], BLOCKS, incarnation, incarnations).expect("it fits")
}

fn take_and_give(pool: &mut Pool<'_>) {
    if let Ok(handle) = pool.get(WORDS) {
        black_box(handle);
        let _ = pool.give_back(handle);
    }
}

/// By one core.
///
/// # Errors
/// As [`alone`].
pub fn take_give(plan: &Plan) -> io::Result<Batch> {
    let prepare = |shared: &Shared| Ok(attach(shared, 0));
    let batch = alone(plan, CHUNK, OWN_BYTES, prepare, take_and_give)?;
    Ok(batch.carrying(4 * WORDS as u64))
}

/// By two cores at once, each on a CPU of its own.
///
/// # Errors
/// If the processes or the shared memory cannot be had, or an end failed.
pub fn take_give_by_two(plan: &Plan) -> io::Result<Batch> {
    let shared = Shared::new()?;
    let part = |core: usize| {
        Part::on(plan.cpus[core], move |role| {
            let mut pool = attach(role.shared, core);
            role.shared.meet(2);
            time_chunks(plan, CHUNK, role, || take_and_give(&mut pool));
            Ok(())
        })
    };
    perform(&shared, vec![part(0), part(1)])?;
    let batch = Batch::collect(&shared, 2, 2 * plan.rounds, OWN_BYTES);
    Ok(batch.per_operation(CHUNK).carrying(4 * WORDS as u64))
}
