//! A wake-up from core 1 over core 2 to core 0.

use super::{Case, Group, Run};
use crate::chain::through_three;
use crate::{floor, peers, tandem};
use tandem_shm::wait::WaitPolicy;

const fn case(name: &'static str, what: &'static str, rounds: usize, run: Run) -> Case {
    Case {
        group: Group::Chain,
        name,
        what,
        rounds,
        every: 1,
        run,
    }
}

/// The cases.
pub(super) const CASES: &[Case] = &[
    case("floor", "two futex wakes", 250, |_, plan| {
        through_three(plan, 3 * 64, |part, shared| {
            floor::Futex::between(shared, [part, (part + 2) % 3])
        })
    }),
    case("tandem", "two signals, all asleep", 250, |system, plan| {
        tandem::chain(system, plan, [WaitPolicy::Sleep; 3])
    }),
    case(
        "tandem-spin",
        "cores 2 and 0 spin, 1 sleeps: it shares a CPU with 0",
        100,
        |system, plan| {
            let policies = [WaitPolicy::Sleep, WaitPolicy::Spin, WaitPolicy::Spin];
            tandem::chain(system, plan, policies)
        },
    ),
    case(
        "iceoryx2-event",
        "two events with default settings",
        250,
        |_, plan| peers::iceoryx2_chain(plan),
    ),
];
