//! iceoryx2: events, publish-subscribe, blackboard, request and response.

use crate::harness::{Batch, BatchPlan, End, between_processes, between_unlike, next_run, polled};
use crate::open_loop::at_fixed_rate;
use crate::payload::{fill, sum_from};
use crate::peers::iceoryx2_semaphore::BySemaphore;
use crate::shared::SharedPage;
use crate::stream::{Stream, from_processes};
use core::mem::MaybeUninit;
use iceoryx2::active_request::ActiveRequest;
use iceoryx2::config::Config;
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::Client;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::sample_mut_uninit::SampleMutUninit;
use iceoryx2::service::Service;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use iceoryx2_bb_system_types::path::Path;
use std::cell::RefCell;
use std::io;
use std::rc::Rc;
use std::sync::atomic::Ordering::{Acquire, Release};

type Error = Box<dyn core::error::Error>;
type Ipc = ipc::Service;

/// Folder of its files: the benchmark's private `/dev/shm`, so that no files remain.
const ROOT: &[u8] = b"/dev/shm/iceoryx2";

/// Calls `open` with a node of default settings, except for the place of its files and for signals.
/// The benchmark itself handles Ctrl-C.
fn with_node<S: Service, T>(open: impl FnOnce(Node<S>) -> Result<T, Error>) -> T {
    let start = || {
        set_log_level(LogLevel::Fatal);
        let mut config = Config::default();
        config.global.set_root_path(&Path::new(ROOT)?);
        let node = NodeBuilder::new().config(&config);
        open(
            node.signal_handling_mode(SignalHandlingMode::Disabled)
                .create::<S>()?,
        )
    };
    start().unwrap_or_else(|error| panic!("iceoryx2 cannot start: {error}"))
}

fn name(run: u32, way: usize) -> Result<ServiceName, Error> {
    Ok(ServiceName::new(&format!("tandem-bench/{run}/{way}"))?)
}

/// Events in both directions: a function that notifies the other end, and one that waits for it.
/// `lean`: room for one notifier and one listener, and one event id.
fn events<S: Service>(
    run: u32,
    lean: bool,
    ways: [usize; 2],
) -> (impl FnMut() + use<S>, impl FnMut() + use<S>) {
    with_node::<S, _>(|node| {
        let service = |way| {
            let mut builder = node.service_builder(&name(run, way)?).event();
            if lean {
                builder = builder.max_notifiers(1).max_listeners(1).max_nodes(2);
                builder = builder.event_id_max_value(0);
            }
            Ok::<_, Error>(builder.open_or_create()?)
        };
        let listener = service(ways[1])?.listener_builder().create()?;
        let notifier = service(ways[0])?.notifier_builder().create()?;
        let notify = move || {
            let _notified = notifier.notify();
        };
        let wait = move || {
            let _open = &node;
            let mut came = false;
            while !came {
                let _waited = listener.blocking_wait(|_| came = true);
            }
        };
        Ok((notify, wait))
    })
}

/// Events of default settings, for data that lie elsewhere.
pub(crate) fn bells(run: u32, ways: [usize; 2]) -> (impl FnMut(), impl FnMut()) {
    events::<Ipc>(run, false, ways)
}

/// Events in both directions, with the stamp in shared memory beside them.
fn event_ends<S: Service>(
    run: u32,
    lean: bool,
    shared: &SharedPage,
    ways: [usize; 2],
) -> impl End + use<S> {
    let [stamp_out, stamp_in] = ways.map(|way| shared.line(2 * way));
    let (mut notify, mut wait) = events::<S>(run, lean, ways);
    let send = move |stamp| {
        stamp_out.store(stamp, Release);
        notify();
    };
    let receive = move || {
        wait();
        stamp_in.load(Acquire)
    };
    (send, receive)
}

/// An event to a sleeping listener with default settings: a Unix datagram socket wakes it.
pub(crate) fn event(plan: &BatchPlan) -> io::Result<Batch> {
    let run = next_run();
    between_processes(plan, |shared, ways| {
        event_ends::<Ipc>(run, false, shared, ways)
    })
}

/// An event to a sleeping listener with the leanest settings: iceoryx2-cal's semaphore wakes it.
pub(crate) fn event_tuned(plan: &BatchPlan) -> io::Result<Batch> {
    let run = next_run();
    between_processes(plan, |shared, ways| {
        event_ends::<BySemaphore>(run, true, shared, ways)
    })
}

/// Events with default settings at a fixed rate.
pub(crate) fn event_at_rate(plan: &BatchPlan) -> io::Result<Batch> {
    let run = next_run();
    at_fixed_rate(plan, |shared, ways| {
        event_ends::<Ipc>(run, false, shared, ways)
    })
}

/// Settings of a publish-subscribe service.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Settings {
    /// The library's default: room for 8 subscribers, a buffer of 2 that overflows safely.
    Default,
    /// One publisher, one subscriber, one sample in the buffer and one in use, no overflow, no
    /// history.
    Lean,
    /// A long buffer that does not overflow: the publisher waits when it is full.
    Lossless,
}

impl Settings {
    fn service(
        self,
        node: &Node<Ipc>,
        name: &ServiceName,
    ) -> Result<PortFactory<Ipc, [u32], ()>, Error> {
        let builder = node.service_builder(name).publish_subscribe::<[u32]>();
        let buffer = match self {
            Self::Default => return Ok(builder.open_or_create()?),
            Self::Lean => 1,
            Self::Lossless => 256,
        };
        let builder = builder.max_publishers(1).max_subscribers(1).max_nodes(2);
        let builder = builder.enable_safe_overflow(false).history_size(0);
        let builder = builder.subscriber_max_borrowed_samples(1);
        Ok(builder
            .subscriber_max_buffer_size(buffer)
            .open_or_create()?)
    }

    fn publisher(self, service: &PortFactory<Ipc, [u32], ()>, words: usize) -> Result<Out, Error> {
        let builder = service.publisher_builder().initial_max_slice_len(words);
        let builder = match self {
            Self::Default => builder,
            Self::Lean => builder.max_loaned_samples(1),
            Self::Lossless => {
                builder.backpressure_strategy(BackpressureStrategy::RetryUntilDelivered)
            }
        };
        let mut out = Out {
            publisher: builder.create()?,
            lent: None,
            words,
        };
        out.lend();
        Ok(out)
    }
}

/// A publisher. As in iceoryx2's own benchmark it loans the next sample before the timed send,
/// which fills and delivers it.
struct Out {
    publisher: Publisher<Ipc, [u32], ()>,
    lent: Option<SampleMutUninit<Ipc, [MaybeUninit<u32>], ()>>,
    words: usize,
}

impl Out {
    fn lend(&mut self) {
        self.lent = self.publisher.loan_slice_uninit(self.words).ok();
    }

    /// Fills and delivers the loaned sample. Returns whether a subscriber received it.
    #[inline]
    fn deliver(&mut self, stamp: u32) -> bool {
        let sent = self.lent.take().map(|mut sample| {
            fill(sample.payload_mut(), stamp);
            // SAFETY: `fill` has written all words.
            unsafe { sample.assume_init() }.send()
        });
        matches!(sent, Some(Ok(receivers)) if receivers > 0)
    }
}

/// Reads all words of the next sample and returns its stamp.
#[inline]
fn try_receive(subscriber: &Subscriber<Ipc, [u32], ()>) -> Option<u32> {
    let sample = subscriber.receive().ok().flatten()?;
    Some(sum_from(&sample))
}

/// Zero-copy publish-subscribe of `words` words; the subscriber polls.
pub(crate) fn publish_subscribe(
    plan: &BatchPlan,
    settings: Settings,
    words: usize,
) -> io::Result<Batch> {
    let run = next_run();
    between_processes(plan, |_, [out, inward]| {
        with_node(|node| {
            let inward = settings.service(&node, &name(run, inward)?)?;
            let inward = inward.subscriber_builder().create()?;
            let out = settings.service(&node, &name(run, out)?)?;
            let mut out = settings.publisher(&out, words)?;
            let send = move |stamp| {
                out.deliver(stamp);
                // Not timed, because the message was already sent.
                out.lend();
            };
            let receive = move || {
                let _open = &node;
                polled(|| try_receive(&inward))
            };
            Ok((send, receive))
        })
    })
}

/// Payloads of `bytes`, a multiple of 4, with the leanest settings: each word is written into the
/// loaned sample, and read in place.
pub(crate) fn size(plan: &BatchPlan, bytes: usize) -> io::Result<Batch> {
    let batch = publish_subscribe(plan, Settings::Lean, bytes / 4)?;
    Ok(batch.carrying(bytes as u64).without_facts())
}

/// A stream of messages of 8 bytes that loses nothing: the publisher waits when the buffer is full.
pub(crate) fn stream(plan: &BatchPlan) -> io::Result<Batch> {
    const SETTINGS: Settings = Settings::Lossless;
    let name = &name(next_run(), 0).map_err(|error| io::Error::other(error.to_string()))?;
    let stream = Stream {
        chunk: 1024,
        payload_bytes: 8,
    };
    let sender = |_| {
        with_node(|node| {
            let mut out = SETTINGS.publisher(&SETTINGS.service(&node, name)?, 2)?;
            Ok(move |k| {
                let _open = &node;
                if out.lent.is_none() {
                    out.lend();
                }
                // Delivered to no subscriber: the buffer was full.
                out.deliver(k)
            })
        })
    };
    let receiver = |_| {
        with_node(|node| {
            let inward = SETTINGS
                .service(&node, name)?
                .subscriber_builder()
                .create()?;
            Ok(move || {
                let _open = &node;
                try_receive(&inward)
            })
        })
    };
    from_processes::<_, _, 1>(plan, &SharedPage::new()?, stream, sender, receiver)
}

/// A value of 4 bytes on the blackboard; the reader polls. Each direction has an entry, which only
/// its writer changes.
pub(crate) fn blackboard(plan: &BatchPlan) -> io::Result<Batch> {
    const KEY: u64 = 1;
    let run = next_run();
    between_processes(plan, |shared, [out, inward]| {
        with_node::<Ipc, _>(|node| {
            let service = node.service_builder(&name(run, out)?);
            let service = service.blackboard_creator::<u64>().add::<u32>(KEY, 0);
            let writer = service.create()?.writer_builder().create()?;
            // Both ends have created their entries.
            shared.meet(2);
            let service = node.service_builder(&name(run, inward)?);
            let reader = service
                .blackboard_opener::<u64>()
                .open()?
                .reader_builder()
                .create()?;
            let (out, inward) = (writer.entry::<u32>(&KEY)?, reader.entry::<u32>(&KEY)?);
            let mut last = 0;
            // Zero means "nothing yet".
            let send = move |stamp: u32| out.update_with_copy(stamp | 1);
            let receive = move || {
                let _open = (&node, &writer, &reader);
                last = polled(|| Some(*inward.get()).filter(|stamp| *stamp != last));
                last
            };
            Ok((send, receive))
        })
    })
}

type Asks = Client<Ipc, u32, (), u32, ()>;
type Asked = ActiveRequest<Ipc, u32, (), u32, ()>;
type Pending = PendingResponse<Ipc, u32, (), u32, ()>;

/// 4 bytes as a request, and 4 bytes as its response; both ends poll.
pub(crate) fn request(plan: &BatchPlan) -> io::Result<Batch> {
    let run = next_run();
    let service = |node: &Node<Ipc>| {
        let service = node.service_builder(&name(run, 0)?);
        Ok::<_, Error>(service.request_response::<u32, u32>().open_or_create()?)
    };
    let asks = |shared: &SharedPage| {
        with_node(|node| {
            let client: Asks = service(&node)?.client_builder().create()?;
            // Both ends have their ports before the first request.
            shared.meet(2);
            let pending: Rc<RefCell<Option<Pending>>> = Rc::default();
            let answer = pending.clone();
            let send = move |stamp| *pending.borrow_mut() = client.send_copy(stamp).ok();
            let receive = move || {
                let (_open, answer) = (&node, answer.borrow());
                polled(|| Some(*answer.as_ref()?.receive().ok()??))
            };
            Ok((send, receive))
        })
    };
    let answers = |shared: &SharedPage| {
        with_node(|node| {
            let server = service(&node)?.server_builder().create()?;
            shared.meet(2);
            let request = Rc::new(RefCell::new(None));
            let asked = request.clone();
            let send = move |stamp| {
                let request: Option<Asked> = asked.borrow_mut().take();
                let _sent = request.map(|request| request.send_copy(stamp));
            };
            let receive = move || {
                let _open = &node;
                let came = polled(|| server.receive().ok().flatten());
                let stamp = *came;
                *request.borrow_mut() = Some(came);
                stamp
            };
            Ok((send, receive))
        })
    };
    between_unlike(plan, asks, answers)
}
