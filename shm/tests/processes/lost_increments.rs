//! Three processes increment a counter: without the lock some increments are lost. T-LOCK-2

use crate::child::{Child, announce, give_way, meet, shared, take};
use tandem_shm::bare;
use tandem_shm::incarnation::Incarnations;
use tandem_shm::lock::{self, Lock};
use tandem_shm::sync::{AtomicU32, Ordering};

/// All tests, with their names.
pub(crate) const TESTS: [(&str, fn()); 2] = [
    (
        "without_the_lock_increments_are_lost",
        without_the_lock_increments_are_lost,
    ),
    ("with_the_lock_none_is_lost", with_the_lock_none_is_lost),
];

const CORES: u32 = 3;
/// Number of increments of each process.
const INCREMENTS: u32 = 20_000;
/// After this many increments the process yields its CPU between load and store, so that the
/// control group loses increments on a single CPU, too.
const GIVE_WAY_EVERY: u32 = 64;

const LIVES_AT: usize = 0;
const LOCK_AT: usize = LIVES_AT + Incarnations::WORDS;
const COUNTER_AT: usize = LOCK_AT + lock::WORDS;
const START_AT: usize = COUNTER_AT + 16;
const WORDS: usize = START_AT + 16;

/// Increments the counter by a load and a store, sometimes with a pause between them.
fn increment(counter: &AtomicU32, i: u32) {
    let value = counter.load(Ordering::Relaxed);
    if i.is_multiple_of(GIVE_WAY_EVERY) {
        give_way();
    }
    counter.store(value + 1, Ordering::Relaxed);
}

/// Runs `work` [`INCREMENTS`] times in each of three processes. Returns the counter.
fn count(work: impl Fn(&'static [AtomicU32], &mut Lock<'static>, u32) + Copy) -> u32 {
    let words = shared(WORDS);
    let children: Vec<_> = (0..CORES as usize)
        .map(|core| {
            Child::start(move || {
                let incarnations = Incarnations::attach(words).unwrap();
                let incarnation = announce(incarnations, core, 1);
                let mut lock = bare::lock(&words[LOCK_AT..], incarnation, incarnations).unwrap();
                meet(&words[START_AT], CORES);
                for i in 0..INCREMENTS {
                    work(words, &mut lock, i);
                }
            })
        })
        .collect();
    children.into_iter().for_each(Child::join);
    words[COUNTER_AT].load(Ordering::Relaxed)
}

/// T-LOCK-2: the control group. Lost increments are likely, not certain, so it has 50 tries.
fn without_the_lock_increments_are_lost() {
    let lost =
        (0..50).any(|_| count(|words, _, i| increment(&words[COUNTER_AT], i)) < CORES * INCREMENTS);
    assert!(lost, "the test cannot show what the lock is for");
}

/// T-LOCK-2: with the lock no increment is lost.
fn with_the_lock_none_is_lost() {
    let counted = count(|words, lock, i| {
        let acquired = take(lock);
        assert!(!acquired.is_recovered(), "no core died");
        increment(&words[COUNTER_AT], i);
    });
    assert_eq!(counted, CORES * INCREMENTS);
}
