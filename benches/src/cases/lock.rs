//! Taking and giving back a lock: free, wanted by several, and after the death of its owner.

use super::{Case, Group, Run};
use crate::peers::Death;
use crate::{floor, peers, tandem};

const fn case(name: &'static str, what: &'static str, rounds: usize, run: Run) -> Case {
    Case {
        group: Group::Lock,
        name,
        what,
        rounds,
        every: 1,
        run,
    }
}

/// Chunks of a free lock.
const CHUNKS: usize = 10_000;
/// Microseconds of contention: many of the scheduler's turns.
const SPAN: usize = 40_000;
/// Deaths of an owner.
const DEATHS: usize = 20;

/// The cases.
pub(super) const CASES: &[Case] = &[
    case("floor", "CAS and release store", CHUNKS, |_, plan| {
        floor::cas::lock(plan)
    }),
    case("free", "taken and given back", CHUNKS, |_, plan| {
        tandem::lock::free(plan)
    }),
    case(
        "contended-2",
        "from wanting to having it, two CPUs",
        SPAN,
        |_, plan| tandem::lock::under_contention(plan, 2),
    ),
    case(
        "contended-3",
        "the same by three processes on two CPUs",
        SPAN,
        |_, plan| tandem::lock::under_contention(plan, 3),
    ),
    case(
        "recovery",
        "from the mark of the owner's death to the guard",
        DEATHS,
        |_, plan| tandem::lock::recovery(plan),
    ),
    case(
        "pthread",
        "mutex shared by processes, free",
        CHUNKS,
        |_, plan| peers::mutex(plan, Death::Fatal),
    ),
    case(
        "pthread-contended-2",
        "from wanting to having it, two CPUs",
        SPAN,
        |_, plan| peers::contended_mutex(plan, 2, Death::Fatal),
    ),
    case(
        "pthread-contended-3",
        "the same by three processes on two CPUs",
        SPAN,
        |_, plan| peers::contended_mutex(plan, 3, Death::Fatal),
    ),
    case("pthread-robust", "robust mutex, free", CHUNKS, |_, plan| {
        peers::mutex(plan, Death::Robust)
    }),
    case(
        "pthread-robust-contended-2",
        "from wanting to having it, two CPUs",
        SPAN,
        |_, plan| peers::contended_mutex(plan, 2, Death::Robust),
    ),
    case(
        "pthread-robust-recovery",
        "from the kill of the owner to the guard",
        DEATHS,
        |_, plan| peers::mutex_recovery(plan),
    ),
];
