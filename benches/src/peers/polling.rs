//! Peers that poll: a sequence lock between processes, and two libraries between threads.

use crate::harness::{Batch, BatchPlan, between_processes, between_threads, polled};
use crate::shared::LINE;
use crate::stream::{self, Stream};
use std::hint::spin_loop;
use std::io;
use std::sync::atomic::Ordering::{Acquire, Relaxed, Release};
use std::sync::atomic::fence;

/// 4 bytes through a sequence lock: the simplest mechanism for a newest value of several words that
/// is never torn. Count and value share a cache line.
///
/// After H.-J. Boehm, "Can seqlocks get along with programming language memory models?" (2012).
pub(crate) fn seqlock(plan: &BatchPlan) -> io::Result<Batch> {
    between_processes(plan, |shared, ways| {
        let [out, inward] = ways.map(|way| &shared.case()[2 * way * LINE..]);
        let (mut written, mut seen) = (0, 0);
        let send = move |stamp| {
            // Odd: the value is being changed. Release pairs with the fence of the reader.
            out[0].store(written + 1, Relaxed);
            fence(Release);
            out[1].store(stamp, Relaxed);
            written += 2;
            // Pairs with the Acquire of the reader.
            out[0].store(written, Release);
        };
        let receive = move || {
            polled(|| {
                let before = inward[0].load(Acquire);
                if before == seen || !before.is_multiple_of(2) {
                    return None;
                }
                let stamp = inward[1].load(Relaxed);
                // Pairs with the Release fence of the writer.
                fence(Acquire);
                if inward[0].load(Relaxed) != before {
                    return None;
                }
                seen = before;
                Some(stamp)
            })
        };
        (send, receive)
    })
}

/// rtrb's single-producer single-consumer ring.
pub(crate) fn rtrb(plan: &BatchPlan) -> io::Result<Batch> {
    let [(there, there_in), (back, back_in)] = [0; 2].map(|_| rtrb::RingBuffer::new(16));
    let ends = [(there, back_in), (back, there_in)].map(|(mut out, mut inward)| {
        let send = move |stamp: u32| {
            while out.push(stamp).is_err() {
                spin_loop();
            }
        };
        (send, move || polled(|| inward.pop().ok()))
    });
    between_threads(plan, ends)
}

/// The newest value through a triple buffer.
pub(crate) fn triple_buffer(plan: &BatchPlan) -> io::Result<Batch> {
    let [(there, there_in), (back, back_in)] = [0; 2].map(|_| triple_buffer::triple_buffer(&0));
    let ends = [(there, back_in), (back, there_in)].map(|(mut out, mut inward)| {
        let receive = move || {
            polled(|| inward.update().then_some(()));
            *inward.output_buffer()
        };
        (move |stamp| out.write(stamp), receive)
    });
    between_threads(plan, ends)
}

/// Messages of 8 bytes in a row through rtrb's ring, with as many slots as Tandem's FIFO here.
pub(crate) fn rtrb_stream(plan: &BatchPlan) -> io::Result<Batch> {
    let (mut out, mut inward) = rtrb::RingBuffer::new(512);
    let stream = Stream {
        chunk: 4096,
        payload_bytes: 8,
    };
    let send = move |k: u32| out.push(u64::from(k)).is_ok();
    let receive = move || inward.pop().ok().map(|k| k as u32);
    stream::between_threads(plan, stream, (send, receive))
}
