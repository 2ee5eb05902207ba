//! What the machine does by itself: the background of all other figures.

use super::{Case, Group, Run};
use crate::noise;

const fn case(name: &'static str, what: &'static str, rounds: usize, run: Run) -> Case {
    Case {
        group: Group::Noise,
        name,
        what,
        rounds,
        every: 1,
        run,
    }
}

/// The cases.
pub(super) const CASES: &[Case] = &[
    case(
        "cpu0",
        "near CPU: longest pause of a spin in each 100 us",
        400,
        |_, plan| noise::gaps(plan, plan.cpus[0]),
    ),
    case(
        "cpu1",
        "far CPU: longest pause of a spin in each 100 us",
        400,
        |_, plan| noise::gaps(plan, plan.cpus[1]),
    ),
    case("timer", "how late a sleep of 500 us ends", 60, |_, plan| {
        noise::timer(plan)
    }),
];
