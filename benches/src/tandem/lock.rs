//! The lock: free, contended, and after the death of its owner.

use crate::floor::CHUNK;
use crate::harness::{Batch, BatchPlan, give_way, repeated};
use crate::mutual_exclusion::{Exclusion, contended, recovered};
use crate::shared::{SharedPage, announce};
use std::hint::black_box;
use std::io;
use tandem_shm::incarnation::Incarnation;
use tandem_shm::lock::Lock;
use tandem_shm::map::{Layout, Map};
use tandem_shm::region::{Region, SharedLock};
use tandem_shm::sync::spin;

const LOCK: Region<SharedLock> = Region::first("lock");
const LAYOUT: Layout = LOCK.end();

fn attach(map: &Map<'static>, core: usize, generation: u32) -> Lock<'static> {
    let incarnation = announce(map, core, generation);
    LOCK.attach(map, incarnation).expect("it fits")
}

/// Locks and unlocks a lock that no other core uses.
pub(crate) fn free(plan: &BatchPlan) -> io::Result<Batch> {
    let (shared, map) = SharedPage::with_lmu(LAYOUT)?;
    repeated(plan, &shared, CHUNK, || {
        let mut lock = attach(&map, 0, 1);
        move || {
            black_box(lock.try_lock().is_some());
        }
    })
}

/// The lock of one core. On a shared CPU it yields after it has waited for a while.
struct Contender {
    lock: Lock<'static>,
    shares_cpu: bool,
}

impl Exclusion for Contender {
    fn inside(&mut self, stay: impl FnOnce()) {
        let shares_cpu = self.shares_cpu;
        let relax = |pause| {
            spin(pause);
            if shares_cpu && pause >= 16 {
                give_way();
            }
        };
        let guard = self.lock.lock(u32::MAX, relax);
        stay();
        drop(guard);
    }
}

/// `processes` cores contend for the lock all the time.
pub(crate) fn under_contention(plan: &BatchPlan, processes: usize) -> io::Result<Batch> {
    let (shared, map) = SharedPage::with_lmu(LAYOUT)?;
    contended(plan, &shared, processes, |core| Contender {
        lock: attach(&map, core, 1),
        shares_cpu: processes > 2,
    })
}

const OWNER: usize = 0;

/// An owner takes the lock and is killed; the supervisor, which has seen it end, marks its
/// incarnation as dead; a core that waits on another CPU then gets the lock.
pub(crate) fn recovery(plan: &BatchPlan) -> io::Result<Batch> {
    let (shared, map) = SharedPage::with_lmu(LAYOUT)?;
    let own = |generation| Contender {
        lock: attach(&map, OWNER, generation),
        shares_cpu: false,
    };
    let bury = |generation| {
        let dead = Incarnation::new(OWNER, generation).expect("an incarnation");
        map.incarnations().mark_dead(dead);
    };
    recovered(plan, &shared, own, bury, || {
        let mut lock = attach(&map, 1, 1);
        move || {
            let acquired = lock.lock(u32::MAX, spin);
            acquired.is_ok_and(|acquired| acquired.is_recovered())
        }
    })
}
