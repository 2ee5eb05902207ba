//! The primitives of `shm` between the two processors: lock, mailbox, channels, pool.
//!
//! Strap 0: the length of a turn in ticks of 50 ns; strap 1: not 0 breaks the lock, and the program
//! must see it. The status is 0 if all held.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::sync::atomic::{AtomicU32, Ordering};
use tandem_board::{Board, CoreAddress, CoreId, Duration};
use tandem_board_mps2_an521::board::An521Board;
use tandem_board_mps2_an521::{clock, cpu, entry, exit, log, memory};
use tandem_shm::incarnation::Incarnation;
use tandem_shm::lock::Lock;
use tandem_shm::mailbox::{Receiver, Ring, Sender, TaskId};
use tandem_shm::map::{Layout, Map, Region};
use tandem_shm::pool::{Handle, Pool};
use tandem_shm::{Shape, broadcast, fifo, lock, mailbox, newest, pool, sync};

entry!(main);

const QUEUE: Shape = Shape::new(4, 3);
const VALUE: Shape = Shape::new(4, 40);
const RING: Shape = Shape::new(8, 6);
const BLOCKS: usize = 8;

const LAYOUT: Layout = Layout::new(&[
    Region::new("mailbox 0 to 1", mailbox::WORDS),
    Region::new("mailbox 1 to 0", mailbox::WORDS),
    Region::new("lock", lock::WORDS),
    Region::new("guarded", 2),
    Region::new("queue", fifo::words(QUEUE)),
    Region::new("value", newest::words(VALUE)),
    Region::new("ring", broadcast::words(RING)),
    Region::new("pool", pool::words(BLOCKS)),
]);
const TO_1: usize = 0;
const TO_0: usize = 1;
const LOCK: usize = 2;
const GUARDED: usize = 3;
const QUEUED: usize = 4;
const NEWEST: usize = 5;
const BROADCAST: usize = 6;
const POOL: usize = 7;

const ROUNDS: u32 = 500;
/// More looks than any waiting here takes.
const LOOKS: u32 = 1_000_000;

/// Both processors have come so far.
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
        clock::set_turns(memory::strap(0).max(20));
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
/// What each processor does in a test: its number, its board, the LMU, its incarnation.
type Role = fn(usize, &An521Board, Map<'_>, Incarnation) -> Checked;

fn check(holds: bool, what: &'static str) -> Checked {
    if holds { Ok(()) } else { Err(what) }
}

fn run(own: usize, board: &An521Board, map: Map<'_>) -> Checked {
    let incarnation = Incarnation::new(own, 1).ok_or("there is such a core")?;
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

/// What the lock guards is never seen in the middle of a change.
fn exclude(_: usize, _: &An521Board, map: Map<'_>, incarnation: Incarnation) -> Checked {
    let fit = "the regions fit";
    let mut lock =
        Lock::attach(map.region(LOCK), incarnation, map.incarnations()).map_err(|_| fit)?;
    let [one, two] = [0, 1].map(|at: usize| &map.region(GUARDED)[at]);
    let broken = memory::strap(1) != 0;
    for _ in 0..ROUNDS {
        let taken = lock
            .lock(LOOKS, sync::spin)
            .map_err(|_| "a lock is to be had")?;
        check(!taken.is_recovered(), "nobody died")?;
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

/// To and fro, with sleeps: no signal is lost, each comes with its value.
fn signal(own: usize, board: &An521Board, map: Map<'_>, _: Incarnation) -> Checked {
    let fit = "the regions fit";
    let [to, from] = if own == 0 { [TO_1, TO_0] } else { [TO_0, TO_1] };
    let mut sender = Sender::attach(map.region(to)).map_err(|_| fit)?;
    let mut receiver = Receiver::attach(map.region(from)).map_err(|_| fit)?;
    let task = TaskId::new(3).ok_or("3 is a task")?;
    let peer = CoreId::ALL[1 - own];
    meet(own, 13);
    for round in 1..=ROUNDS {
        if own == 0 && sender.signal_with(task, round) == Ring::Needed {
            board.ring(peer);
        }
        let limit = board.now() + Duration::from_ms(1_000);
        let mut came = None;
        while came.is_none() {
            receiver.poll(|signals| came = Some(signals));
            check(board.now() < limit, "a signal comes")?;
            if came.is_none() && receiver.prepare_sleep() {
                board.wait(limit);
                receiver.awake();
            }
        }
        let expected = came.is_some_and(|came| (came.count, came.value) == (1, round));
        check(expected, "each signal comes once, with its value")?;
        if own == 1 && sender.signal_with(task, round) == Ring::Needed {
            board.ring(peer);
        }
    }
    Ok(())
}

/// Every value, in order.
fn queue(own: usize, _: &An521Board, map: Map<'_>, _: Incarnation) -> Checked {
    let words = map.region(QUEUED);
    if own == 0 {
        let mut producer = fifo::Producer::attach(words, QUEUE).map_err(|_| "the regions fit")?;
        for value in 0..ROUNDS {
            while producer.send(&[value, value * 3, !value]).is_err() {
                sync::spin(1);
            }
        }
        return Ok(());
    }
    let mut consumer = fifo::Consumer::attach(words, QUEUE).map_err(|_| "the regions fit")?;
    for value in 0..ROUNDS {
        let mut got = [0; 3];
        while !consumer.receive_into(&mut got) {
            sync::spin(1);
        }
        check(
            got == [value, value * 3, !value],
            "every value comes, in order",
        )?;
    }
    Ok(())
}

/// The newest value is never torn; what the ring loses it counts.
fn look(own: usize, _: &An521Board, map: Map<'_>, _: Incarnation) -> Checked {
    let fit = "the regions fit";
    let [value_words, ring_words] = [NEWEST, BROADCAST].map(|region| map.region(region));
    if own == 0 {
        let mut writer = newest::Writer::attach(value_words, VALUE).map_err(|_| fit)?;
        let mut sender = broadcast::Sender::attach(ring_words, RING).map_err(|_| fit)?;
        meet(own, 33);
        for value in 1..=ROUNDS {
            writer.publish(&[value; 40]);
            sender.send(&[value; 6]);
        }
        return Ok(());
    }
    let reader = newest::Reader::attach(value_words, VALUE).map_err(|_| fit)?;
    let mut receiver = broadcast::Receiver::attach(ring_words, RING).map_err(|_| fit)?;
    meet(own, 33);
    let (mut last, mut next) = (0, 1);
    while last < ROUNDS || next <= ROUNDS {
        let mut value = [0; 40];
        if reader.read_into(&mut value).is_some() {
            check(value == [value[0]; 40], "the newest value is whole")?;
            check(value[0] >= last, "the newest value does not go back")?;
            last = value[0];
        }
        let mut value = [0; 6];
        match receiver.receive_into(&mut value) {
            Ok(Some(_)) => {
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

/// Words are handed over and given back by whoever got them.
fn lend(own: usize, _: &An521Board, map: Map<'_>, incarnation: Incarnation) -> Checked {
    let fit = "the regions fit";
    let pool =
        Pool::attach(map.region(POOL), BLOCKS, incarnation, map.incarnations()).map_err(|_| fit)?;
    let words = map.region(QUEUED);
    if own == 0 {
        let mut producer = fifo::Producer::attach(words, QUEUE).map_err(|_| fit)?;
        for round in 0..ROUNDS {
            let handle = loop {
                if let Ok(handle) = pool.get(20) {
                    break handle;
                }
                sync::spin(1);
            };
            let lent = pool
                .open(handle)
                .map_err(|_| "what was lent can be opened")?;
            lent[19].store(round, Ordering::Relaxed);
            let handed = pool.hand_over(handle, 1);
            check(handed.is_ok(), "words go to a core that lives")?;
            let [first, second] = handle.to_words();
            while producer.send(&[first, second, round]).is_err() {
                sync::spin(1);
            }
        }
        return Ok(());
    }
    let mut consumer = fifo::Consumer::attach(words, QUEUE).map_err(|_| fit)?;
    for round in 0..ROUNDS {
        let mut got = [0; 3];
        while !consumer.receive_into(&mut got) {
            sync::spin(1);
        }
        let handle = Handle::from_words([got[0], got[1]]);
        let lent = pool
            .open(handle)
            .map_err(|_| "what was handed over can be opened")?;
        let value = lent[19].load(Ordering::Relaxed);
        check(value == round, "what was written before is there")?;
        check(
            pool.give_back(handle).is_ok(),
            "who owns words can give them back",
        )?;
        check(pool.give_back(handle).is_err(), "but not twice")?;
    }
    let free = pool.free_words();
    check(free == BLOCKS * pool::BLOCK_WORDS, "nothing leaks")
}
