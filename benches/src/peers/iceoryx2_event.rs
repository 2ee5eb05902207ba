//! iceoryx2 events: the receiver sleeps until it is notified.

use crate::harness::{Batch, End, Plan, between_processes, next_run};
use crate::open_loop::at_fixed_rate;
use crate::peers::iceoryx2_semaphore::BySemaphore;
use crate::shared::Shared;
use iceoryx2::config::Config;
use iceoryx2::node::NodeCreationFailure;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::*;
use iceoryx2::service::Service;
use iceoryx2_bb_system_types::path::Path;
use std::io;
use std::sync::atomic::{AtomicU32, Ordering};

/// Where its files go: the benchmark's own `/dev/shm`, so that nothing is left behind.
const ROOT: &[u8] = b"/dev/shm/iceoryx2";

/// A node with default settings, but for the place of its files and for signals: Ctrl-C is the
/// benchmark's.
pub(super) fn node<S: Service>() -> Result<Node<S>, NodeCreationFailure> {
    set_log_level(LogLevel::Fatal);
    let mut config = Config::default();
    if let Ok(root) = Path::new(ROOT) {
        config.global.set_root_path(&root);
    }
    NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<S>()
}

/// The ends of two events, one in each direction (of the chain: to the next, from the last), with
/// the stamp in shared memory beside it.
struct EventEnds<S: Service> {
    out: Notifier<S>,
    inward: Listener<S>,
    stamp_out: &'static AtomicU32,
    stamp_in: &'static AtomicU32,
    _node: Node<S>,
}

impl<S: Service> EventEnds<S> {
    /// `lean`: room for one notifier and one listener, and one event id.
    fn open(run: u32, lean: bool, ways: [&str; 2], stamps: [&'static AtomicU32; 2]) -> Self {
        let open = || -> Result<Self, Box<dyn core::error::Error>> {
            let node = node::<S>()?;
            let service = |way: &str| {
                let name = ServiceName::new(&format!("tandem-bench/{run}/event/{way}"))?;
                let mut builder = node.service_builder(&name).event();
                if lean {
                    builder = builder.max_notifiers(1).max_listeners(1).max_nodes(2);
                    builder = builder.event_id_max_value(0);
                }
                Ok::<_, Box<dyn core::error::Error>>(builder.open_or_create()?)
            };
            Ok(Self {
                inward: service(ways[1])?.listener_builder().create()?,
                out: service(ways[0])?.notifier_builder().create()?,
                stamp_out: stamps[0],
                stamp_in: stamps[1],
                _node: node,
            })
        };
        open().unwrap_or_else(|error| panic!("iceoryx2 event cannot start: {error}"))
    }
}

impl<S: Service> End for EventEnds<S> {
    fn send(&mut self, stamp: u32) {
        self.stamp_out.store(stamp, Ordering::Release);
        let _notified = self.out.notify();
    }

    fn receive(&mut self) -> u32 {
        let mut came = false;
        while !came {
            let _waited = self.inward.blocking_wait(|_| came = true);
        }
        self.stamp_in.load(Ordering::Acquire)
    }
}

fn event<S: Service>(plan: &Plan, lean: bool) -> io::Result<Batch> {
    let run = next_run();
    let end = |ways, words: [usize; 2]| {
        move |shared: &Shared| {
            EventEnds::<S>::open(run, lean, ways, words.map(|word| shared.line(word)))
        }
    };
    between_processes(
        plan,
        128,
        end(["there", "back"], [0, 2]),
        end(["back", "there"], [2, 0]),
    )
}

/// An iceoryx2 event to a sleeping listener with default settings: a Unix datagram socket wakes.
///
/// # Errors
/// As [`between_processes`].
pub fn iceoryx2_event(plan: &Plan) -> io::Result<Batch> {
    event::<ipc::Service>(plan, false)
}

/// The same with the leanest settings, woken by the semaphore of iceoryx2-cal.
///
/// # Errors
/// As [`between_processes`].
pub fn iceoryx2_event_tuned(plan: &Plan) -> io::Result<Batch> {
    event::<BySemaphore>(plan, true)
}

/// Events with default settings at a fixed rate.
///
/// # Errors
/// As [`at_fixed_rate`].
pub fn iceoryx2_at_rate(plan: &Plan) -> io::Result<Batch> {
    let run = next_run();
    let end = |ways, words: [usize; 2]| {
        move |shared: &Shared| {
            EventEnds::<ipc::Service>::open(run, false, ways, words.map(|word| shared.line(word)))
        }
    };
    let near = end(["there", "back"], [0, 2]);
    at_fixed_rate(plan, 128, near, end(["back", "there"], [2, 0]))
}
