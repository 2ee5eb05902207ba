//! 4 bytes one way; both ends share one CPU, so that the sender has to stop for the receiver to
//! run.

use super::{Case, Group};
use crate::tandem::Way;
use crate::{floor, peers, tandem};
use tandem_shm::wait::WaitPolicy;

const fn case(name: &'static str, what: &'static str, rounds: usize, run: super::Run) -> Case {
    Case {
        group: Group::OneCpu,
        name,
        what,
        rounds,
        every: 1,
        run,
    }
}

const ROUNDS: usize = 500;

/// The cases.
pub(super) const CASES: &[Case] = &[
    case("floor", "futex on a shared word", ROUNDS, |_, plan| {
        floor::futex(&plan.on_one_cpu())
    }),
    case(
        "tandem",
        "mailbox signal with its value, doorbell, running handler",
        ROUNDS,
        |system, plan| tandem::sync(system, &plan.on_one_cpu(), WaitPolicy::Sleep, Way::Signal),
    ),
    case(
        "tandem-adaptive",
        "the same, looking 2000 times before it sleeps",
        ROUNDS,
        |system, plan| {
            tandem::sync(
                system,
                &plan.on_one_cpu(),
                WaitPolicy::SpinThenSleep { spins: 2000 },
                Way::Signal,
            )
        },
    ),
    case(
        "tandem-spin",
        "spinning, which keeps the CPU from the other end",
        8,
        |system, plan| tandem::sync(system, &plan.on_one_cpu(), WaitPolicy::Spin, Way::Signal),
    ),
    case(
        "eventfd",
        "eventfd beside shared memory",
        ROUNDS,
        |_, plan| floor::eventfd(&plan.on_one_cpu()),
    ),
    case(
        "iceoryx2-event",
        "event with default settings",
        ROUNDS,
        |_, plan| peers::iceoryx2_event(&plan.on_one_cpu()),
    ),
    case(
        "iceoryx2-event-tuned",
        "event by iceoryx2's semaphore, one id",
        ROUNDS,
        |_, plan| peers::iceoryx2_event_tuned(&plan.on_one_cpu()),
    ),
    case("pipe", "two pipes", ROUNDS, |_, plan| {
        peers::pipe(&plan.on_one_cpu())
    }),
    case(
        "unix-socket",
        "a pair of SOCK_SEQPACKET",
        ROUNDS,
        |_, plan| peers::unix_socket(&plan.on_one_cpu()),
    ),
    case(
        "message-queue",
        "two POSIX message queues",
        ROUNDS,
        |_, plan| peers::message_queue(&plan.on_one_cpu()),
    ),
];
