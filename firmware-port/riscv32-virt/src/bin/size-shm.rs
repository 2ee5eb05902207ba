//! Uses every primitive of `shm` once: map, incarnations, lock, mailbox, pool, the three channels.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::hint::black_box;
use tandem_board::SystemId;
use tandem_board_riscv32_virt::{clint, entry, hart, memory};
use tandem_shm::incarnation::Incarnation;
use tandem_shm::mailbox::{Ring, TaskId, TaskTable};
use tandem_shm::map::{Layout, Map};
use tandem_shm::region::{Broadcast, Fifo, Mailbox, Newest, Region, SharedLock, SharedPool};

entry!(main);

type Message = [u32; 16];

const MAILBOX: Region<Mailbox> = Region::first("mailbox");
const FIFO: Region<Fifo<Message, 8>> = MAILBOX.then("fifo");
const NEWEST: Region<Newest<Message, 8>> = FIFO.then("newest");
const BROADCAST: Region<Broadcast<Message, 8>> = NEWEST.then("broadcast");
const LOCK: Region<SharedLock> = BROADCAST.then("lock");
const POOL: Region<SharedPool<16>> = LOCK.then("pool");
const LAYOUT: Layout = POOL.end();

fn main(hart: usize) -> ! {
    let incarnation = Incarnation::new(hart % 3, black_box(1));
    if let Some(incarnation) = incarnation {
        let _ = Map::format(memory::lmu(SystemId::A), LAYOUT);
        share(incarnation);
        send(incarnation);
        receive(incarnation);
    }
    hart::park()
}

fn map() -> Option<Map<'static>> {
    Map::attach(memory::lmu(SystemId::A), LAYOUT).ok()
}

fn share(incarnation: Incarnation) -> Option<()> {
    let map = map()?;
    map.incarnations().announce(incarnation).ok()?;
    let mut lock = LOCK.attach(&map, incarnation).ok()?;
    drop(lock.lock(black_box(10), tandem_shm::sync::spin).ok()?);
    let pool = POOL.attach(&map, incarnation).ok()?;
    pool.reclaim_dead();
    let handle = pool.get(black_box(20)).ok()?;
    black_box(pool.open(handle).ok()?);
    pool.hand_over(handle, black_box(1)).ok()?;
    pool.give_back(handle).ok()
}

fn send(own: Incarnation) -> Option<()> {
    let map = map()?;
    let mut to = MAILBOX.sender(&map, own).ok()?;
    let message: Message = black_box([1; 16]);
    FIFO.producer(&map, own).ok()?.send(&message).ok()?;
    NEWEST.writer(&map, own).ok()?.publish(&message);
    BROADCAST.writer(&map, own).ok()?.publish(&message);
    if to.signal_with(TaskId::new(black_box(1))?, 7) == Ring::Needed {
        clint::post(1);
    }
    Some(())
}

fn receive(own: Incarnation) -> Option<()> {
    let map = map()?;
    let mut from = MAILBOX.receiver(&map, own).ok()?;
    let mut tasks = TaskTable::new();
    tasks
        .add(TaskId::new(1)?, |_, _, call| _ = black_box(call), 0)
        .ok()?;
    tasks.run(&mut from, &mut ());
    if from.prepare_sleep() {
        hart::sleep();
        from.awake();
    }
    black_box(FIFO.consumer(&map, own).ok()?.receive()).ok()?;
    black_box(NEWEST.reader(&map).ok()?.read()).ok()?;
    black_box(BROADCAST.receiver(&map).ok()?.receive()).ok()?;
    Some(())
}
