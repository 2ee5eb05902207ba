//! FreeRTOS on the host: how late its tick is, and what a switch costs.

use super::{Case, Group, Run};
use crate::rtos;

const fn case(name: &'static str, what: &'static str, rounds: usize, run: Run) -> Case {
    Case {
        group: Group::Rtos,
        name,
        what,
        rounds,
        every: 1,
        run,
    }
}

/// The cases. Each tick takes a millisecond.
pub(super) const CASES: &[Case] = &[
    case(
        "tick-floor",
        "clock_nanosleep to each ms",
        100,
        |_, plan| rtos::tick_floor(plan),
    ),
    case(
        "tick",
        "a task that delays until each tick",
        100,
        |_, plan| rtos::tick(plan),
    ),
    case(
        "tick-posix-port",
        "the same, FreeRTOS's POSIX port",
        100,
        |_, plan| rtos::tick_posix_port(plan),
    ),
    case("switch", "yield to another task", 20_000, |_, plan| {
        rtos::switch(plan)
    }),
    case(
        "switch-posix-port",
        "the same, FreeRTOS's POSIX port",
        2000,
        |_, plan| rtos::switch_posix_port(plan),
    ),
    case(
        "switch-from-interrupt",
        "from the tick's interrupt to the task it wakes",
        100,
        |_, plan| rtos::switch_from_interrupt(plan),
    ),
    case(
        "switch-from-interrupt-posix-port",
        "the same, FreeRTOS's POSIX port",
        100,
        |_, plan| rtos::switch_from_interrupt_posix_port(plan),
    ),
];
