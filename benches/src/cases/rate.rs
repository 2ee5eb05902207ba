//! One way at a fixed rate, from when each message was due: see [`crate::open_loop`].

use super::{Case, Group, Run};
use crate::{floor, peers, tandem};
use tandem_shm::wait::WaitPolicy;

const fn case(name: &'static str, what: &'static str, run: Run) -> Case {
    Case {
        group: Group::Rate,
        name,
        what,
        rounds: 400,
        every: 1,
        run,
    }
}

/// The cases.
pub(super) const CASES: &[Case] = &[
    case("floor", "futex on a shared word, 10 kHz", |_, plan| {
        floor::futex_at_rate(plan)
    }),
    case(
        "tandem",
        "asleep between messages, 10 kHz",
        |system, plan| tandem::at_rate(system, plan, WaitPolicy::Sleep),
    ),
    case("tandem-spin", "spinning, 10 kHz", |system, plan| {
        tandem::at_rate(system, plan, WaitPolicy::Spin)
    }),
    case(
        "iceoryx2-event",
        "event with default settings, 10 kHz",
        |_, plan| peers::iceoryx2_at_rate(plan),
    ),
];
