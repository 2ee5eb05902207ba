//! Two experiments of the thesis with cores 0 and 1: 4 bytes that wake a task and are passed to it,
//! and a counter with and without the lock. T-SYNC-4, T-LOCK-2
//!
//! Prints `exchange SENT RECEIVED INSTRUCTIONS` for each message. Then, for the counter without the
//! lock and with it, `counter LOCKED INCREMENTS COUNTER` and, for each core, `seen LOCKED CORE`
//! with the values that it read after its first increments.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::sync::atomic::Ordering::{Acquire, Relaxed, Release};
use core::sync::atomic::{AtomicBool, AtomicU32};
use tandem_board::SystemId;
use tandem_board_riscv32_virt::{clint, doorbell, entry, exit, hart, log, memory, must};
use tandem_shm::incarnation::Incarnation;
use tandem_shm::mailbox::{Call, Ring, Sender, TaskId, TaskTable};
use tandem_shm::map::{Layout, Map};
use tandem_shm::region::{Mailbox, Region, SharedLock, Words};

entry!(main);

const MAILBOX: Region<Mailbox> = Region::first("mailbox 0 to 1");
const LOCK: Region<SharedLock> = MAILBOX.then("lock");
const COUNTER: Region<Words<1>> = LOCK.then("counter");
const LAYOUT: Layout = COUNTER.end();

/// Number of messages. Each carries its number in one byte, as in the thesis.
const MESSAGES: u32 = 250;
/// Number of increments of each core.
const INCREMENTS: u32 = 10_000;
/// Number of values that the program prints for each core.
const SHOWN: usize = 10;
/// Length of a turn of core 0, in ticks. A turn of core 1 is one tick longer, so that the two cores
/// do not run in step.
const TURN_TICKS: u32 = 8;

/// The value that core 1's task received last, the cycle at that time, and the number of values.
static RECEIVED: AtomicU32 = AtomicU32::new(0);
static AT: AtomicU32 = AtomicU32::new(0);
static TASKS: AtomicU32 = AtomicU32::new(0);
/// Number of arrivals of cores at the start or the end of a count.
static ARRIVED: AtomicU32 = AtomicU32::new(0);
/// True when all messages were sent and the counts begin.
static COUNTS: AtomicBool = AtomicBool::new(false);
static SEEN: [[AtomicU32; SHOWN]; 2] = [const { [const { AtomicU32::new(0) }; SHOWN] }; 2];

fn main(hart: usize) -> ! {
    match hart {
        0 => core_0(),
        1 => core_1(),
        _ => hart::park(),
    }
}

fn core_0() -> ! {
    must(Map::format(memory::lmu(SystemId::A), LAYOUT));
    let (map, own) = memory::attach(0, LAYOUT);
    let mut to = must(MAILBOX.sender(&map, own));
    // A range that includes its end would have code of its own for the last message.
    (1..MESSAGES + 1).for_each(|number| exchange(&mut to, number));
    COUNTS.store(true, Release);
    clint::post(1);
    count_both(&map, own);
    exit::exit(0)
}

/// Section 6.4.2: sends 4 bytes to core 1, which sleeps, and waits for its task.
fn exchange(to: &mut Sender<'_>, number: u32) {
    // Waits until core 1 sleeps.
    (0..8).for_each(|_| hart::yield_turn());
    let sent = u32::from_le_bytes([number as u8, 1, 2, 3]);
    let begin = hart::cycles();
    if to.signal_with(TaskId::FIRST, sent) == Ring::Needed {
        clint::post(1);
    }
    hart::yield_until(|| TASKS.load(Acquire) == number);
    let took = AT.load(Relaxed).wrapping_sub(begin);
    log!("exchange {sent} {} {took}", RECEIVED.load(Relaxed));
}

fn core_1() -> ! {
    let (map, own) = memory::attach(1, LAYOUT);
    let mut from = must(MAILBOX.receiver(&map, own));
    let mut tasks = TaskTable::new();
    let task = |(): &mut (), _, call: Call| {
        AT.store(hart::cycles(), Relaxed);
        RECEIVED.store(call.value, Relaxed);
        TASKS.store(TASKS.load(Relaxed) + 1, Release);
    };
    must(tasks.add(TaskId::FIRST, task, 0));
    hart::interrupts_on();
    while !COUNTS.load(Acquire) {
        tasks.run(&mut from, &mut ());
        if from.prepare_sleep() {
            doorbell::wait(None);
            from.awake();
        }
    }
    count_both(&map, own);
    hart::park()
}

/// Section 6.4.3: both cores count, first without the lock and then with it. Core 0 prints.
fn count_both(map: &Map<'static>, own: Incarnation) {
    let core = own.core();
    hart::interrupts_on();
    let mut lock = must(LOCK.attach(map, own));
    let counter = &must(COUNTER.attach(map))[0];
    for (round, locked) in [(0_u32, false), (1, true)] {
        // Both cores start and end each count together.
        let meet = |time| {
            ARRIVED.fetch_add(1, Release);
            hart::yield_until(|| ARRIVED.load(Acquire) >= 2 * (3 * round + time));
        };
        if core == 0 {
            counter.store(0, Relaxed);
        }
        meet(1);
        doorbell::set_slice(TURN_TICKS + core as u32);
        for number in 0..INCREMENTS as usize {
            let wait = |_| hart::yield_turn();
            let guard = locked.then(|| must(lock.lock(u32::MAX, wait)).into_guard());
            // Read, modify, write, instead of one atomic addition.
            let value = counter.load(Relaxed) + 1;
            core::hint::spin_loop();
            counter.store(value, Relaxed);
            drop(guard);
            if let Some(seen) = SEEN[core].get(number) {
                seen.store(value, Relaxed);
            }
        }
        doorbell::set_slice(0);
        meet(2);
        if core == 0 {
            let counted = counter.load(Relaxed);
            log!("counter {locked} {} {counted}", 2 * INCREMENTS);
            for (of, seen) in SEEN.iter().enumerate() {
                let values = seen.each_ref().map(|value| value.load(Relaxed));
                log!("seen {locked} {of} {values:?}");
            }
        }
        meet(3);
    }
}
