//! Tests the primitives of the LMU in hundreds of schedules: patterns of turns of three harts.
//!
//! Under icount, a timer that ends a hart's turn after a fixed number of instructions produces one
//! particular interleaving, the same in each run. Hart 6 varies the length of the turns and the
//! offset between the harts, and starts the tests of lock, mailbox, pool and channels for each. Two
//! schedules differ if the turns of a hart ended at different code addresses, or if the harts got
//! the lock in a different order.
//!
//! Strap `Mode`: 0, the tests must pass in every schedule; 1, at least one schedule must detect a
//! deliberately broken lock. Strap `First`: the number of lengths of turns.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::sync::atomic::Ordering::{Acquire, Relaxed, Release};
use core::sync::atomic::{AtomicBool, AtomicU32};
use tandem_board::SystemId;
use tandem_board_riscv32_virt::hart::{self, CARRIER};
use tandem_board_riscv32_virt::memory::{Strap, strap};
use tandem_board_riscv32_virt::{clint, doorbell, entry, exit, log, memory};
use tandem_shm::incarnation::Incarnation;
use tandem_shm::mailbox::{Ring, TaskId};
use tandem_shm::map::{Layout, Map};
use tandem_shm::newest::Reader;
use tandem_shm::pool;
use tandem_shm::region::{Fifo, Mailbox, Newest, Region, SharedLock, SharedPool, Words};

entry!(main);

/// The shortest turn, in ticks: a shorter turn ends before the handler has returned.
const SHORTEST: u32 = 8;
/// Number of lengths of turns, unless a strap sets it.
const LENGTHS: u32 = 100;
/// Offsets of harts 1 and 2, in spins; coprime, so that no two harts run in step.
const OFFSETS: [[u32; 2]; 4] = [[0, 0], [7, 0], [3, 11], [13, 5]];
/// A test that takes more ticks than this has hung: a wake-up or the lock was lost.
const HANGS_AFTER: u64 = 2_000_000;

const CORES: usize = 3;
const POOL_BLOCKS: usize = 8;
type Value = [u32; 6];

const LOCK: Region<SharedLock> = Region::first("lock");
/// Three words: the counter, a hash of the order of its owners, and the broken lock.
const COUNTER: Region<Words<3>> = LOCK.then("counter, and the order of its owners");
const MAILBOX_0_TO_1: Region<Mailbox> = COUNTER.then("mailbox 0 to 1");
const MAILBOX_2_TO_1: Region<Mailbox> = MAILBOX_0_TO_1.then("mailbox 2 to 1");
const POOL: Region<SharedPool<POOL_BLOCKS>> = MAILBOX_2_TO_1.then("pool");
const FIFO: Region<Fifo<[u32; 2], 4>> = POOL.then("queue 2 to 0");
const NEWEST: Region<Newest<Value>> = FIFO.then("newest value 1 to 0 and 2");
const LAYOUT: Layout = NEWEST.end();

/// Number of rounds of each test. A test takes several turns, so that turns end everywhere in it.
const ROUNDS: u32 = 40;

/// The current schedule: its number (0 means none yet), the length of turns, the offsets.
static SCHEDULE: AtomicU32 = AtomicU32::new(0);
static LENGTH: AtomicU32 = AtomicU32::new(0);
static OFFSET: [AtomicU32; CORES] = [const { AtomicU32::new(0) }; CORES];
/// Number of harts that have finished the tests of the schedule.
static PASSED: AtomicU32 = AtomicU32::new(0);
/// The number of a test that failed; 0 if none did.
static FAILED: AtomicU32 = AtomicU32::new(0);
/// Number of arrivals at barriers, of all harts.
static ARRIVED: AtomicU32 = AtomicU32::new(0);
/// Whether the writer of the newest value has finished.
static WRITTEN: AtomicBool = AtomicBool::new(false);

const TESTS: [&str; 5] = ["", "lock", "mailbox", "pool", "channels"];

fn main(hart: usize) -> ! {
    match hart {
        CARRIER => sweep(),
        0..CORES => player(hart),
        _ => hart::park(),
    }
}

/// The result of a check; the error is the number of the test that failed.
type Checked = Result<(), u32>;

fn check(holds: bool, test: u32) -> Checked {
    if holds { Ok(()) } else { Err(test) }
}

fn is_broken() -> bool {
    strap(Strap::Mode) == 1
}

/// Hart 6: runs all schedules, one after the other.
fn sweep() -> ! {
    hart::interrupts_on();
    let lengths = match strap(Strap::First) {
        0 => LENGTHS,
        some => some,
    };
    let (mut orders, mut places) = (Distinct::new(), Distinct::new());
    let (mut schedules, mut failed) = (0, 0);
    for length in SHORTEST..SHORTEST + lengths {
        for offsets in OFFSETS {
            schedules += 1;
            let result = play(schedules, length, offsets);
            let of_harts = [0, 1, 2].map(doorbell::take_places);
            places.insert(of_harts[0] ^ of_harts[1].rotate_left(8) ^ of_harts[2].rotate_left(16));
            match result {
                Ok(order) => orders.insert(order),
                Err(test) => {
                    failed += 1;
                    if !is_broken() {
                        let name = TESTS.get(test as usize).unwrap_or(&"a test that hangs");
                        log!("FAILED  turns of {length} ticks, offsets {offsets:?}: {name}");
                        exit::exit(1);
                    }
                }
            }
        }
    }
    log!(
        "{schedules} schedules, {} different, with {} orders of the lock; {failed} failed",
        places.count,
        orders.count
    );
    match is_broken() {
        true if failed == 0 => {
            log!("FAILED  no schedule caught the broken lock");
            exit::exit(1)
        }
        true => log!("the broken lock was caught by {failed} of {schedules} schedules"),
        false => {}
    }
    exit::exit(0)
}

/// Runs one schedule. Returns the order in which the harts got the lock, or the test that failed.
fn play(number: u32, length: u32, offsets: [u32; 2]) -> Result<u32, u32> {
    let Ok(map) = Map::format(memory::lmu(SystemId::A), LAYOUT) else {
        return Err(0);
    };
    for counter in [&PASSED, &FAILED, &ARRIVED] {
        counter.store(0, Relaxed);
    }
    WRITTEN.store(false, Relaxed);
    LENGTH.store(length, Relaxed);
    OFFSET[1].store(offsets[0], Relaxed);
    OFFSET[2].store(offsets[1], Relaxed);
    // Release pairs with the Acquire in `player`: the harts see all values above.
    SCHEDULE.store(number, Release);
    (0..CORES).for_each(clint::post);
    let limit = hart::time() + HANGS_AFTER;
    while PASSED.load(Acquire) < CORES as u32 {
        let failed = FAILED.load(Relaxed);
        if failed != 0 {
            // Gives the other harts time to stop: they may be waiting for the hart that failed.
            let limit = hart::time() + HANGS_AFTER;
            while PASSED.load(Acquire) < CORES as u32 && hart::time() < limit {
                doorbell::wait(Some(hart::time() + 100));
            }
            return Err(failed);
        }
        if hart::time() >= limit {
            log!("FAILED  turns of {length} ticks, offsets {offsets:?}: a test hangs");
            exit::exit(1);
        }
        doorbell::wait(Some(limit));
    }
    Ok(counter(&map)[1].load(Relaxed))
}

/// A set of numbers.
struct Distinct {
    seen: [u32; 1024],
    count: usize,
}

impl Distinct {
    const fn new() -> Self {
        Self {
            seen: [0; 1024],
            count: 0,
        }
    }

    fn insert(&mut self, order: u32) {
        let known = self.seen[..self.count].contains(&order);
        if !known && self.count < self.seen.len() {
            self.seen[self.count] = order;
            self.count += 1;
        }
    }
}

/// Harts 0 to 2: run each schedule when hart 6 has set it.
fn player(hart: usize) -> ! {
    hart::interrupts_on();
    let mut number = 0;
    loop {
        while SCHEDULE.load(Acquire) == number {
            doorbell::wait(None);
        }
        number = SCHEDULE.load(Acquire);
        for _ in 0..OFFSET[hart].load(Relaxed) {
            core::hint::spin_loop();
        }
        doorbell::set_slice(LENGTH.load(Relaxed) + hart as u32);
        match all_tests(hart, number) {
            Ok(()) => {}
            // Another hart has failed.
            Err(0) => {}
            Err(test) => FAILED.store(test, Relaxed),
        }
        doorbell::set_slice(0);
        PASSED.fetch_add(1, Release);
        clint::post(CARRIER);
    }
}

/// Waits at barrier number `time` (from 1) for the other harts; `Err` if one of them has failed.
fn meet(time: u32) -> Checked {
    ARRIVED.fetch_add(1, Release);
    until(|| ARRIVED.load(Acquire) >= time * CORES as u32)
}

/// Spins until `holds` returns true; the timer ends its turns. `Err` if another hart has failed.
fn until(mut holds: impl FnMut() -> bool) -> Checked {
    while !holds() {
        check(FAILED.load(Relaxed) == 0, 0)?;
    }
    Ok(())
}

fn all_tests(hart: usize, generation: u32) -> Checked {
    let map = Map::attach(memory::lmu(SystemId::A), LAYOUT).map_err(|_| 1u32)?;
    let incarnation = Incarnation::new(hart, generation).ok_or(1u32)?;
    map.incarnations().announce(incarnation).map_err(|_| 1u32)?;
    meet(1)?;
    if is_broken() {
        return test_broken_lock(&map, hart);
    }
    test_lock(&map, hart, incarnation)?;
    meet(2)?;
    check(counter(&map)[0].load(Relaxed) == CORES as u32 * ROUNDS, 1)?;
    test_mailbox(&map, hart, incarnation)?;
    meet(3)?;
    test_pool(&map, hart, incarnation)?;
    meet(5)?;
    test_channels(&map, hart, incarnation)
}

/// Returns the words of the counter.
fn counter(map: &Map<'static>) -> &'static [AtomicU32] {
    match COUNTER.attach(map) {
        Ok(words) => words,
        Err(_) => panic!("the counter is of the layout"),
    }
}

/// Increments by a read and a write: if another hart runs in between, an increment is lost.
fn count(map: &Map<'static>, hart: usize) {
    let [counter, order] = [0, 1].map(|index: usize| &counter(map)[index]);
    let (count, hash) = (counter.load(Relaxed), order.load(Relaxed));
    (0..4).for_each(|_| core::hint::spin_loop());
    counter.store(count + 1, Relaxed);
    // FNV-1a over the owners, in their order.
    let hash = if hash == 0 { 0x811C_9DC5 } else { hash };
    order.store((hash ^ hart as u32).wrapping_mul(0x0100_0193), Relaxed);
}

/// T-LOCK-1: no increment is lost.
fn test_lock(map: &Map<'static>, hart: usize, incarnation: Incarnation) -> Checked {
    let mut lock = LOCK.attach(map, incarnation).map_err(|_| 1u32)?;
    for _ in 0..ROUNDS {
        let acquired = lock
            .lock(1_000_000, tandem_shm::sync::spin)
            .map_err(|_| 1u32)?;
        check(!acquired.is_recovered(), 1)?;
        let guard = acquired.into_guard();
        count(map, hart);
        drop(guard);
    }
    Ok(())
}

/// As `test_lock`, with a lock that tests and takes in two steps: the schedules must detect that.
fn test_broken_lock(map: &Map<'static>, hart: usize) -> Checked {
    let word = &counter(map)[2];
    for _ in 0..ROUNDS {
        until(|| word.load(Acquire) == 0)?;
        word.store(1, Relaxed);
        count(map, hart);
        word.store(0, Release);
    }
    meet(2)?;
    let counted = counter(map)[0].load(Relaxed);
    check(counted == CORES as u32 * ROUNDS, 1)
}

/// T-SYNC-3: harts 0 and 2 signal hart 1, which sleeps as often as it can; every signal arrives.
fn test_mailbox(map: &Map<'static>, hart: usize, own: Incarnation) -> Checked {
    let task = |number| TaskId::new(number).ok_or(2u32);
    if hart != 1 {
        let mailbox = [MAILBOX_0_TO_1, MAILBOX_2_TO_1][hart / 2];
        let mut to = mailbox.sender(map, own).map_err(|_| 2u32)?;
        clint::post(1);
        for round in 0..ROUNDS {
            if to.signal(task(1 + (round % 3) as u8)?) == Ring::Needed {
                clint::post(1);
            }
        }
        return Ok(());
    }
    let mut receivers =
        [MAILBOX_0_TO_1, MAILBOX_2_TO_1].map(|mailbox| mailbox.receiver(map, own).ok());
    let mut signals = [0; 2];
    while signals != [ROUNDS; 2] {
        check(FAILED.load(Relaxed) == 0, 0)?;
        let mut asleep = true;
        for (receiver, signals) in receivers.iter_mut().zip(&mut signals) {
            let receiver = receiver.as_mut().ok_or(2u32)?;
            *signals += receiver.poll(|_| ());
            check(*signals <= ROUNDS, 2)?;
            asleep &= receiver.prepare_sleep();
        }
        if asleep && signals != [ROUNDS; 2] {
            doorbell::wait(None);
        }
        for receiver in receivers.iter_mut().flatten() {
            receiver.awake();
        }
    }
    Ok(())
}

/// T-SHM-1: no hart gets words that another hart owns, and all words are given back.
fn test_pool(map: &Map<'static>, hart: usize, incarnation: Incarnation) -> Checked {
    let pool = POOL.attach(map, incarnation).map_err(|_| 3u32)?;
    for round in 0..ROUNDS {
        let words = 1 + (round as usize * 7 + hart * 5) % 40;
        let Ok(handle) = pool.get(words) else {
            // The other two harts may own the remaining words.
            continue;
        };
        let mine = pool.open(handle).map_err(|_| 3u32)?;
        let mark = 1 + hart as u32 + round * 4;
        mine.iter().for_each(|word| word.store(mark, Relaxed));
        let whole = mine.iter().all(|word| word.load(Relaxed) == mark);
        check(whole, 3)?;
        pool.give_back(handle).map_err(|_| 3u32)?;
        check(pool.give_back(handle).is_err(), 3)?;
    }
    // All harts have given back their words before any hart counts.
    meet(4)?;
    check(pool.free_words() == POOL_BLOCKS * pool::BLOCK_WORDS, 3)?;
    Ok(())
}

/// T-CHAN-1..3: a queue from hart 2 to 0 keeps the order; hart 1's newest values stay whole.
fn test_channels(map: &Map<'static>, hart: usize, own: Incarnation) -> Checked {
    let mut reader = NEWEST.reader(map).map_err(|_| 4u32)?;
    match hart {
        0 => {
            let mut queue = FIFO.consumer(map, own).map_err(|_| 4u32)?;
            let mut last = 0;
            for number in 0..ROUNDS {
                let mut item = None;
                until(|| {
                    item = queue.receive().ok().flatten();
                    item.is_some()
                })?;
                check(item == Some([number, !number]), 4)?;
                read_newest(&mut reader, &mut last)?;
            }
            follow_newest(&mut reader, last)
        }
        1 => {
            let mut writer = NEWEST.writer(map, own).map_err(|_| 4u32)?;
            for number in 1..=2 * ROUNDS {
                writer.publish(&value(number));
            }
            WRITTEN.store(true, Release);
            Ok(())
        }
        _ => {
            let mut queue = FIFO.producer(map, own).map_err(|_| 4u32)?;
            let mut last = 0;
            for number in 0..ROUNDS {
                until(|| queue.send(&[number, !number]).is_ok())?;
                read_newest(&mut reader, &mut last)?;
            }
            follow_newest(&mut reader, last)
        }
    }
}

/// Reads the newest value, if there is one. Checks that it is whole and not older than `last`.
fn read_newest(reader: &mut Reader<'_, Value>, last: &mut u32) -> Checked {
    if let Ok((_, read)) = reader.read() {
        let number = read[0] >> 8;
        check(read == value(number) && number >= *last, 4)?;
        *last = number;
    }
    Ok(())
}

fn value(number: u32) -> Value {
    core::array::from_fn(|index| number << 8 | index as u32)
}

/// Reads until the last value has been read.
fn follow_newest(reader: &mut Reader<'_, Value>, mut last: u32) -> Checked {
    let mut result = Ok(());
    until(|| {
        let written = WRITTEN.load(Acquire);
        result = read_newest(reader, &mut last);
        result.is_err() || (written && last == 2 * ROUNDS)
    })?;
    result
}
