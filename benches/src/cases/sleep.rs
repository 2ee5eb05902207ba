//! 4 bytes one way; the receiver sleeps in the kernel until it is woken.

use super::{Case, Group};
use crate::tandem::Way;
use crate::{floor, peers, tandem};
use tandem_shm::wait::WaitPolicy;

const fn case(name: &'static str, what: &'static str, run: super::Run) -> Case {
    Case {
        group: Group::Sleep,
        name,
        what,
        rounds: 250,
        every: 1,
        run,
    }
}

/// The cases.
pub(super) const CASES: &[Case] = &[
    case("floor", "futex on a shared word", |_, plan| {
        floor::futex(plan)
    }),
    case(
        "tandem",
        "mailbox signal with its value, doorbell, running handler",
        |system, plan| tandem::sync(system, plan, WaitPolicy::Sleep, Way::Signal),
    ),
    case(
        "tandem-adaptive",
        "the same, looking 2000 times before it sleeps",
        |system, plan| {
            tandem::sync(
                system,
                plan,
                WaitPolicy::SpinThenSleep { spins: 2000 },
                Way::Signal,
            )
        },
    ),
    case("eventfd", "eventfd beside shared memory", |_, plan| {
        floor::eventfd(plan)
    }),
    case(
        "iceoryx2-event",
        "event with default settings",
        |_, plan| peers::iceoryx2_event(plan),
    ),
    case(
        "iceoryx2-event-tuned",
        "event by iceoryx2's semaphore, one id",
        |_, plan| peers::iceoryx2_event_tuned(plan),
    ),
    case("pipe", "two pipes", |_, plan| peers::pipe(plan)),
    case("unix-socket", "a pair of SOCK_SEQPACKET", |_, plan| {
        peers::unix_socket(plan)
    }),
    case("message-queue", "two POSIX message queues", |_, plan| {
        peers::message_queue(plan)
    }),
    Case {
        rounds: 1,
        every: 25,
        ..case(
            "ddsperf",
            "Cyclone DDS over loopback; its own percentiles",
            |_, plan| peers::ddsperf(plan),
        )
    },
];
