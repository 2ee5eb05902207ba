//! Borrowing and giving back a cache line.

use super::{Case, Group, Run};
use crate::{floor, peers, tandem};

const fn case(name: &'static str, what: &'static str, chunks: usize, run: Run) -> Case {
    Case {
        group: Group::Pool,
        name,
        what,
        rounds: chunks,
        every: 1,
        run,
    }
}

/// The cases.
pub(super) const CASES: &[Case] = &[
    case("floor", "one CAS", 10_000, |_, plan| floor::cas::one(plan)),
    case("take-give", "16 words by one core", 2_000, |_, plan| {
        tandem::pool::take_give(plan)
    }),
    case(
        "take-give-contended-2",
        "16 words by two cores at once",
        500,
        |_, plan| tandem::pool::take_give_by_two(plan),
    ),
    case(
        "malloc-free",
        "64 bytes, within one process",
        10_000,
        |_, plan| peers::malloc_free(plan),
    ),
];
