//! What is measured, by name.

use crate::harness::Plan;
use crate::{floor, peers, tandem};
use std::io;
use tandem_board_host::BareSystem;
use tandem_shm::wait::WaitPolicy;

/// How the receiver waits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Group {
    /// It looks again and again, on a CPU of its own.
    Spin,
    /// It sleeps in the kernel until it is woken.
    Sleep,
}

impl Group {
    /// As it stands in names and on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Spin => "spin",
            Self::Sleep => "sleep",
        }
    }

    /// Round trips of one batch: some 10 ms, so that cases take turns while the machine's mood
    /// lasts.
    #[must_use]
    pub const fn rounds(self) -> usize {
        match self {
            Self::Spin => 20_000,
            Self::Sleep => 250,
        }
    }
}

/// What a case runs on.
pub type Run = fn(&BareSystem, &Plan) -> io::Result<Vec<u32>>;

/// One way of passing 4 bytes.
#[derive(Clone, Copy)]
pub struct Case {
    /// How the receiver waits.
    pub group: Group,
    /// Name within the group; `floor` is what the others are compared with.
    pub name: &'static str,
    /// What it is, for the table.
    pub what: &'static str,
    /// One batch: all one-way times in ticks.
    pub run: Run,
}

/// All cases; the floor comes first in its group.
pub const CASES: [Case; 13] = [
    Case {
        group: Group::Spin,
        name: "floor",
        what: "a cache line between two processes",
        run: |_, plan| floor::cache_line(plan),
    },
    Case {
        group: Group::Spin,
        name: "tandem",
        what: "channel, mailbox signal, running handler",
        run: |system, plan| tandem::sync(system, plan, WaitPolicy::Spin),
    },
    Case {
        group: Group::Spin,
        name: "iceoryx2-pubsub",
        what: "publish-subscribe, polled",
        run: |_, plan| peers::iceoryx2_pubsub(plan),
    },
    Case {
        group: Group::Spin,
        name: "crossbeam",
        what: "ArrayQueue between threads",
        run: |_, plan| peers::crossbeam_channel(plan),
    },
    Case {
        group: Group::Spin,
        name: "rtrb",
        what: "ring buffer between threads",
        run: |_, plan| peers::rtrb(plan),
    },
    Case {
        group: Group::Sleep,
        name: "floor",
        what: "futex on a shared word",
        run: |_, plan| floor::futex(plan),
    },
    Case {
        group: Group::Sleep,
        name: "tandem",
        what: "channel, mailbox signal, doorbell, running handler",
        run: |system, plan| tandem::sync(system, plan, WaitPolicy::Sleep),
    },
    Case {
        group: Group::Sleep,
        name: "tandem-adaptive",
        what: "the same, looking 2000 times before it sleeps",
        run: |system, plan| tandem::sync(system, plan, WaitPolicy::SpinThenSleep { spins: 2000 }),
    },
    Case {
        group: Group::Sleep,
        name: "iceoryx2-event",
        what: "event with default settings",
        run: |_, plan| peers::iceoryx2_event(plan),
    },
    Case {
        group: Group::Sleep,
        name: "eventfd",
        what: "eventfd beside shared memory",
        run: |_, plan| floor::eventfd(plan),
    },
    Case {
        group: Group::Sleep,
        name: "pipe",
        what: "two pipes",
        run: |_, plan| peers::pipe(plan),
    },
    Case {
        group: Group::Sleep,
        name: "unix-socket",
        what: "a pair of SOCK_SEQPACKET",
        run: |_, plan| peers::unix_socket(plan),
    },
    Case {
        group: Group::Sleep,
        name: "message-queue",
        what: "two POSIX message queues",
        run: |_, plan| peers::message_queue(plan),
    },
];
