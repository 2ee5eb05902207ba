//! iceoryx2 publish–subscribe, polled: with default settings, with the leanest ones, by size of
//! payload, and as a stream that loses nothing.
//!
//! As in iceoryx2's own benchmark a publisher lends the next sample before it is timed: a send
//! fills and delivers it.

use crate::harness::{Batch, End, Plan, between_processes, next_run};
use crate::peers::iceoryx2_event::node;
use crate::shared::Shared;
use crate::stream::{self, Sink, Source, Stream};
use crate::tandem::size::{sum_from, word};
use core::mem::MaybeUninit;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::sample_mut_uninit::SampleMutUninit;
use std::hint::spin_loop;
use std::io;

type Error = Box<dyn core::error::Error>;
type Lent = SampleMutUninit<ipc::Service, [MaybeUninit<u32>], ()>;

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

/// One end; the number is the length of a payload in words.
struct PublishSubscribe {
    out: Option<Publisher<ipc::Service, [u32], ()>>,
    inward: Option<Subscriber<ipc::Service, [u32], ()>>,
    lent: Option<Lent>,
    words: usize,
    _node: Node<ipc::Service>,
}

impl PublishSubscribe {
    fn open(
        settings: Settings,
        run: u32,
        words: usize,
        out: Option<&str>,
        inward: Option<&str>,
    ) -> Self {
        let open = || -> Result<Self, Error> {
            let node = node::<ipc::Service>()?;
            let service = |way: &str| {
                let name = ServiceName::new(&format!("tandem-bench/{run}/{way}"))?;
                let builder = node.service_builder(&name).publish_subscribe::<[u32]>();
                let lean = |buffer| {
                    let builder = node.service_builder(&name).publish_subscribe::<[u32]>();
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
                let builder = service.publisher_builder().initial_max_slice_len(words);
                let builder = match settings {
                    Settings::Default => builder,
                    Settings::Lean => builder.max_loaned_samples(1),
                    Settings::Lossless => {
                        builder.backpressure_strategy(BackpressureStrategy::RetryUntilDelivered)
                    }
                };
                Ok::<_, Error>(builder.create()?)
            });
            let mut end = Self {
                out: out.transpose()?,
                inward,
                lent: None,
                words,
                _node: node,
            };
            end.lend();
            Ok(end)
        };
        open().unwrap_or_else(|error| panic!("iceoryx2 publish-subscribe cannot start: {error}"))
    }

    fn lend(&mut self) {
        let out = self.out.as_ref();
        self.lent = out.and_then(|out| out.loan_slice_uninit(self.words).ok());
    }

    /// Fills and delivers the sample that was lent; whether a subscriber got it.
    #[inline]
    fn deliver(&mut self, stamp: u32) -> bool {
        let sent = self.lent.take().map(|sample| {
            let sample = sample.write_from_fn(|at| word(stamp, at));
            sample.send()
        });
        matches!(sent, Some(Ok(receivers)) if receivers > 0)
    }

    /// The stamp of the next sample, all of whose words were read.
    #[inline]
    fn try_receive(&mut self) -> Option<u32> {
        let sample = self.inward.as_ref()?.receive().ok().flatten()?;
        Some(sum_from(sample.iter().copied()))
    }
}

impl End for PublishSubscribe {
    fn send(&mut self, stamp: u32) {
        self.deliver(stamp);
        // While the message is under way.
        self.lend();
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

fn polled(plan: &Plan, settings: Settings, words: usize) -> io::Result<Batch> {
    let run = next_run();
    let end = |out, inward| {
        move |_: &_| PublishSubscribe::open(settings, run, words, Some(out), Some(inward))
    };
    between_processes(plan, 0, end("there", "back"), end("back", "there"))
}

/// Zero-copy publish–subscribe of iceoryx2 with its default settings; the subscriber polls.
///
/// # Errors
/// As [`between_processes`].
pub fn iceoryx2_pubsub(plan: &Plan) -> io::Result<Batch> {
    polled(plan, Settings::Default, 1)
}

/// The same with the leanest settings.
///
/// # Errors
/// As [`between_processes`].
pub fn iceoryx2_pubsub_tuned(plan: &Plan) -> io::Result<Batch> {
    polled(plan, Settings::Lean, 1)
}

/// Payloads of `bytes`, a multiple of 4, with the leanest settings: each word is written into the
/// sample that was lent, and read where it lies.
///
/// # Errors
/// As [`between_processes`].
pub fn iceoryx2_size(plan: &Plan, bytes: usize) -> io::Result<Batch> {
    let batch = polled(plan, Settings::Lean, bytes / 4)?;
    Ok(batch.carrying(bytes as u64).without_facts())
}

impl Source for PublishSubscribe {
    fn send(&mut self, k: u32) -> bool {
        if self.lent.is_none() {
            self.lend();
        }
        // Delivered to no subscriber: the buffer was full.
        self.deliver(k)
    }
}

impl Sink for PublishSubscribe {
    fn receive(&mut self) -> Option<u32> {
        self.try_receive()
    }
}

/// A stream of messages of 8 bytes that loses nothing: the publisher waits when the buffer is full.
///
/// # Errors
/// As [`stream::from_processes`].
pub fn iceoryx2_stream(plan: &Plan) -> io::Result<Batch> {
    let run = next_run();
    let stream = Stream {
        chunk: 1024,
        payload_bytes: 8,
        own_bytes: 0,
    };
    let open =
        |out, inward| move |_| PublishSubscribe::open(Settings::Lossless, run, 2, out, inward);
    stream::from_processes::<_, _, 1>(
        plan,
        &Shared::new()?,
        stream,
        open(Some("stream"), None),
        open(None, Some("stream")),
    )
}
