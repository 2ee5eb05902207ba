//! iceoryx2 publish–subscribe of large payloads, in place, polled.

use crate::harness::{Batch, End, Plan, between_processes, next_run};
use crate::peers::iceoryx2_event::node;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use std::hint::spin_loop;
use std::io;

struct Slices {
    out: Publisher<ipc::Service, [u32], ()>,
    inward: Subscriber<ipc::Service, [u32], ()>,
    words: usize,
    _node: Node<ipc::Service>,
}

impl Slices {
    /// Of each way one publisher and one subscriber, so that no memory is taken for more.
    fn open(run: u32, words: usize, out: &str, inward: &str) -> Self {
        let open = || -> Result<Self, Box<dyn core::error::Error>> {
            let node = node::<ipc::Service>()?;
            let service = |way: &str| {
                let name = ServiceName::new(&format!("tandem-bench/{run}/{way}"))?;
                let builder = node.service_builder(&name).publish_subscribe::<[u32]>();
                let builder = builder.max_publishers(1).max_subscribers(1).max_nodes(2);
                Ok::<_, Box<dyn core::error::Error>>(builder.open_or_create()?)
            };
            let inward = service(inward)?.subscriber_builder().create()?;
            let out = service(out)?;
            let out = out.publisher_builder();
            let slices = Self {
                out: out.initial_max_slice_len(words).create()?,
                inward,
                words,
                _node: node,
            };
            // Those that the publisher may hold at once are filled, so that their pages are there.
            let mut filled = vec![];
            while let Ok(sample) = slices.out.loan_slice_uninit(words) {
                filled.push(sample.write_from_fn(|at| at as u32));
            }
            drop(filled);
            Ok(slices)
        };
        open().unwrap_or_else(|error| panic!("iceoryx2 publish-subscribe cannot start: {error}"))
    }
}

impl End for Slices {
    fn send(&mut self, stamp: u32) {
        if let Ok(mut sample) = self.out.loan_slice_uninit(self.words) {
            sample.payload_mut()[self.words - 1].write(stamp);
            // SAFETY: words in shared memory, which holds zeros or what was written before: any
            // bits make a `u32`.
            let _delivered = unsafe { sample.assume_init() }.send();
        }
    }

    fn receive(&mut self) -> u32 {
        loop {
            if let Ok(Some(sample)) = self.inward.receive() {
                return sample[self.words - 1];
            }
            spin_loop();
        }
    }
}

/// Payloads of `bytes`, a multiple of 4: lent, stamped at their end, read in place.
///
/// # Errors
/// As [`between_processes`].
pub fn iceoryx2_size(plan: &Plan, bytes: usize) -> io::Result<Batch> {
    let run = next_run();
    let end = |out, inward| move |_: &_| Slices::open(run, bytes / 4, out, inward);
    let batch = between_processes(plan, 0, end("there", "back"), end("back", "there"))?;
    Ok(batch.carrying(bytes as u64).without_facts())
}
