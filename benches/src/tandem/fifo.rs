//! The FIFO channel between processes.

use crate::harness::{Batch, Plan};
use crate::shared::Shared;
use crate::stream::{Sink, Source, Stream, between_processes, two_to_one};
use std::io;
use tandem_shm::{Shape, fifo};

/// `WORDS` words of payload that begin with the number of the message.
struct From<const WORDS: usize> {
    producer: fifo::Producer<'static>,
    message: [u32; WORDS],
}

impl<const WORDS: usize> Source for From<WORDS> {
    #[inline]
    fn send(&mut self, k: u32) -> bool {
        self.message[0] = k;
        self.producer.send(&self.message).is_ok()
    }
}

struct To<const WORDS: usize> {
    consumer: fifo::Consumer<'static>,
    message: [u32; WORDS],
}

impl<const WORDS: usize> Sink for To<WORDS> {
    #[inline]
    fn receive(&mut self) -> Option<u32> {
        let came = self.consumer.receive_into(&mut self.message);
        came.then_some(self.message[0])
    }
}

fn source<const WORDS: usize>(shared: &Shared, at: usize, shape: Shape) -> From<WORDS> {
    From {
        producer: fifo::Producer::attach(&shared.case()[at..], shape).expect("it fits"),
        message: [7; WORDS],
    }
}

fn sink<const WORDS: usize>(shared: &Shared, at: usize, shape: Shape) -> To<WORDS> {
    To {
        consumer: fifo::Consumer::attach(&shared.case()[at..], shape).expect("it fits"),
        message: [0; WORDS],
    }
}

/// Messages of `WORDS` words, copied in and out, in chunks of `chunk`; the channel has `slots`
/// slots.
///
/// # Errors
/// As [`between_processes`].
pub fn messages<const WORDS: usize>(plan: &Plan, slots: usize, chunk: usize) -> io::Result<Batch> {
    let shape = Shape::new(slots, WORDS);
    let stream = Stream {
        chunk,
        payload_bytes: 4 * WORDS as u64,
        case_words: fifo::words(shape),
    };
    between_processes(
        plan,
        stream,
        |shared| source::<WORDS>(shared, 0, shape),
        |shared| sink::<WORDS>(shared, 0, shape),
    )
}

/// Messages of 8 bytes from two processes to one, by a channel each.
///
/// # Errors
/// As [`two_to_one`].
pub fn from_two(plan: &Plan) -> io::Result<Batch> {
    let shape = Shape::new(512, 2);
    let words = fifo::words(shape).next_multiple_of(16);
    let stream = Stream {
        chunk: 4096,
        payload_bytes: 8,
        case_words: 2 * words,
    };
    two_to_one(
        plan,
        stream,
        |shared, way| source::<2>(shared, way * words, shape),
        |shared, way| sink::<2>(shared, way * words, shape),
    )
}
