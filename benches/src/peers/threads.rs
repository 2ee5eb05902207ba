//! Channels between the threads of one process: rtrb's queue, triple_buffer's newest value.

use crate::harness::{Batch, End, Plan, between_threads};
use crate::stream::{self, Sink, Source, Stream};
use std::hint::spin_loop;
use std::io;

struct Rtrb {
    out: rtrb::Producer<u32>,
    inward: rtrb::Consumer<u32>,
}

impl End for Rtrb {
    fn send(&mut self, stamp: u32) {
        while self.out.push(stamp).is_err() {
            spin_loop();
        }
    }

    fn receive(&mut self) -> u32 {
        loop {
            if let Ok(stamp) = self.inward.pop() {
                return stamp;
            }
            spin_loop();
        }
    }
}

/// rtrb's single-producer single-consumer ring, polled.
///
/// # Errors
/// As [`between_threads`].
pub fn rtrb(plan: &Plan) -> io::Result<Batch> {
    between_threads(plan, || {
        let (there, there_in) = rtrb::RingBuffer::new(16);
        let (back, back_in) = rtrb::RingBuffer::new(16);
        let near = Rtrb {
            out: there,
            inward: back_in,
        };
        let far = Rtrb {
            out: back,
            inward: there_in,
        };
        (near, far)
    })
}

struct Triple {
    out: triple_buffer::Input<u32>,
    inward: triple_buffer::Output<u32>,
}

impl End for Triple {
    fn send(&mut self, stamp: u32) {
        self.out.write(stamp);
    }

    fn receive(&mut self) -> u32 {
        while !self.inward.update() {
            spin_loop();
        }
        *self.inward.output_buffer()
    }
}

/// The newest value through a triple buffer, polled.
///
/// # Errors
/// As [`between_threads`].
pub fn triple_buffer(plan: &Plan) -> io::Result<Batch> {
    between_threads(plan, || {
        let [there, back] = [0, 0].map(|_| triple_buffer::triple_buffer(&0));
        let ((there, there_in), (back, back_in)) = (there, back);
        let near = Triple {
            out: there,
            inward: back_in,
        };
        let far = Triple {
            out: back,
            inward: there_in,
        };
        (near, far)
    })
}

/// Messages of 8 bytes; the queues have as many slots as Tandem's FIFO in this group.
const STREAM: Stream = Stream {
    chunk: 4096,
    payload_bytes: 8,
    own_bytes: 0,
};
const SLOTS: usize = 512;

impl Source for rtrb::Producer<u64> {
    #[inline]
    fn send(&mut self, k: u32) -> bool {
        self.push(u64::from(k)).is_ok()
    }
}

impl Sink for rtrb::Consumer<u64> {
    #[inline]
    fn receive(&mut self) -> Option<u32> {
        self.pop().ok().map(|k| k as u32)
    }
}

/// A stream of 8 bytes each through rtrb's ring.
///
/// # Errors
/// As [`stream::between_threads`].
pub fn rtrb_stream(plan: &Plan) -> io::Result<Batch> {
    stream::between_threads(plan, STREAM, || rtrb::RingBuffer::new(SLOTS))
}
