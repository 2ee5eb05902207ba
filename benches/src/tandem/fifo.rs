//! The FIFO channel between processes.

use super::lmu;
use crate::harness::{Batch, Plan};
use crate::stream::{Sink, Source, Stream, from_processes};
use std::io;
use tandem_shm::fifo::{Consumer, Producer};
use tandem_shm::region::{Fifo, Region};

/// `WORDS` words of payload that begin with the number of the message.
struct From<const WORDS: usize> {
    producer: Producer<'static, [u32; WORDS]>,
    message: [u32; WORDS],
}

impl<const WORDS: usize> Source for From<WORDS> {
    #[inline]
    fn send(&mut self, k: u32) -> bool {
        self.message[0] = k;
        self.producer.send(&self.message).is_ok()
    }
}

impl<const WORDS: usize> Sink for Consumer<'static, [u32; WORDS]> {
    #[inline]
    fn receive(&mut self) -> Option<u32> {
        let message = Consumer::receive(self).ok()??;
        Some(std::hint::black_box(&message)[0])
    }
}

/// Messages of `WORDS` words, copied in and out, in chunks of `chunk`, from one process or two
/// (`WAYS`) to one, by a channel of `SLOTS` slots each.
///
/// # Errors
/// As [`from_processes`].
pub fn messages<const WORDS: usize, const SLOTS: usize, const WAYS: usize>(
    plan: &Plan,
    chunk: usize,
) -> io::Result<Batch> {
    let first = Region::<Fifo<[u32; WORDS], SLOTS>>::first("first");
    let ways = [first, first.then("second")];
    let layout = ways[WAYS - 1].end();
    let (shared, map) = lmu::shared(layout)?;
    let stream = Stream {
        chunk,
        payload_bytes: 4 * WORDS as u64,
        own_bytes: lmu::bytes(layout),
    };
    from_processes::<_, _, WAYS>(
        plan,
        &shared,
        stream,
        |way| From {
            producer: ways[way]
                .producer(&map, lmu::announce(&map, way, 1))
                .expect("it is free"),
            message: [7; WORDS],
        },
        |way| {
            let consumer = ways[way].consumer(&map, lmu::announce(&map, 2, 1));
            consumer.expect("it is free")
        },
    )
}
