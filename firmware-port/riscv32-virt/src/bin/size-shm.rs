//! Every primitive of `shm` once: map, incarnations, lock, mailbox, pool, the three channels.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::hint::black_box;
use tandem_board::SystemId;
use tandem_board_riscv32_virt::{clint, entry, hart, memory};
use tandem_shm::incarnation::Incarnation;
use tandem_shm::lock::{self, Lock};
use tandem_shm::mailbox::{self, Receiver, Ring, Sender, TaskId, TaskTable};
use tandem_shm::map::{Layout, Map, Region};
use tandem_shm::pool::{self, Pool};
use tandem_shm::{Shape, broadcast, fifo, newest};

entry!(main);

const SHAPE: Shape = Shape::new(8, 16);
const BLOCKS: usize = 16;
const LAYOUT: Layout = Layout::new(&[
    Region::new("mailbox", mailbox::WORDS),
    Region::new("fifo", fifo::words(SHAPE)),
    Region::new("newest", newest::words(SHAPE)),
    Region::new("broadcast", broadcast::words(SHAPE)),
    Region::new("lock", lock::WORDS),
    Region::new("pool", pool::words(BLOCKS)),
]);

fn main(hart: usize) -> ! {
    let incarnation = Incarnation::new(hart % 3, black_box(1));
    if let Some(incarnation) = incarnation {
        let _ = Map::format(memory::lmu(SystemId::A), LAYOUT);
        share(incarnation);
        send(incarnation);
        receive(incarnation);
    }
    loop {
        hart::sleep();
    }
}

fn map() -> Option<Map<'static>> {
    Map::attach(memory::lmu(SystemId::A), LAYOUT).ok()
}

fn share(incarnation: Incarnation) -> Option<()> {
    let map = map()?;
    map.incarnations().announce(incarnation).ok()?;
    let mut lock = Lock::attach(map.region(4), incarnation, map.incarnations()).ok()?;
    drop(lock.lock(black_box(10), tandem_shm::sync::spin).ok()?);
    let pool = Pool::attach(map.region(5), BLOCKS, incarnation, map.incarnations()).ok()?;
    pool.reclaim_dead();
    let handle = pool.get(black_box(20)).ok()?;
    black_box(pool.open(handle).ok()?);
    pool.hand_over(handle, black_box(1)).ok()?;
    pool.give_back(handle).ok()
}

fn send(_: Incarnation) -> Option<()> {
    let map = map()?;
    let mut to = Sender::attach(map.region(0)).ok()?;
    let message: [u32; 16] = black_box([1; 16]);
    fifo::Producer::attach(map.region(1), SHAPE)
        .ok()?
        .send(&message)
        .ok()?;
    newest::Writer::attach(map.region(2), SHAPE)
        .ok()?
        .publish(&message);
    broadcast::Sender::attach(map.region(3), SHAPE)
        .ok()?
        .send(&message);
    if to.signal_with(TaskId::new(black_box(1))?, 7) == Ring::Needed {
        clint::post(1);
    }
    Some(())
}

fn receive(_: Incarnation) -> Option<()> {
    let map = map()?;
    let mut from = Receiver::attach(map.region(0)).ok()?;
    let mut tasks = TaskTable::new();
    tasks
        .add(TaskId::new(1)?, |_, call| _ = black_box(call), 0)
        .ok()?;
    tasks.run(&mut from, &mut ());
    if from.prepare_sleep() {
        hart::sleep();
        from.awake();
    }
    let mut message = [0; 16];
    fifo::Consumer::attach(map.region(1), SHAPE)
        .ok()?
        .receive_into(&mut message);
    newest::Reader::attach(map.region(2), SHAPE)
        .ok()?
        .read_into(&mut message);
    let heard = broadcast::Receiver::attach(map.region(3), SHAPE)
        .ok()?
        .receive_into(&mut message);
    black_box((message, heard.is_ok()));
    Some(())
}
