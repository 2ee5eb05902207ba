//! The pool: borrowing and giving back 16 words, a cache line.

use super::lmu;
use crate::floor::cas::CHUNK;
use crate::harness::{Batch, Plan, time_chunks};
use crate::worker::{Part, perform};
use std::hint::black_box;
use std::io;
use tandem_shm::map::Layout;
use tandem_shm::region::{Region, SharedPool};

const POOL: Region<SharedPool<64>> = Region::first("pool");
const LAYOUT: Layout = POOL.end();
const WORDS: usize = 16;

/// By this many cores at once, each on a CPU of its own.
///
/// # Errors
/// If the processes or the shared memory cannot be had, or an end failed.
pub fn take_give(plan: &Plan, cores: usize) -> io::Result<Batch> {
    let (shared, map) = lmu::shared(LAYOUT)?;
    let part = |core: usize| {
        Part::on(plan.cpus[core], move |role| {
            let pool = POOL.attach(&map, lmu::announce(&map, core, 1));
            let pool = pool.expect("it fits");
            role.shared.meet(cores as u32);
            time_chunks(plan, CHUNK, role, || {
                if let Ok(handle) = pool.get(WORDS) {
                    black_box(handle);
                    let _ = pool.give_back(handle);
                }
            });
            Ok(())
        })
    };
    perform(&shared, (0..cores).map(part).collect())?;
    let batch = Batch::collect(&shared, cores, cores * plan.rounds, lmu::bytes(LAYOUT));
    Ok(batch.per_operation(CHUNK).carrying(4 * WORDS as u64))
}
