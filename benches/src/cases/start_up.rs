//! From power-on until all three cores are in sync.

use super::{Case, Group, Run};
use crate::tandem;

const fn case(name: &'static str, what: &'static str, run: Run) -> Case {
    Case {
        group: Group::StartUp,
        name,
        what,
        rounds: 15,
        every: 1,
        run,
    }
}

/// The cases.
pub(super) const CASES: &[Case] = &[
    case("floor", "fork and exit of three processes", |_, plan| {
        tandem::start_up::fork_three(plan)
    }),
    case(
        "tandem",
        "memory, doorbells, three cores, each has heard of each",
        |_, plan| tandem::start_up::start_up(plan),
    ),
];
