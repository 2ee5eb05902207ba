//! Messages in a row, as many as go. A sample is the mean time per message over a chunk.

use super::{Case, Group, Run};
use crate::tandem::newest::Pace;
use crate::{floor, peers, tandem};

const fn case(name: &'static str, what: &'static str, chunks: usize, run: Run) -> Case {
    Case {
        group: Group::Throughput,
        name,
        what,
        rounds: chunks,
        every: 1,
        run,
    }
}

/// The cases.
pub(super) const CASES: &[Case] = &[
    case(
        "floor",
        "8 bytes each, by full cache lines",
        400,
        |_, plan| floor::full_lines(plan),
    ),
    case("fifo-8B", "FIFO between processes", 400, |_, plan| {
        tandem::fifo::messages::<2>(plan, 512, 4096)
    }),
    case("fifo-64B", "FIFO, copied in and out", 200, |_, plan| {
        tandem::fifo::messages::<16>(plan, 256, 4096)
    }),
    case("fifo-4KiB", "FIFO, copied in and out", 200, |_, plan| {
        tandem::fifo::messages::<1024>(plan, 32, 64)
    }),
    case(
        "broadcast-1-to-2",
        "the sender's time; two receivers share a CPU",
        200,
        |_, plan| tandem::broadcast::to_two(plan),
    ),
    case(
        "fifo-2-to-1",
        "two FIFOs polled by one; two senders share a CPU",
        200,
        |_, plan| tandem::fifo::from_two(plan),
    ),
    case("rtrb-8B", "ring buffer between threads", 400, |_, plan| {
        peers::rtrb_stream(plan)
    }),
    case(
        "crossbeam-8B",
        "ArrayQueue between threads",
        100,
        |_, plan| peers::crossbeam_stream(plan),
    ),
    case("pipe-8B", "one write, one read each", 20, |_, plan| {
        peers::pipe_stream(plan)
    }),
    case(
        "iceoryx2-8B",
        "publish-subscribe that waits when full",
        20,
        |_, plan| peers::iceoryx2_stream(plan),
    ),
    case(
        "newest-write",
        "a newest value published, without readers",
        5_000,
        |_, plan| tandem::newest::write(plan, 0, Pace::Full),
    ),
    case(
        "newest-write-1-reader",
        "the same, read at full speed from another CPU",
        5_000,
        |_, plan| tandem::newest::write(plan, 1, Pace::Full),
    ),
    case(
        "newest-write-2-readers",
        "the same, two readers sharing the other CPU",
        5_000,
        |_, plan| tandem::newest::write(plan, 2, Pace::Full),
    ),
    case(
        "newest-paced",
        "one value each microsecond, the clock's reading included",
        10_000,
        |_, plan| tandem::newest::write(plan, 0, Pace::Fixed),
    ),
    case(
        "newest-paced-1-reader",
        "the same, read each microsecond from another CPU",
        10_000,
        |_, plan| tandem::newest::write(plan, 1, Pace::Fixed),
    ),
    case(
        "newest-paced-2-readers",
        "the same, two readers sharing the other CPU",
        10_000,
        |_, plan| tandem::newest::write(plan, 2, Pace::Fixed),
    ),
];
