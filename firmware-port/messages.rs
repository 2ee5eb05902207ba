//! One core sends messages to another, which handles them when it is signalled. Links both ends of
//! mailbox and FIFO only: the functions of a message library such as RPMsg-Lite. The image
//! `size-messages` of each board includes this file.

use core::hint::black_box;
use core::sync::atomic::AtomicU32;
use tandem_shm::mailbox::{self, Ring, TaskId, TaskTable};
use tandem_shm::{Shape, bare, fifo};

const SHAPE: Shape = Shape::new(8, 16);

type Words = [AtomicU32];

/// The part of core 0 is to send in `lmu`, that of the other core to receive. `post` rings the
/// other's doorbell, `sleep` waits for a ring. Returns only if the memory does not fit.
pub(crate) fn run(own: usize, lmu: &'static Words, post: fn(), sleep: fn()) -> Option<()> {
    let (mailbox, rest) = lmu.split_at_checked(mailbox::WORDS)?;
    let queue = rest.get(..fifo::words(SHAPE))?;
    if own == 0 {
        send(mailbox, queue, post)
    } else {
        receive(mailbox, queue, sleep)
    }
}

fn send(mailbox: &'static Words, queue: &'static Words, post: fn()) -> Option<()> {
    let mut to = bare::mailbox_sender(mailbox).ok()?;
    let mut queue = bare::fifo_producer(queue, SHAPE).ok()?;
    loop {
        let message: [u32; 16] = black_box([1; 16]);
        if queue.send(&message).is_ok() && to.signal(TaskId::new(1)?) == Ring::Needed {
            post();
        }
    }
}

fn receive(mailbox: &'static Words, queue: &'static Words, sleep: fn()) -> Option<()> {
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
            sleep();
            from.awake();
        }
    }
}
