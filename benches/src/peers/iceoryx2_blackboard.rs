//! iceoryx2's blackboard, polled: one entry in each direction, which only its writer changes.

use crate::harness::{Batch, End, Plan, between_processes, next_run};
use crate::peers::iceoryx2_event::node;
use crate::shared::Shared;
use iceoryx2::port::reader::{EntryHandle, Reader};
use iceoryx2::port::writer::{EntryHandleMut, Writer};
use iceoryx2::prelude::*;
use std::hint::spin_loop;
use std::io;

const KEY: u64 = 1;

struct Blackboard {
    out: EntryHandleMut<ipc::Service, u64, u32>,
    inward: EntryHandle<ipc::Service, u64, u32>,
    last: u32,
    _ports: (Writer<ipc::Service, u64>, Reader<ipc::Service, u64>),
    _node: Node<ipc::Service>,
}

impl Blackboard {
    fn open(shared: &Shared, run: u32, out: &str, inward: &str) -> Self {
        let open = || -> Result<Self, Box<dyn core::error::Error>> {
            let node = node::<ipc::Service>()?;
            let name = |way: &str| ServiceName::new(&format!("tandem-bench/{run}/{way}"));
            let service = node.service_builder(&name(out)?);
            let service = service.blackboard_creator::<u64>().add::<u32>(KEY, 0);
            let writer = service.create()?.writer_builder().create()?;
            // Both have created theirs.
            shared.meet(2);
            let service = node.service_builder(&name(inward)?);
            let service = service.blackboard_opener::<u64>().open()?;
            let reader = service.reader_builder().create()?;
            Ok(Self {
                out: writer.entry::<u32>(&KEY)?,
                inward: reader.entry::<u32>(&KEY)?,
                last: 0,
                _ports: (writer, reader),
                _node: node,
            })
        };
        open().unwrap_or_else(|error| panic!("iceoryx2 blackboard cannot start: {error}"))
    }
}

impl End for Blackboard {
    fn send(&mut self, stamp: u32) {
        // Zero means "nothing yet".
        self.out.update_with_copy(stamp | 1);
    }

    fn receive(&mut self) -> u32 {
        loop {
            let stamp = *self.inward.get();
            if stamp != self.last {
                self.last = stamp;
                return stamp;
            }
            spin_loop();
        }
    }
}

/// A value of 4 bytes on iceoryx2's blackboard; the reader polls.
///
/// # Errors
/// As [`between_processes`].
pub fn iceoryx2_blackboard(plan: &Plan) -> io::Result<Batch> {
    let run = next_run();
    let end = |out, inward| move |shared: &Shared| Blackboard::open(shared, run, out, inward);
    between_processes(plan, 0, end("there", "back"), end("back", "there"))
}
