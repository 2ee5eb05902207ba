//! Channels between the threads of one process: crossbeam's and rtrb's.

use crate::harness::{Batch, End, Plan, between_threads};
use std::hint::spin_loop;
use std::io;
use std::sync::Arc;

struct Crossbeam {
    out: Arc<crossbeam::queue::ArrayQueue<u32>>,
    inward: Arc<crossbeam::queue::ArrayQueue<u32>>,
}

impl End for Crossbeam {
    fn send(&mut self, stamp: u32) {
        self.out.force_push(stamp);
    }

    fn receive(&mut self) -> u32 {
        loop {
            if let Some(stamp) = self.inward.pop() {
                return stamp;
            }
            spin_loop();
        }
    }
}

/// crossbeam's bounded queue, polled.
///
/// # Errors
/// As [`between_threads`].
pub fn crossbeam_channel(plan: &Plan) -> io::Result<Batch> {
    between_threads(plan, || {
        let [there, back] = [0, 0].map(|_| Arc::new(crossbeam::queue::ArrayQueue::new(16)));
        let near = Crossbeam {
            out: there.clone(),
            inward: back.clone(),
        };
        let far = Crossbeam {
            out: back,
            inward: there,
        };
        (near, far)
    })
}

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
