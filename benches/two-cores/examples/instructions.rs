//! Repeats one operation of each kind, for `cargo xtask instructions` to count.
#![allow(clippy::unwrap_used, reason = "a wrong set-up ends the program")]

use std::hint::black_box;
use std::process::ExitCode;

use tandem_bus::{Control, FrameReceiver as Checked, FrameTransmitter, Message};
use tandem_shm::incarnation::{Incarnation, Incarnations};
use tandem_shm::mailbox::{TaskId, TaskTable};
use tandem_shm::sync::{AtomicU32, spin};
use tandem_shm::{LINE_WORDS, Shape, bare, broadcast, fifo, lock, mailbox, newest, pool};

const SMALL: Shape = Shape::new(4, 1);
/// Shape of a channel that carries one scene of the controller.
const SCENE: Shape = Shape::new(4, 266);
const BLOCKS: usize = 8;

/// Returns zeroed words that begin at a cache line and exist as long as the program runs.
fn zeroed(words: usize) -> &'static [AtomicU32] {
    let memory = (0..words + LINE_WORDS).map(|_| AtomicU32::new(0));
    let memory: &'static [AtomicU32] = Vec::leak(memory.collect());
    let skip = memory.as_ptr().align_offset(4 * LINE_WORDS);
    &memory[skip..skip + words]
}

/// Announces the only core. Returns its incarnation and the table of incarnations.
fn incarnation() -> (Incarnation, Incarnations<'static>) {
    let (own, all) = (
        Incarnation::new(0, 1).unwrap(),
        Incarnations::attach(zeroed(Incarnations::WORDS)).unwrap(),
    );
    all.announce(own).unwrap();
    (own, all)
}

/// Returns an operation that publishes `WORDS` words in a newest-value channel and reads them.
fn channel<const WORDS: usize>(shape: Shape) -> Box<dyn FnMut()> {
    let words = zeroed(newest::words(shape));
    let mut writer = bare::newest_writer::<[u32; WORDS]>(words, shape).unwrap();
    let mut reader = bare::newest_reader::<[u32; WORDS]>(words, shape).unwrap();
    let value = [7; WORDS];
    Box::new(move || {
        writer.publish(black_box(&value));
        black_box(reader.fetch().unwrap());
    })
}

fn queue<const WORDS: usize>(shape: Shape) -> Box<dyn FnMut()> {
    let words = zeroed(fifo::words(shape));
    let mut from = bare::fifo_producer::<[u32; WORDS]>(words, shape).unwrap();
    let mut to = bare::fifo_consumer::<[u32; WORDS]>(words, shape).unwrap();
    let value = [7; WORDS];
    Box::new(move || {
        from.send(black_box(&value)).unwrap();
        black_box(to.receive().unwrap());
    })
}

/// Returns the operation of this name, if it exists.
fn case(name: &str) -> Option<Box<dyn FnMut()>> {
    Some(match name {
        "mailbox" => {
            let words = zeroed(mailbox::WORDS);
            let mut from = bare::mailbox_sender(words).unwrap();
            let mut to = bare::mailbox_receiver(words).unwrap();
            let mut tasks = TaskTable::<u32>::new();
            tasks
                .add(TaskId::FIRST, |sum, _, call| *sum += call.value, 0)
                .unwrap();
            let mut sum = 0;
            Box::new(move || {
                let _ = black_box(from.signal_with(TaskId::FIRST, black_box(1)));
                tasks.run(&mut to, &mut sum);
            })
        }
        "mailbox-empty-poll" => {
            let mut to = bare::mailbox_receiver(zeroed(mailbox::WORDS)).unwrap();
            Box::new(move || {
                black_box(to.poll(|_| ()));
            })
        }
        "channel-4B" => channel::<1>(SMALL),
        "channel-scene" => channel::<266>(SCENE),
        "fifo-4B" => queue::<1>(SMALL),
        "fifo-scene" => queue::<266>(SCENE),
        "broadcast-4B" => {
            let words = zeroed(broadcast::words(SMALL));
            let mut writer = bare::broadcast_writer::<u32>(words, SMALL).unwrap();
            let mut reader = bare::broadcast_receiver::<u32>(words, SMALL).unwrap();
            Box::new(move || {
                writer.publish(black_box(&7));
                black_box(reader.receive().unwrap());
            })
        }
        "pool" => {
            let (own, all) = incarnation();
            let words = zeroed(pool::words(BLOCKS));
            let pool = bare::pool(words, BLOCKS, own, all).unwrap();
            Box::new(move || {
                let handle = pool.get(black_box(8)).unwrap();
                black_box(pool.open(handle).unwrap());
                pool.give_back(handle).unwrap();
            })
        }
        "lock" => {
            let (own, all) = incarnation();
            let mut lock = bare::lock(zeroed(lock::WORDS), own, all).unwrap();
            Box::new(move || {
                black_box(lock.lock(u32::MAX, spin).is_ok());
            })
        }
        "control-frame" => {
            let (mut from, mut to) = (FrameTransmitter::new(), Checked::new());
            let control = Control::default();
            Box::new(move || {
                let system = 0;
                let frame = from.encode(black_box(&Message::Control { system, control }));
                black_box(to.receive(frame.id.into(), frame.data()).unwrap());
            })
        }
        _ => return None,
    })
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [name, times] = &arguments[..] else {
        return ExitCode::FAILURE;
    };
    let (Some(mut operation), Ok(times)) = (case(name), times.parse::<u32>()) else {
        return ExitCode::FAILURE;
    };
    for _ in 0..times {
        operation();
    }
    ExitCode::SUCCESS
}
