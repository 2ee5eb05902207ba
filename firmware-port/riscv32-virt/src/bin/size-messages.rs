//! One core sends messages to another, which handles them when it is signalled. Links both ends of
//! mailbox and FIFO only: the functions of a message library such as RPMsg-Lite.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::hint::black_box;
use tandem_board::SystemId;
use tandem_board_riscv32_virt::{clint, entry, hart, memory};
use tandem_shm::mailbox::{self, Ring, TaskId, TaskTable};
use tandem_shm::{Shape, bare, fifo};

entry!(main);

const SHAPE: Shape = Shape::new(8, 16);

fn main(hart: usize) -> ! {
    let (mailbox, rest) = memory::lmu(SystemId::A).split_at(mailbox::WORDS);
    let queue = &rest[..fifo::words(SHAPE)];
    if hart == 0 {
        send(mailbox, queue);
    } else {
        receive(mailbox, queue);
    }
    hart::park()
}

type Words = [core::sync::atomic::AtomicU32];

fn send(mailbox: &'static Words, queue: &'static Words) -> Option<()> {
    let mut to = bare::mailbox_sender(mailbox).ok()?;
    let mut queue = bare::fifo_producer(queue, SHAPE).ok()?;
    loop {
        let message: [u32; 16] = black_box([1; 16]);
        if queue.send(&message).is_ok() && to.signal(TaskId::new(1)?) == Ring::Needed {
            clint::post(1);
        }
    }
}

fn receive(mailbox: &'static Words, queue: &'static Words) -> Option<()> {
    let mut from = bare::mailbox_receiver(mailbox).ok()?;
    let mut queue = bare::fifo_consumer(queue, SHAPE).ok()?;
    let mut tasks = TaskTable::new();
    let take = |queue: &mut fifo::Consumer<'static, [u32; 16]>, _, _| {
        while let Ok(Some(message)) = queue.receive() {
            black_box(&message);
        }
    };
    tasks.add(TaskId::new(1)?, take, 0).ok()?;
    loop {
        tasks.run(&mut from, &mut queue);
        if from.prepare_sleep() {
            hart::sleep();
            from.awake();
        }
    }
}
