//! What is measured, by name. The floor comes first in its group.

use crate::chain::through_three;
use crate::harness::{Batch, Plan};
use crate::peers::Death;
use crate::tandem::Way;
use crate::tandem::newest::Pace;
use crate::{floor, noise, peers, rtos, tandem};
use std::io;
use tandem_shm::wait::WaitPolicy;

/// What is compared with each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, clap::ValueEnum)]
pub enum Group {
    /// 4 bytes one way; the receiver polls on a CPU of its own.
    Spin,
    /// 4 bytes one way; the receiver sleeps in the kernel until it is woken, on a CPU of its own.
    Sleep,
    /// 4 bytes one way; both ends share one CPU.
    OneCpu,
    /// One way by payload, in place: 4 bytes to 16 MiB.
    Size,
    /// Messages in a row, as fast as possible.
    Throughput,
    /// Taking and giving back the lock: free, contended, and after the death of its owner.
    Lock,
    /// Borrowing and giving back words of the pool.
    Pool,
    /// A wake-up from core 1 over core 2 to core 0.
    Chain,
    /// From power-on until all three cores are in sync.
    StartUp,
    /// One way at a fixed rate, from the intended time of the sending.
    Rate,
    /// FreeRTOS on the host: lateness of the tick, and switches between tasks.
    Rtos,
    /// What the machine does by itself.
    Noise,
}

impl Group {
    /// As it stands in names and on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Spin => "spin",
            Self::Sleep => "sleep",
            Self::OneCpu => "one-cpu",
            Self::Size => "size",
            Self::Throughput => "throughput",
            Self::Lock => "lock",
            Self::Pool => "pool",
            Self::Chain => "chain",
            Self::StartUp => "start-up",
            Self::Rate => "rate",
            Self::Rtos => "rtos",
            Self::Noise => "noise",
        }
    }
}

/// Runs one batch of a case. Both ends of the group `one-cpu` get the same CPU in the plan.
pub type Run = fn(&Plan) -> io::Result<Batch>;

/// One way of doing what its group compares.
#[derive(Clone, Copy)]
pub struct Case {
    /// What it is compared with.
    pub group: Group,
    /// Name within the group; `floor` is what the others are compared with.
    pub name: &'static str,
    /// What it is, for the table.
    pub what: &'static str,
    /// Rounds of one batch: some 10 to 50 ms, so that cases take turns while the machine's mood
    /// lasts.
    pub rounds: usize,
    /// Runs in every `every`-th turn. 1 unless set-up takes seconds.
    pub every: usize,
    /// One batch, by a plan whose CPUs fit the group.
    run: Run,
}

impl Case {
    /// Group and case, as `spin/tandem`.
    #[must_use]
    pub fn full_name(&self) -> String {
        format!("{}/{}", self.group.name(), self.name)
    }

    /// Runs one batch.
    ///
    /// # Errors
    /// If the case cannot be measured.
    pub fn run_batch(&self, plan: &Plan) -> io::Result<Batch> {
        match self.group {
            Group::OneCpu => (self.run)(&plan.on_one_cpu()),
            _ => (self.run)(plan),
        }
    }

    /// Whether the others of its group are compared with it.
    #[must_use]
    pub fn is_floor(&self) -> bool {
        self.name == "floor"
    }
}

/// Cases of a group with the same number of rounds: name, what it is, how to run it.
type Cases = (Group, usize, &'static [(&'static str, &'static str, Run)]);

const KIB: usize = 1 << 10;
const MIB: usize = 1 << 20;
const TANDEM: &str = "in place in shared memory, the signal says where";
const ICEORYX2: &str = "lent, published, polled";
/// Each batch fills the payloads anew before it begins: the large ones have more rounds to show
/// for that.
const SIZE: usize = 10_000;
/// Chunks of a free lock.
const CHUNKS: usize = 10_000;
/// Microseconds of contention: many of the scheduler's turns.
const SPAN: usize = 40_000;
/// Deaths of an owner.
const DEATHS: usize = 20;
/// Ticks of a batch; each takes a millisecond.
const TICKS: usize = 100;

const CASES: &[Cases] = &[
    (
        Group::Spin,
        20_000,
        &[
            (
                "floor",
                "a cache line between two processes",
                floor::cache_line,
            ),
            (
                "tandem",
                "mailbox signal with its value, running handler",
                |plan| tandem::sync(plan, WaitPolicy::Spin, Way::Signal),
            ),
            (
                "tandem-channel",
                "newest-value channel, mailbox signal, running handler",
                |plan| tandem::sync(plan, WaitPolicy::Spin, Way::Channel),
            ),
            (
                "iceoryx2-pubsub",
                "publish-subscribe with default settings, polled",
                peers::iceoryx2_pubsub,
            ),
            (
                "iceoryx2-pubsub-tuned",
                "the same for one subscriber, buffer of 1, no overflow",
                peers::iceoryx2_pubsub_tuned,
            ),
            (
                "crossbeam",
                "ArrayQueue between threads",
                peers::crossbeam_channel,
            ),
            ("rtrb", "ring buffer between threads", peers::rtrb),
        ],
    ),
    (
        Group::Sleep,
        250,
        &[
            ("floor", "futex on a shared word", floor::futex),
            (
                "tandem",
                "mailbox signal with its value, doorbell, running handler",
                |plan| tandem::sync(plan, WaitPolicy::Sleep, Way::Signal),
            ),
            (
                "tandem-adaptive",
                "the same, polling 2000 times before it sleeps",
                |plan| tandem::sync(plan, WaitPolicy::SpinThenSleep { spins: 2000 }, Way::Signal),
            ),
            ("eventfd", "eventfd beside shared memory", floor::eventfd),
            (
                "iceoryx2-event",
                "event with default settings",
                peers::iceoryx2_event,
            ),
            (
                "iceoryx2-event-tuned",
                "event by iceoryx2's semaphore, one id",
                peers::iceoryx2_event_tuned,
            ),
            ("pipe", "two pipes", peers::pipe),
            (
                "unix-socket",
                "a pair of SOCK_SEQPACKET",
                peers::unix_socket,
            ),
            (
                "message-queue",
                "two POSIX message queues",
                peers::message_queue,
            ),
        ],
    ),
    (
        Group::Sleep,
        1,
        &[(
            "ddsperf",
            "Cyclone DDS over loopback; its own percentiles",
            peers::ddsperf,
        )],
    ),
    (
        Group::OneCpu,
        500,
        &[
            ("floor", "futex on a shared word", floor::futex),
            (
                "tandem",
                "mailbox signal with its value, doorbell, running handler",
                |plan| tandem::sync(plan, WaitPolicy::Sleep, Way::Signal),
            ),
            (
                "tandem-adaptive",
                "the same, polling 2000 times before it sleeps",
                |plan| tandem::sync(plan, WaitPolicy::SpinThenSleep { spins: 2000 }, Way::Signal),
            ),
            ("eventfd", "eventfd beside shared memory", floor::eventfd),
            (
                "iceoryx2-event",
                "event with default settings",
                peers::iceoryx2_event,
            ),
            (
                "iceoryx2-event-tuned",
                "event by iceoryx2's semaphore, one id",
                peers::iceoryx2_event_tuned,
            ),
            ("pipe", "two pipes", peers::pipe),
            (
                "unix-socket",
                "a pair of SOCK_SEQPACKET",
                peers::unix_socket,
            ),
            (
                "message-queue",
                "two POSIX message queues",
                peers::message_queue,
            ),
        ],
    ),
    (
        Group::OneCpu,
        8,
        &[(
            "tandem-spin",
            "spinning, which keeps the CPU from the other end",
            |plan| tandem::sync(plan, WaitPolicy::Spin, Way::Signal),
        )],
    ),
    (
        Group::Size,
        SIZE,
        &[
            ("floor", "a cache line between two processes", |plan| {
                Ok(floor::cache_line(plan)?.without_facts())
            }),
            ("tandem-4B", TANDEM, |plan| tandem::size::in_place(plan, 4)),
            ("tandem-64B", TANDEM, |plan| {
                tandem::size::in_place(plan, 64)
            }),
            ("tandem-4KiB", TANDEM, |plan| {
                tandem::size::in_place(plan, 4 * KIB)
            }),
            ("tandem-1MiB", TANDEM, |plan| {
                tandem::size::in_place(plan, MIB)
            }),
            ("tandem-16MiB", TANDEM, |plan| {
                tandem::size::in_place(plan, 16 * MIB)
            }),
            ("iceoryx2-4B", ICEORYX2, |plan| {
                peers::iceoryx2_size(plan, 4)
            }),
            ("iceoryx2-64B", ICEORYX2, |plan| {
                peers::iceoryx2_size(plan, 64)
            }),
            ("iceoryx2-4KiB", ICEORYX2, |plan| {
                peers::iceoryx2_size(plan, 4 * KIB)
            }),
            ("iceoryx2-1MiB", ICEORYX2, |plan| {
                peers::iceoryx2_size(plan, MIB)
            }),
            ("iceoryx2-16MiB", ICEORYX2, |plan| {
                peers::iceoryx2_size(plan, 16 * MIB)
            }),
        ],
    ),
    (
        Group::Throughput,
        400,
        &[
            (
                "floor",
                "8 bytes each, by full cache lines",
                floor::full_lines,
            ),
            ("fifo-8B", "FIFO between processes", |plan| {
                tandem::fifo::messages::<2>(plan, 512, 4096)
            }),
            ("rtrb-8B", "ring buffer between threads", peers::rtrb_stream),
        ],
    ),
    (
        Group::Throughput,
        200,
        &[
            ("fifo-64B", "FIFO, copied in and out", |plan| {
                tandem::fifo::messages::<16>(plan, 256, 4096)
            }),
            ("fifo-4KiB", "FIFO, copied in and out", |plan| {
                tandem::fifo::messages::<1024>(plan, 32, 64)
            }),
            (
                "broadcast-1-to-2",
                "the sender's time; two receivers share a CPU",
                tandem::broadcast::to_two,
            ),
            (
                "fifo-2-to-1",
                "two FIFOs polled by one; two senders share a CPU",
                tandem::fifo::from_two,
            ),
        ],
    ),
    (
        Group::Throughput,
        100,
        &[(
            "crossbeam-8B",
            "ArrayQueue between threads",
            peers::crossbeam_stream,
        )],
    ),
    (
        Group::Throughput,
        20,
        &[
            ("pipe-8B", "one write, one read each", peers::pipe_stream),
            (
                "iceoryx2-8B",
                "publish-subscribe that waits when full",
                peers::iceoryx2_stream,
            ),
        ],
    ),
    (
        Group::Throughput,
        5_000,
        &[
            (
                "newest-write",
                "a newest value published, without readers",
                |plan| tandem::newest::write(plan, 0, Pace::Full),
            ),
            (
                "newest-write-1-reader",
                "the same, read at full speed from another CPU",
                |plan| tandem::newest::write(plan, 1, Pace::Full),
            ),
            (
                "newest-write-2-readers",
                "the same, two readers sharing the other CPU",
                |plan| tandem::newest::write(plan, 2, Pace::Full),
            ),
        ],
    ),
    (
        Group::Throughput,
        10_000,
        &[
            (
                "newest-paced",
                "one value each microsecond, the clock's reading included",
                |plan| tandem::newest::write(plan, 0, Pace::Fixed),
            ),
            (
                "newest-paced-1-reader",
                "the same, read each microsecond from another CPU",
                |plan| tandem::newest::write(plan, 1, Pace::Fixed),
            ),
            (
                "newest-paced-2-readers",
                "the same, two readers sharing the other CPU",
                |plan| tandem::newest::write(plan, 2, Pace::Fixed),
            ),
        ],
    ),
    (
        Group::Lock,
        CHUNKS,
        &[
            ("floor", "CAS and release store", floor::cas::lock),
            ("free", "taken and given back", tandem::lock::free),
            ("pthread", "mutex shared by processes, free", |plan| {
                peers::mutex(plan, Death::Fatal)
            }),
            ("pthread-robust", "robust mutex, free", |plan| {
                peers::mutex(plan, Death::Robust)
            }),
        ],
    ),
    (
        Group::Lock,
        SPAN,
        &[
            (
                "contended-2",
                "from wanting to having it, two CPUs",
                |plan| tandem::lock::under_contention(plan, 2),
            ),
            (
                "contended-3",
                "the same by three processes on two CPUs",
                |plan| tandem::lock::under_contention(plan, 3),
            ),
            (
                "pthread-contended-2",
                "from wanting to having it, two CPUs",
                |plan| peers::contended_mutex(plan, 2, Death::Fatal),
            ),
            (
                "pthread-contended-3",
                "the same by three processes on two CPUs",
                |plan| peers::contended_mutex(plan, 3, Death::Fatal),
            ),
            (
                "pthread-robust-contended-2",
                "from wanting to having it, two CPUs",
                |plan| peers::contended_mutex(plan, 2, Death::Robust),
            ),
        ],
    ),
    (
        Group::Lock,
        DEATHS,
        &[
            (
                "recovery",
                "from the mark of the owner's death to the guard",
                tandem::lock::recovery,
            ),
            (
                "pthread-robust-recovery",
                "from the kill of the owner to the guard",
                peers::mutex_recovery,
            ),
        ],
    ),
    (
        Group::Pool,
        10_000,
        &[
            ("floor", "one CAS", floor::cas::one),
            (
                "malloc-free",
                "64 bytes, within one process",
                peers::malloc_free,
            ),
        ],
    ),
    (
        Group::Pool,
        2_000,
        &[("take-give", "16 words by one core", tandem::pool::take_give)],
    ),
    (
        Group::Pool,
        500,
        &[(
            "take-give-contended-2",
            "16 words by two cores at once",
            tandem::pool::take_give_by_two,
        )],
    ),
    (
        Group::Chain,
        250,
        &[
            ("floor", "two futex wakes", |plan| {
                through_three(plan, 3 * 64, |part, shared| {
                    floor::Futex::between(shared, [part, (part + 2) % 3])
                })
            }),
            ("tandem", "two signals, all asleep", |plan| {
                tandem::chain(plan, [WaitPolicy::Sleep; 3])
            }),
            (
                "iceoryx2-event",
                "two events with default settings",
                peers::iceoryx2_chain,
            ),
        ],
    ),
    (
        Group::Chain,
        100,
        &[(
            "tandem-spin",
            "cores 2 and 0 spin, 1 sleeps: it shares a CPU with 0",
            |plan| {
                let policies = [WaitPolicy::Sleep, WaitPolicy::Spin, WaitPolicy::Spin];
                tandem::chain(plan, policies)
            },
        )],
    ),
    (
        Group::StartUp,
        15,
        &[
            (
                "floor",
                "fork and exit of three processes",
                tandem::start_up::fork_three,
            ),
            (
                "tandem",
                "memory, doorbells, three cores, each has heard of each",
                tandem::start_up::start_up,
            ),
        ],
    ),
    (
        Group::Rate,
        400,
        &[
            (
                "floor",
                "futex on a shared word, 10 kHz",
                floor::futex_at_rate,
            ),
            ("tandem", "asleep between messages, 10 kHz", |plan| {
                tandem::at_rate(plan, WaitPolicy::Sleep)
            }),
            ("tandem-spin", "spinning, 10 kHz", |plan| {
                tandem::at_rate(plan, WaitPolicy::Spin)
            }),
            (
                "iceoryx2-event",
                "event with default settings, 10 kHz",
                peers::iceoryx2_at_rate,
            ),
        ],
    ),
    (
        Group::Rtos,
        TICKS,
        &[
            ("tick-floor", "clock_nanosleep to each ms", rtos::tick_floor),
            ("tick", "a task that delays until each tick", rtos::tick),
            (
                "tick-posix-port",
                "the same, FreeRTOS's POSIX port",
                rtos::tick_posix_port,
            ),
            (
                "switch-from-interrupt",
                "from the tick's interrupt to the task it wakes",
                rtos::switch_from_interrupt,
            ),
            (
                "switch-from-interrupt-posix-port",
                "the same, FreeRTOS's POSIX port",
                rtos::switch_from_interrupt_posix_port,
            ),
        ],
    ),
    (
        Group::Rtos,
        20_000,
        &[("switch", "yield to another task", rtos::switch)],
    ),
    (
        Group::Rtos,
        2000,
        &[(
            "switch-posix-port",
            "the same, FreeRTOS's POSIX port",
            rtos::switch_posix_port,
        )],
    ),
    (
        Group::Noise,
        400,
        &[
            (
                "cpu0",
                "near CPU: longest pause of a spin in each 100 us",
                |plan| noise::gaps(plan, plan.cpus[0]),
            ),
            (
                "cpu1",
                "far CPU: longest pause of a spin in each 100 us",
                |plan| noise::gaps(plan, plan.cpus[1]),
            ),
        ],
    ),
    (
        Group::Noise,
        60,
        &[("timer", "how late a sleep of 500 us ends", noise::timer)],
    ),
];

/// The case that needs seconds to begin, and the turns from one of its batches to the next.
const SELDOM: (&str, usize) = ("ddsperf", 25);

/// All cases in the order in which they are shown.
pub fn all() -> impl Iterator<Item = Case> {
    CASES.iter().flat_map(|(group, rounds, cases)| {
        cases.iter().map(|(name, what, run)| Case {
            group: *group,
            name,
            what,
            rounds: *rounds,
            every: if *name == SELDOM.0 { SELDOM.1 } else { 1 },
            run: *run,
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn names_are_unique_and_floors_come_first() {
        let mut names = HashSet::new();
        let mut groups = HashSet::new();
        for case in all() {
            assert!(names.insert(case.full_name()), "{} twice", case.full_name());
            let is_first = groups.insert(case.group);
            assert!(!case.is_floor() || is_first, "{}", case.full_name());
        }
    }
}
