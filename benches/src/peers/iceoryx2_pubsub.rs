//! iceoryx2 publish–subscribe, polled.

use crate::harness::{Batch, End, Plan, between_processes};
use crate::peers::iceoryx2_event::node;
use crate::shared::Shared;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use std::hint::spin_loop;
use std::io;

struct PublishSubscribe {
    out: Publisher<ipc::Service, u32, ()>,
    inward: Subscriber<ipc::Service, u32, ()>,
    _node: Node<ipc::Service>,
}

impl PublishSubscribe {
    fn open(run: u32, out: &str, inward: &str) -> Self {
        let open = || -> Result<Self, Box<dyn core::error::Error>> {
            let node = node()?;
            let service = |way: &str| {
                let name = ServiceName::new(&format!("tandem-bench/{run}/{way}"))?;
                let service = node.service_builder(&name).publish_subscribe::<u32>();
                Ok::<_, Box<dyn core::error::Error>>(service.open_or_create()?)
            };
            let inward = service(inward)?.subscriber_builder().create()?;
            Ok(Self {
                out: service(out)?.publisher_builder().create()?,
                inward,
                _node: node,
            })
        };
        open().unwrap_or_else(|error| panic!("iceoryx2 publish-subscribe cannot start: {error}"))
    }
}

impl End for PublishSubscribe {
    fn send(&mut self, stamp: u32) {
        if let Ok(sample) = self.out.loan_uninit() {
            let _delivered = sample.write_payload(stamp).send();
        }
    }

    fn receive(&mut self) -> u32 {
        loop {
            if let Ok(Some(sample)) = self.inward.receive() {
                return *sample;
            }
            spin_loop();
        }
    }
}

/// Zero-copy publish–subscribe of iceoryx2 with its default settings; the subscriber polls.
///
/// # Errors
/// As [`between_processes`].
pub fn iceoryx2_pubsub(plan: &Plan) -> io::Result<Batch> {
    let run = crate::harness::next_run();
    let end = |out, inward| move |_: &Shared| PublishSubscribe::open(run, out, inward);
    between_processes(plan, 0, end("there", "back"), end("back", "there"))
}
