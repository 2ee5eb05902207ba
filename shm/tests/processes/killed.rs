//! Processes are killed and frozen at random times while they use the primitives in the LMU.

use crate::child::{Child, announce, give_way, shared, sleep_us, take};
use tandem_shm::bare;
use tandem_shm::fifo::Consumer;
use tandem_shm::incarnation::{Incarnation, Incarnations};
use tandem_shm::lock::{self, Acquired};
use tandem_shm::newest::{ReadError, Reader};
use tandem_shm::sync::{AtomicU32, Ordering};
use tandem_shm::{LINE_WORDS, Shape, fifo, newest};

/// All tests, with their names.
pub(crate) const TESTS: [(&str, fn()); 4] = [
    (
        "a_lock_whose_owner_is_killed_is_recovered",
        a_lock_whose_owner_is_killed_is_recovered,
    ),
    (
        "a_thawed_owner_does_not_release_anothers_lock",
        a_thawed_owner_does_not_release_anothers_lock,
    ),
    (
        "a_channel_whose_writer_is_killed_shows_no_torn_value",
        a_channel_whose_writer_is_killed_shows_no_torn_value,
    ),
    (
        "a_queue_whose_ends_are_killed_loses_nothing",
        a_queue_whose_ends_are_killed_loses_nothing,
    ),
];

const CORES: usize = 3;

/// Returns number `i` of a pseudo-random sequence, which is the same in each run.
fn scatter(i: u64, below: u64) -> u64 {
    ((i + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 33) % below
}

const LOCK_AT: usize = Incarnations::WORDS;
const GUARDED_AT: usize = LOCK_AT + lock::WORDS;
/// The core that is inside, plus 1; 0 if none is.
const INSIDE: usize = GUARDED_AT;
/// Two numbers that are equal while no core is inside.
const PAIR: [usize; 2] = [GUARDED_AT + 1, GUARDED_AT + 2];
const RECOVERIES: usize = GUARDED_AT + 3;
const STOP: usize = GUARDED_AT + LINE_WORDS;
/// For each core, the number of times it was inside.
const PROGRESS: usize = STOP + 1;
const WORDS: usize = STOP + LINE_WORDS;

/// Checks that the core is alone inside and that the pair is equal, and increments both numbers.
fn stay_inside(words: &[AtomicU32], core: usize, acquired: Acquired<'_, '_>) {
    let [a, b] = PAIR.map(|at| &words[at]);
    let add = |word: &AtomicU32| word.store(word.load(Ordering::Relaxed) + 1, Ordering::Relaxed);
    if acquired.is_recovered() {
        b.store(a.load(Ordering::Relaxed), Ordering::Relaxed);
        add(&words[RECOVERIES]);
    } else {
        assert_eq!(words[INSIDE].load(Ordering::Relaxed), 0, "two are inside");
    }
    words[INSIDE].store(core as u32 + 1, Ordering::Relaxed);
    add(a);
    if a.load(Ordering::Relaxed).is_multiple_of(8) {
        give_way();
    }
    add(b);
    assert_eq!(a.load(Ordering::Relaxed), b.load(Ordering::Relaxed));
    assert_eq!(
        words[INSIDE].swap(0, Ordering::Relaxed),
        core as u32 + 1,
        "two were inside"
    );
    words[PROGRESS + core].fetch_add(1, Ordering::Relaxed);
}

fn start_core(words: &'static [AtomicU32], core: usize, generation: u32) -> Child {
    Child::start(move || {
        let incarnations = Incarnations::attach(words).unwrap();
        let mut lock = bare::lock(
            &words[LOCK_AT..],
            announce(incarnations, core, generation),
            incarnations,
        )
        .unwrap();
        while words[STOP].load(Ordering::Relaxed) == 0 {
            stay_inside(words, core, take(&mut lock));
        }
    })
}

/// T-LOCK-3: three processes use the lock while one after the other is killed (-9) and replaced. At
/// most one is inside, a half-done change is always reported, and all of them continue.
fn a_lock_whose_owner_is_killed_is_recovered() {
    const KILLS: u64 = 120;
    let words = shared(WORDS);
    let incarnations = Incarnations::attach(words).unwrap();
    let mut generations = [1; CORES];
    let mut children: Vec<_> = (0..CORES)
        .map(|core| Some(start_core(words, core, 1)))
        .collect();
    for i in 0..KILLS {
        sleep_us(200 + scatter(i, 3_000));
        let core = scatter(i, CORES as u64) as usize;
        if let Some(child) = children[core].take() {
            child.kill();
        }
        // The supervisor marks every second death; only the successor's announcement shows the
        // others.
        if i.is_multiple_of(2) {
            incarnations.mark_dead(Incarnation::new(core, generations[core]).unwrap());
        }
        generations[core] += 1;
        children[core] = Some(start_core(words, core, generations[core]));
    }
    let progress = |core: usize| words[PROGRESS + core].load(Ordering::Relaxed);
    let before = [0, 1, 2].map(progress);
    while (0..CORES).any(|core| progress(core) == before[core]) {
        sleep_us(1_000);
        assert!(
            children.iter().flatten().all(Child::is_running),
            "a core failed"
        );
    }
    words[STOP].store(1, Ordering::Relaxed);
    children.into_iter().flatten().for_each(Child::join);
    let [a, b] = PAIR.map(|at| words[at].load(Ordering::Relaxed));
    assert_eq!(a, b);
    assert!(
        words[RECOVERIES].load(Ordering::Relaxed) > 0,
        "no kill ever hit an owner"
    );
}

/// T-LOCK-3: an owner that is frozen (SIGSTOP), declared dead, replaced, and thawed does not
/// release the lock of its successor.
fn a_thawed_owner_does_not_release_anothers_lock() {
    let words = shared(WORDS);
    let incarnations = Incarnations::attach(words).unwrap();
    let frozen = Child::start(move || {
        let incarnations = Incarnations::attach(words).unwrap();
        let mut lock = bare::lock(
            &words[LOCK_AT..],
            announce(incarnations, 0, 1),
            incarnations,
        )
        .unwrap();
        let guard = take(&mut lock);
        // SAFETY: sends a signal to this process itself.
        unsafe { libc::raise(libc::SIGSTOP) };
        drop(guard);
    });
    frozen.wait_stopped();
    assert!(incarnations.mark_dead(Incarnation::new(0, 1).unwrap()));
    let [mut one, mut two] = [1, 2].map(|core| {
        bare::lock(
            &words[LOCK_AT..],
            announce(incarnations, core, 1),
            incarnations,
        )
        .unwrap()
    });
    let guard = one.try_lock().unwrap();
    assert!(guard.is_recovered());
    frozen.signal(libc::SIGCONT);
    frozen.join();
    assert!(two.try_lock().is_none(), "the lock is still held");
    drop(guard);
    assert!(!two.try_lock().unwrap().is_recovered());
}

/// The writer is killed (-9) and replaced again and again; a reader gets whole values only, and
/// never an older one after a newer one.
fn a_channel_whose_writer_is_killed_shows_no_torn_value() {
    const SHAPE: Shape = Shape::new(4, 64);
    let words = shared(newest::words(SHAPE));
    let start = || {
        Child::start(move || {
            let mut writer = bare::newest_writer(words, SHAPE).unwrap();
            let reader: Reader<'_, [u32; 64], 0> = bare::newest_reader(words, SHAPE).unwrap();
            let last = reader.read().map_or(0, |(_, value)| value[0]);
            for k in last + 1.. {
                writer.publish(&[k; 64]);
            }
        })
    };
    let reader: Reader<'_, [u32; 64], 0> = bare::newest_reader(words, SHAPE).unwrap();
    let mut last = 0;
    let mut seen = 0;
    for i in 0..60 {
        let writer = start();
        for _ in 0..scatter(i, 2_000) {
            let read = reader.read_by(|words| {
                let first = words.get(0);
                words.iter().all(|word| word == first).then_some(first)
            });
            match read {
                Ok((_, value)) => {
                    let value = value.unwrap_or_else(|| panic!("a torn value"));
                    assert!(value >= last, "{value} after {last}");
                    seen += u32::from(value > last);
                    last = value;
                }
                Err(ReadError::Empty) => assert_eq!(last, 0),
                Err(_) => give_way(),
            }
        }
        while last == 0 && reader.newest().is_none() {
            give_way();
        }
        writer.kill();
        let whole = reader.read_by(|words| words.iter().all(|word| word == words.get(0)));
        assert!(whole.unwrap().1, "what a killed writer leaves is whole");
    }
    assert!(seen > 0);
}

/// Producer and consumer are killed (-9) in random order. No value is lost or out of order, and
/// only a value that a killed consumer had not released is received twice.
fn a_queue_whose_ends_are_killed_loses_nothing() {
    const SHAPE: Shape = Shape::new(8, 4);
    /// The word after the queue: the last value that was received.
    const LAST_AT: usize = fifo::words(SHAPE);
    let words = shared(LAST_AT + 2);
    let produce = || {
        Child::start(move || {
            let mut producer = bare::fifo_producer(words, SHAPE).unwrap();
            for k in producer.sent() + 1.. {
                while producer.send(&[k; 4]).is_err() {
                    give_way();
                }
            }
        })
    };
    let consume = || {
        Child::start(move || {
            let mut consumer: Consumer<'_, [u32; 4]> = bare::fifo_consumer(words, SHAPE).unwrap();
            loop {
                let Some(item) = consumer.item() else {
                    give_way();
                    continue;
                };
                let value = item.words().get(0);
                assert!(item.words().iter().all(|word| word == value));
                let last = words[LAST_AT].load(Ordering::Relaxed);
                assert!(value == last || value == last + 1, "{value} after {last}");
                words[LAST_AT].store(value, Ordering::Relaxed);
                item.release();
            }
        })
    };
    let start = |end| if end == 0 { produce() } else { consume() };
    let mut ends = [0, 1].map(|end| Some(start(end)));
    let all_running = |ends: &[Option<Child>; 2]| ends.iter().flatten().all(Child::is_running);
    for i in 0..60 {
        sleep_us(200 + scatter(i, 2_000));
        assert!(all_running(&ends), "an end failed");
        let end = scatter(i, 2) as usize;
        // The first assignment kills the predecessor and waits for its end.
        ends[end] = None;
        ends[end] = Some(start(end));
    }
    let last = words[LAST_AT].load(Ordering::Relaxed);
    while words[LAST_AT].load(Ordering::Relaxed) == last {
        assert!(all_running(&ends), "an end failed");
        give_way();
    }
}
