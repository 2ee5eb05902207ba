//! Tests the primitives of `shm` between the two processors: lock, mailbox, channels, pool.
//!
//! Strap 0: the length of a turn in ticks of 50 ns. Strap 1: if not 0, the test does not hold the
//! lock, and its checks must detect this. The status is 0 if all checks passed.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::sync::atomic::{AtomicU32, Ordering};
use tandem_board::{Board, CoreAddress, CoreId, Duration};
use tandem_board_mps2_an521::board::An521Board;
use tandem_board_mps2_an521::{cpu, entry, exit, log, straps, timers};
use tandem_shm::fifo::Consumer;
use tandem_shm::incarnation::Incarnation;
use tandem_shm::mailbox::{Ring, TaskId};
use tandem_shm::map::{Layout, Map};
use tandem_shm::pool::{self, Handle};
use tandem_shm::region::{Broadcast, Fifo, Mailbox, Newest, Region, SharedLock, SharedPool, Words};
use tandem_shm::sync;

entry!(main);

const BLOCKS: usize = 8;

const TO_1: Region<Mailbox> = Region::first("mailbox 0 to 1");
const TO_0: Region<Mailbox> = TO_1.then("mailbox 1 to 0");
const LOCK: Region<SharedLock> = TO_0.then("lock");
const GUARDED: Region<Words<2>> = LOCK.then("guarded");
const QUEUE: Region<Fifo<[u32; 3], 4>> = GUARDED.then("queue");
const HANDLES: Region<Fifo<[u32; 3], 4>> = QUEUE.then("handles");
const NEWEST: Region<Newest<[u32; 40]>> = HANDLES.then("value");
const BROADCAST: Region<Broadcast<[u32; 6], 8>> = NEWEST.then("ring");
const POOL: Region<SharedPool<BLOCKS>> = BROADCAST.then("pool");
const LAYOUT: Layout = POOL.end();

const ROUNDS: u32 = 500;
/// More polls than any wait here needs.
const POLLS: u32 = 1_000_000;

/// The step that each processor has reached.
static STEP: [AtomicU32; 2] = [const { AtomicU32::new(0) }; 2];

fn meet(own: usize, step: u32) {
    // Release pairs with the Acquire below.
    STEP[own].store(step, Ordering::Release);
    while STEP[1 - own].load(Ordering::Acquire) < step {
        sync::spin(1);
    }
}

fn main(own: usize) -> ! {
    let cast = [Some(CoreAddress::A0), Some(CoreAddress::A1)];
    let Some(board) = An521Board::new(cast) else {
        exit::exit(1)
    };
    if own == 0 && Map::format(board.lmu(), LAYOUT).is_err() {
        exit::exit(1);
    }
    if own == 0 {
        timers::set_turns(straps::strap(0).max(20));
        board.release_core(CoreId::PERCEPTION);
    }
    meet(own, 1);
    let result = Map::attach(board.lmu(), LAYOUT)
        .map_err(|_| "the other core attaches to what the first has formatted")
        .and_then(|map| run(own, &board, map));
    if let Err(what) = result {
        log!("FAILED  processor {own}: {what}");
        exit::exit(1);
    }
    meet(own, 100);
    if own == 0 {
        log!("passed  lock, mailbox, fifo, newest, broadcast, pool: {ROUNDS} rounds each");
        exit::exit(0);
    }
    loop {
        cpu::sleep();
    }
}

type Checked = Result<(), &'static str>;
/// The arguments of a test on one processor: its number, its board, the LMU, its incarnation.
type Role = fn(usize, &An521Board, Map<'_>, Incarnation) -> Checked;

fn check(holds: bool, what: &'static str) -> Checked {
    if holds { Ok(()) } else { Err(what) }
}

fn run(own: usize, board: &An521Board, map: Map<'_>) -> Checked {
    let incarnation = Incarnation::new(own, 1).ok_or("the core exists")?;
    let incarnations = map.incarnations();
    check(
        incarnations.announce(incarnation).is_ok(),
        "a first incarnation is announced",
    )?;
    let cases: [Role; 5] = [exclude, signal, queue, look, lend];
    for (index, case) in (2..).step_by(10).zip(cases) {
        meet(own, index);
        case(own, board, map, incarnation)?;
    }
    Ok(())
}

/// Tests that no processor sees the locked data in the middle of a change.
fn exclude(_: usize, _: &An521Board, map: Map<'_>, incarnation: Incarnation) -> Checked {
    let fit = "the regions fit";
    let mut lock = LOCK.attach(&map, incarnation).map_err(|_| fit)?;
    let guarded = GUARDED.attach(&map).map_err(|_| fit)?;
    let [one, two] = [&guarded[0], &guarded[1]];
    let broken = straps::strap(1) != 0;
    for _ in 0..ROUNDS {
        let taken = lock
            .lock(POLLS, sync::spin)
            .map_err(|_| "the lock becomes free")?;
        check(!taken.is_recovered(), "no core died")?;
        let guard = taken.into_guard();
        let guard = if broken {
            drop(guard);
            None
        } else {
            Some(guard)
        };
        let value = one.load(Ordering::Relaxed);
        check(two.load(Ordering::Relaxed) == value, "the lock excludes")?;
        one.store(value + 1, Ordering::Relaxed);
        two.store(value + 1, Ordering::Relaxed);
        drop(guard);
    }
    Ok(())
}

/// Signals in both directions, with sleeps: no signal is lost, and each arrives with its value.
fn signal(own: usize, board: &An521Board, map: Map<'_>, incarnation: Incarnation) -> Checked {
    let fit = "the regions fit";
    let [to, from] = if own == 0 { [TO_1, TO_0] } else { [TO_0, TO_1] };
    let mut sender = to.sender(&map, incarnation).map_err(|_| fit)?;
    let mut receiver = from.receiver(&map, incarnation).map_err(|_| fit)?;
    let task = TaskId::new(3).ok_or("3 is a task")?;
    let peer = CoreId::ALL[1 - own];
    meet(own, 13);
    for round in 1..=ROUNDS {
        if own == 0 && sender.signal_with(task, round) == Ring::Needed {
            board.ring(peer);
        }
        let limit = board.now() + Duration::from_ms(1_000);
        let mut received = None;
        while received.is_none() {
            receiver.poll(|signals| received = Some(signals));
            check(board.now() < limit, "a signal arrives")?;
            if received.is_none() && receiver.prepare_sleep() {
                board.wait(limit);
                receiver.awake();
            }
        }
        let expected = received.is_some_and(|signals| (signals.count, signals.value) == (1, round));
        check(expected, "each signal arrives once, with its value")?;
        if own == 1 && sender.signal_with(task, round) == Ring::Needed {
            board.ring(peer);
        }
    }
    Ok(())
}

/// Waits for the next value of a queue.
fn next(consumer: &mut Consumer<'_, [u32; 3], 4>) -> [u32; 3] {
    loop {
        if let Ok(Some(value)) = consumer.receive() {
            return value;
        }
        sync::spin(1);
    }
}

/// Tests that every value arrives, in order.
fn queue(own: usize, _: &An521Board, map: Map<'_>, incarnation: Incarnation) -> Checked {
    let fit = "the regions fit";
    if own == 0 {
        let mut producer = QUEUE.producer(&map, incarnation).map_err(|_| fit)?;
        for value in 0..ROUNDS {
            while producer.send(&[value, value * 3, !value]).is_err() {
                sync::spin(1);
            }
        }
        return Ok(());
    }
    let mut consumer = QUEUE.consumer(&map, incarnation).map_err(|_| fit)?;
    for value in 0..ROUNDS {
        let got = next(&mut consumer);
        check(
            got == [value, value * 3, !value],
            "every value arrives, in order",
        )?;
    }
    Ok(())
}

/// Tests that the newest value is never torn, and that the ring counts the values that it loses.
fn look(own: usize, _: &An521Board, map: Map<'_>, incarnation: Incarnation) -> Checked {
    let fit = "the regions fit";
    if own == 0 {
        let mut writer = NEWEST.writer(&map, incarnation).map_err(|_| fit)?;
        let mut ring = BROADCAST.writer(&map, incarnation).map_err(|_| fit)?;
        meet(own, 33);
        for value in 1..=ROUNDS {
            writer.publish(&[value; 40]);
            ring.publish(&[value; 6]);
        }
        return Ok(());
    }
    let reader = NEWEST.reader(&map).map_err(|_| fit)?;
    let mut receiver = BROADCAST.receiver(&map).map_err(|_| fit)?;
    meet(own, 33);
    let (mut last, mut next) = (0, 1);
    while last < ROUNDS || next <= ROUNDS {
        if let Ok((_, value)) = reader.read() {
            check(value == [value[0]; 40], "the newest value is whole")?;
            check(value[0] >= last, "the newest value does not go back")?;
            last = value[0];
        }
        match receiver.receive() {
            Ok(Some((_, value))) => {
                check(
                    value == [next; 6],
                    "a broadcast value is whole, and the next",
                )?;
                next += 1;
            }
            Ok(None) => sync::spin(1),
            Err(lost) => next += lost.count,
        }
    }
    Ok(())
}

/// Processor 0 hands over words, and processor 1 reads them and gives them back.
fn lend(own: usize, _: &An521Board, map: Map<'_>, incarnation: Incarnation) -> Checked {
    let fit = "the regions fit";
    let pool = POOL.attach(&map, incarnation).map_err(|_| fit)?;
    if own == 0 {
        let mut producer = HANDLES.producer(&map, incarnation).map_err(|_| fit)?;
        for round in 0..ROUNDS {
            let handle = loop {
                if let Ok(handle) = pool.get(20) {
                    break handle;
                }
                sync::spin(1);
            };
            let lent = pool.open(handle).map_err(|_| "lent words can be opened")?;
            lent[19].store(round, Ordering::Relaxed);
            let handed = pool.hand_over(handle, 1);
            check(handed.is_ok(), "words are handed to a living core")?;
            let [first, second] = handle.to_words();
            while producer.send(&[first, second, round]).is_err() {
                sync::spin(1);
            }
        }
        return Ok(());
    }
    let mut consumer = HANDLES.consumer(&map, incarnation).map_err(|_| fit)?;
    for round in 0..ROUNDS {
        let got = next(&mut consumer);
        let handle = Handle::from_words([got[0], got[1]]);
        let lent = pool
            .open(handle)
            .map_err(|_| "words that were handed over can be opened")?;
        let value = lent[19].load(Ordering::Relaxed);
        check(value == round, "a word that was written before is there")?;
        check(
            pool.give_back(handle).is_ok(),
            "the owner of words can give them back",
        )?;
        check(pool.give_back(handle).is_err(), "but not twice")?;
    }
    let free = pool.free_words();
    check(free == BLOCKS * pool::BLOCK_WORDS, "nothing leaks")
}
