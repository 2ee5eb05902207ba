//! 4 bytes one way; the receiver looks again and again, on a CPU of its own.

use super::{Case, Group};
use crate::tandem::Way;
use crate::{floor, peers, tandem};
use tandem_shm::wait::WaitPolicy;

const fn case(name: &'static str, what: &'static str, run: super::Run) -> Case {
    Case {
        group: Group::Spin,
        name,
        what,
        rounds: 20_000,
        every: 1,
        run,
    }
}

/// The cases.
pub(super) const CASES: &[Case] = &[
    case("floor", "a cache line between two processes", |_, plan| {
        floor::cache_line(plan)
    }),
    case(
        "tandem",
        "mailbox signal with its value, running handler",
        |system, plan| tandem::sync(system, plan, WaitPolicy::Spin, Way::Signal),
    ),
    case(
        "tandem-channel",
        "newest-value channel, mailbox signal, running handler",
        |system, plan| tandem::sync(system, plan, WaitPolicy::Spin, Way::Channel),
    ),
    case(
        "iceoryx2-pubsub",
        "publish-subscribe with default settings, polled",
        |_, plan| peers::iceoryx2_pubsub(plan),
    ),
    case(
        "iceoryx2-pubsub-tuned",
        "the same for one subscriber, buffer of 1, no overflow",
        |_, plan| peers::iceoryx2_pubsub_tuned(plan),
    ),
    case("crossbeam", "ArrayQueue between threads", |_, plan| {
        peers::crossbeam_channel(plan)
    }),
    case("rtrb", "ring buffer between threads", |_, plan| {
        peers::rtrb(plan)
    }),
];
