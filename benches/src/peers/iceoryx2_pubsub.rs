//! iceoryx2 publish–subscribe, polled: with default settings, with the leanest ones, and as a
//! stream that loses nothing.

use crate::harness::{Batch, End, Plan, between_processes, next_run};
use crate::peers::iceoryx2_event::node;
use crate::shared::Shared;
use crate::stream::{self, Sink, Source, Stream};
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use std::hint::spin_loop;
use std::io;

type Error = Box<dyn core::error::Error>;

/// What is asked of a service.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Settings {
    /// As the library comes: room for 8 subscribers, a buffer of 2 that overflows safely.
    Default,
    /// One publisher, one subscriber, one sample in the buffer and one in hand, no overflow, no
    /// history.
    Lean,
    /// A long buffer that does not overflow: the publisher waits when it is full.
    Lossless,
}

struct PublishSubscribe {
    out: Option<Publisher<ipc::Service, u32, ()>>,
    inward: Option<Subscriber<ipc::Service, u32, ()>>,
    _node: Node<ipc::Service>,
}

impl PublishSubscribe {
    fn open(settings: Settings, run: u32, out: Option<&str>, inward: Option<&str>) -> Self {
        let open = || -> Result<Self, Error> {
            let node = node::<ipc::Service>()?;
            let service = |way: &str| {
                let name = ServiceName::new(&format!("tandem-bench/{run}/{way}"))?;
                let builder = node.service_builder(&name).publish_subscribe::<u32>();
                let lean = |buffer| {
                    let builder = node.service_builder(&name).publish_subscribe::<u32>();
                    let builder = builder.max_publishers(1).max_subscribers(1).max_nodes(2);
                    let builder = builder.enable_safe_overflow(false).history_size(0);
                    let builder = builder.subscriber_max_borrowed_samples(1);
                    builder.subscriber_max_buffer_size(buffer)
                };
                let service = match settings {
                    Settings::Default => builder.open_or_create()?,
                    Settings::Lean => lean(1).open_or_create()?,
                    Settings::Lossless => lean(256).open_or_create()?,
                };
                Ok::<_, Error>(service)
            };
            let inward = inward
                .map(|way| Ok::<_, Error>(service(way)?.subscriber_builder().create()?))
                .transpose()?;
            let out = out.map(|way| {
                let service = service(way)?;
                let builder = service.publisher_builder();
                let builder = match settings {
                    Settings::Default => builder,
                    Settings::Lean => builder.max_loaned_samples(1),
                    Settings::Lossless => {
                        builder.backpressure_strategy(BackpressureStrategy::RetryUntilDelivered)
                    }
                };
                Ok::<_, Error>(builder.create()?)
            });
            Ok(Self {
                out: out.transpose()?,
                inward,
                _node: node,
            })
        };
        open().unwrap_or_else(|error| panic!("iceoryx2 publish-subscribe cannot start: {error}"))
    }

    #[inline]
    fn try_receive(&mut self) -> Option<u32> {
        let sample = self.inward.as_ref()?.receive();
        sample.ok().flatten().map(|sample| *sample)
    }
}

impl End for PublishSubscribe {
    fn send(&mut self, stamp: u32) {
        if let Some(sample) = self.out.as_ref().and_then(|out| out.loan_uninit().ok()) {
            let _delivered = sample.write_payload(stamp).send();
        }
    }

    fn receive(&mut self) -> u32 {
        loop {
            if let Some(stamp) = self.try_receive() {
                return stamp;
            }
            spin_loop();
        }
    }
}

fn polled(plan: &Plan, settings: Settings) -> io::Result<Batch> {
    let run = next_run();
    let end =
        |out, inward| move |_: &_| PublishSubscribe::open(settings, run, Some(out), Some(inward));
    between_processes(plan, 0, end("there", "back"), end("back", "there"))
}

/// Zero-copy publish–subscribe of iceoryx2 with its default settings; the subscriber polls.
///
/// # Errors
/// As [`between_processes`].
pub fn iceoryx2_pubsub(plan: &Plan) -> io::Result<Batch> {
    polled(plan, Settings::Default)
}

/// The same with the leanest settings.
///
/// # Errors
/// As [`between_processes`].
pub fn iceoryx2_pubsub_tuned(plan: &Plan) -> io::Result<Batch> {
    polled(plan, Settings::Lean)
}

impl Source for PublishSubscribe {
    fn send(&mut self, k: u32) -> bool {
        let sample = self.out.as_ref().and_then(|out| out.loan_uninit().ok());
        let sent = sample.map(|sample| sample.write_payload(k).send());
        // Delivered to no subscriber: the buffer was full.
        matches!(sent, Some(Ok(receivers)) if receivers > 0)
    }
}

impl Sink for PublishSubscribe {
    fn receive(&mut self) -> Option<u32> {
        self.try_receive()
    }
}

/// A stream of messages that loses nothing: the publisher waits when the buffer is full.
///
/// # Errors
/// As [`stream::from_processes`].
pub fn iceoryx2_stream(plan: &Plan) -> io::Result<Batch> {
    let run = next_run();
    let stream = Stream {
        chunk: 1024,
        payload_bytes: 4,
        own_bytes: 0,
    };
    let open = |out, inward| move |_| PublishSubscribe::open(Settings::Lossless, run, out, inward);
    stream::from_processes::<_, _, 1>(
        plan,
        &Shared::new()?,
        stream,
        open(Some("stream"), None),
        open(None, Some("stream")),
    )
}
