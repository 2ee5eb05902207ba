//! One way by payload, in place: lent, stamped at its end, signalled, and read where it lies. What
//! is copied nowhere takes as long with 16 MiB as with 4 bytes.

use super::{Case, Group, Run};
use crate::{floor, peers, tandem};

const KIB: usize = 1 << 10;
const MIB: usize = 1 << 20;

/// Each batch fills the payloads anew before it begins: the large ones have more rounds to show
/// for that.
const fn case(name: &'static str, what: &'static str, run: Run) -> Case {
    Case {
        group: Group::Size,
        name,
        what,
        rounds: 10_000,
        every: 1,
        run,
    }
}

const TANDEM: &str = "in place in shared memory, the signal says where";
const ICEORYX2: &str = "lent, published, polled";

/// The cases.
pub(super) const CASES: &[Case] = &[
    case("floor", "a cache line between two processes", |_, plan| {
        Ok(floor::cache_line(plan)?.without_facts())
    }),
    case("tandem-4B", TANDEM, |system, plan| {
        tandem::size::in_place(system, plan, 4)
    }),
    case("tandem-64B", TANDEM, |system, plan| {
        tandem::size::in_place(system, plan, 64)
    }),
    case("tandem-4KiB", TANDEM, |system, plan| {
        tandem::size::in_place(system, plan, 4 * KIB)
    }),
    case("tandem-1MiB", TANDEM, |system, plan| {
        tandem::size::in_place(system, plan, MIB)
    }),
    case("tandem-16MiB", TANDEM, |system, plan| {
        tandem::size::in_place(system, plan, 16 * MIB)
    }),
    case("iceoryx2-4B", ICEORYX2, |_, plan| {
        peers::iceoryx2_size(plan, 4)
    }),
    case("iceoryx2-64B", ICEORYX2, |_, plan| {
        peers::iceoryx2_size(plan, 64)
    }),
    case("iceoryx2-4KiB", ICEORYX2, |_, plan| {
        peers::iceoryx2_size(plan, 4 * KIB)
    }),
    case("iceoryx2-1MiB", ICEORYX2, |_, plan| {
        peers::iceoryx2_size(plan, MIB)
    }),
    case("iceoryx2-16MiB", ICEORYX2, |_, plan| {
        peers::iceoryx2_size(plan, 16 * MIB)
    }),
];
