//! Cores 0 and 1 in Rust; core 2 is a separate image in C (see c/main.c), linked with the static
//! library of `tandem-capi`. They share only the LMU.
//!
//! Core 0 requests the steps and checks the results; core 1 sends work. The program prints a line
//! for each step; its status is 0 if all checks passed.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::sync::atomic::{AtomicU32, Ordering};
use tandem_board::SystemId;
use tandem_board_riscv32_virt::{
    clint, doorbell, entry, exit, hart, log, memory, must, task, trap,
};
use tandem_shm::incarnation::Incarnation;
use tandem_shm::lock::Lock;
use tandem_shm::mailbox::{Receiver, Ring, Sender, TaskId};
use tandem_shm::map::{Layout, Map};
use tandem_shm::region::{Fifo, Mailbox, Newest, Region, SharedLock, Words};

entry!(main);

// These regions must be the same as in c/main.c.
const TO_2: Region<Mailbox> = Region::first("mailbox 0 to 2");
const FROM_2: Region<Mailbox> = TO_2.then("mailbox 2 to 0");
const ONE_TO_2: Region<Mailbox> = FROM_2.then("mailbox 1 to 2");
const LOCK: Region<SharedLock> = ONE_TO_2.then("lock");
const GUARDED: Region<Words<2>> = LOCK.then("guarded");
const WORK_1_TO_2: Region<Fifo<[u32; 16], 4>> = GUARDED.then("work 1 to 2");
const RESULT_OF_2: Region<Newest<[u32; 2]>> = WORK_1_TO_2.then("result of 2");
const LAYOUT: Layout = RESULT_OF_2.end();

/// The number of the core in C, and of its hart.
const IN_C: usize = 2;
/// The tasks of the core in C.
const PING: TaskId = task(1);
const COUNT: TaskId = task(2);
const DIE: TaskId = task(3);
const LEAD: TaskId = task(4);
const WORK_THERE: TaskId = task(1);

const PINGS: u32 = 1_000;
/// Number of rounds before the first round whose instructions are counted.
const WARM_UP: u32 = 5;
const TURNS: u32 = 300;
const ITEMS: u32 = 500;
/// Limit of each step, in ticks of 100 ns: 0.2 s, longer than any step takes. If the harts only
/// spin, it takes a few seconds of real time.
const PATIENCE: u64 = 2_000_000;

/// The part that core 0 has requested from core 1; 0 when core 1 has finished.
static STEP: AtomicU32 = AtomicU32::new(0);
const SEND: u32 = 1;
const CONTEND: u32 = 2;

fn incarnation(core: usize, generation: u32) -> Incarnation {
    match Incarnation::new(core, generation) {
        Some(incarnation) => incarnation,
        None => panic!("the incarnation exists"),
    }
}

fn main(hart: usize) -> ! {
    let lmu = memory::lmu(SystemId::A);
    if hart == 0 {
        trap::on_doorbell(|| ());
        hart::interrupts_on();
        let map = must(Map::format(lmu, LAYOUT));
        must(map.incarnations().announce(incarnation(0, 1)));
        ask(map);
        exit::exit(0);
    }
    let map = wait_for("core 0 formats", || Map::attach(lmu, LAYOUT).ok());
    must(map.incarnations().announce(incarnation(1, 1)));
    help(map);
    hart::park()
}

/// Polls until there is a result. Between polls, yields the turn to the other harts.
#[track_caller]
fn wait_for<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let limit = hart::time() + PATIENCE;
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(hart::time() < limit, "{what}: it does not happen");
        hart::yield_turn();
    }
}

/// Both ends of the connection with the core in C.
struct Talk {
    to: Sender<'static>,
    from: Receiver<'static>,
}

impl Talk {
    fn order(&mut self, task: TaskId, value: u32) {
        if self.to.signal_with(task, value) == Ring::Needed {
            clint::post(IN_C);
        }
    }

    /// Returns the value of the next answer. Sleeps until it arrives.
    fn answer(&mut self) -> u32 {
        let limit = hart::time() + PATIENCE;
        let mut value = None;
        loop {
            self.from.poll(|signals| value = Some(signals.value));
            if let Some(value) = value {
                return value;
            }
            assert!(hart::time() < limit, "the core in C does not answer");
            if self.from.prepare_sleep() {
                doorbell::wait(Some(limit));
                self.from.awake();
            }
        }
    }
}

fn ask(map: Map<'static>) {
    let mut talk = Talk {
        to: must(TO_2.sender(&map, incarnation(0, 1))),
        from: must(FROM_2.receiver(&map, incarnation(0, 1))),
    };
    let incarnations = map.incarnations();
    wait_for("the core in C announces itself", || {
        incarnations.current(IN_C)
    });

    let (mut least, mut most) = (u32::MAX, 0);
    for value in 0..PINGS {
        let begin = hart::cycles();
        talk.order(PING, value);
        let answer = talk.answer();
        let took = hart::cycles().wrapping_sub(begin);
        assert_eq!(answer, value * 2 + 1, "the answer to {value}");
        if value >= WARM_UP {
            (least, most) = (least.min(took), most.max(took));
        }
    }
    log!("signals       {PINGS} there and back with a value, {least} to {most} instructions each");

    take_results(map);
    log!("fifo, newest  {ITEMS} items of 16 words from Rust summed up in C, in place");

    let mut own = must(LOCK.attach(&map, incarnation(0, 1)));
    talk.order(COUNT, TURNS);
    STEP.store(CONTEND, Ordering::Release);
    count(&mut own, map);
    assert_eq!(talk.answer(), TURNS, "C had its turns");
    wait_for("core 1 has its turns", || {
        (STEP.load(Ordering::Acquire) == 0).then_some(())
    });
    assert_eq!(guarded(map), [3 * TURNS; 2], "no turn is lost");
    log!("lock          {TURNS} turns of each of two cores in Rust and one in C");

    talk.order(DIE, 0);
    assert_eq!(
        talk.answer(),
        3 * TURNS + 1,
        "C is in the middle of a change"
    );
    assert!(
        own.lock(50, |_| hart::yield_turn()).is_err(),
        "it holds the lock"
    );
    assert!(
        incarnations.mark_dead(incarnation(IN_C, 1)),
        "it is in its first incarnation"
    );
    let taken = must(own.lock(50, |_| hart::yield_turn()));
    assert!(taken.is_recovered(), "core 0 learns that the owner died");
    assert_eq!(guarded(map), [3 * TURNS + 1, 3 * TURNS], "half-changed");
    must(GUARDED.attach(&map))[1].store(3 * TURNS + 1, Ordering::Relaxed);
    drop(taken);
    log!("recovery      C died with the lock, Rust learned of it and repaired");

    clint::post(IN_C);
    let second = || {
        incarnations
            .current(IN_C)
            .filter(|incarnation| incarnation.generation() == 2)
    };
    wait_for("the core in C begins its second incarnation", second);
    talk.order(PING, 7);
    assert_eq!(talk.answer(), 15, "the second incarnation answers");
    talk.order(COUNT, 1);
    assert_eq!(talk.answer(), 1, "and takes the lock");
    log!("second incarnation   C attached where its first incarnation had stopped");

    talk.order(LEAD, 10_000);
    let after_ms = talk.answer();
    log!("redundancy    a system B in C leads alone after {after_ms} ms");
}

/// Returns the two guarded words, which are equal while the lock is free.
fn guarded(map: Map<'static>) -> [u32; 2] {
    [0, 1].map(|at: usize| must(GUARDED.attach(&map))[at].load(Ordering::Relaxed))
}

fn count(lock: &mut Lock<'static>, map: Map<'static>) {
    for _ in 0..TURNS {
        let taken = must(lock.lock(100_000, |_| hart::yield_turn()));
        assert!(!taken.is_recovered(), "no core died");
        let [one, two] = guarded(map);
        assert_eq!(one, two, "the lock excludes");
        let words = must(GUARDED.attach(&map));
        words[0].store(one + 1, Ordering::Relaxed);
        hart::yield_turn();
        words[1].store(one + 1, Ordering::Relaxed);
        drop(taken);
    }
}

/// Returns the sum of an item's words.
fn sum(item: u32) -> u32 {
    (0..16).map(|at| word(item, at)).fold(0, u32::wrapping_add)
}

fn word(item: u32, at: u32) -> u32 {
    (item * 16 + at).wrapping_mul(0x9E37_79B1)
}

/// Reads the results. Checks that the newest one is never torn, and that the last one arrives.
fn take_results(map: Map<'static>) {
    let reader = must(RESULT_OF_2.reader(&map));
    STEP.store(SEND, Ordering::Release);
    let mut last = 0;
    wait_for("the last result arrives", || {
        if let Ok((_, [summed, done])) = reader.read() {
            assert!(done >= last, "results do not go back");
            assert_eq!(summed, sum(done - 1), "result {done} is whole and right");
            last = done;
        }
        (last == ITEMS).then_some(())
    });
}

/// Core 1: runs each part when core 0 requests it.
fn help(map: Map<'static>) {
    let mut to = must(ONE_TO_2.sender(&map, incarnation(1, 1)));
    let mut producer = must(WORK_1_TO_2.producer(&map, incarnation(1, 1)));
    let step = |number: u32| (STEP.load(Ordering::Acquire) == number).then_some(());
    wait_for("core 0 requests work", || step(SEND));
    for item in 0..ITEMS {
        wait_for("C works off the queue", || {
            producer
                .send(&core::array::from_fn(|at| word(item, at as u32)))
                .ok()
        });
        if to.signal(WORK_THERE) == Ring::Needed {
            clint::post(IN_C);
        }
    }
    let mut lock = must(LOCK.attach(&map, incarnation(1, 1)));
    wait_for("core 0 requests contention for the lock", || step(CONTEND));
    count(&mut lock, map);
    STEP.store(0, Ordering::Release);
}
