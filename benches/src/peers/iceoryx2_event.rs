//! iceoryx2 events: the receiver sleeps until it is notified.

use crate::harness::{Batch, End, Plan, between_processes};
use crate::shared::Shared;
use iceoryx2::config::Config;
use iceoryx2::node::NodeCreationFailure;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::*;
use iceoryx2_bb_system_types::path::Path;
use std::io;
use std::sync::atomic::{AtomicU32, Ordering};

/// Where its files go: the benchmark's own `/dev/shm`, so that nothing is left behind.
const ROOT: &[u8] = b"/dev/shm/iceoryx2";

/// A node with default settings, but for the place of its files and for signals: Ctrl-C is the
/// benchmark's.
pub(super) fn node() -> Result<Node<ipc::Service>, NodeCreationFailure> {
    set_log_level(LogLevel::Fatal);
    let mut config = Config::default();
    if let Ok(root) = Path::new(ROOT) {
        config.global.set_root_path(&root);
    }
    NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()
}

struct Event {
    out: Notifier<ipc::Service>,
    inward: Listener<ipc::Service>,
    stamp_out: &'static AtomicU32,
    stamp_in: &'static AtomicU32,
    _node: Node<ipc::Service>,
}

impl Event {
    fn open(run: u32, ways: [&str; 2], stamps: [&'static AtomicU32; 2]) -> Self {
        let open = || -> Result<Self, Box<dyn core::error::Error>> {
            let node = node()?;
            let service = |way: &str| {
                let name = ServiceName::new(&format!("tandem-bench/{run}/event/{way}"))?;
                let service = node.service_builder(&name).event();
                Ok::<_, Box<dyn core::error::Error>>(service.open_or_create()?)
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

impl End for Event {
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

/// An iceoryx2 event to a sleeping listener, with the stamp in shared memory beside it.
///
/// # Errors
/// As [`between_processes`].
pub fn iceoryx2_event(plan: &Plan) -> io::Result<Batch> {
    let run = crate::harness::next_run();
    let end = |ways, words: [usize; 2]| {
        move |shared: &Shared| Event::open(run, ways, words.map(|word| shared.line(word)))
    };
    between_processes(
        plan,
        128,
        end(["there", "back"], [0, 2]),
        end(["back", "there"], [2, 0]),
    )
}
