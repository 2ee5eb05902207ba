//! All cases by name. A group that has a floor lists it first.

use crate::exec::{self, Supervisor, skew, worker_pool as pool};
use crate::harness::{Batch, BatchPlan};
use crate::peers::iceoryx2::Settings;
use crate::peers::mutex::Death;
use crate::peers::{ddsperf, iceoryx2, kernel, mutex, polling};
use crate::tandem::Way::{Channel, Signal};
use crate::tandem::channels::{broadcast, fifo, in_place};
use crate::tandem::{lock, sync};
use crate::{floor, noise, rtos, tandem, topics};
use clap::ValueEnum as _;
use std::io;
use tandem_shm::wait::WaitPolicy::{self, Sleep, Spin, SpinThenSleep};

/// Cases that are compared with each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, clap::ValueEnum)]
pub enum Comparison {
    /// 4 bytes one way; the receiver polls on its own CPU.
    Spin,
    /// 4 bytes one way; the receiver sleeps in the kernel until it is woken, on its own CPU.
    Sleep,
    /// 4 bytes one way; both ends share one CPU.
    OneCpu,
    /// One way for each payload from 4 bytes to 16 MiB, written and read in place.
    Size,
    /// Messages in a row, as fast as possible.
    Throughput,
    /// Locking and unlocking: a free lock, a contended lock, and one whose owner has died.
    Lock,
    /// One way at a fixed rate, from the intended time of sending.
    Rate,
    /// A CAN frame as a topic, half of a round trip; the receiver sleeps.
    Topics,
    /// FreeRTOS on the host: lateness of the tick, and switches between tasks.
    Rtos,
    /// Processes under a supervisor: ten from start to ready, restarts; the skew of activations;
    /// the worker pool.
    Exec,
    /// Pauses caused by the machine.
    Noise,
}

impl Comparison {
    /// Returns the name for the command line and for the names of cases.
    #[must_use]
    pub fn name(self) -> String {
        let value = self.to_possible_value();
        value.map_or(String::new(), |value| value.get_name().to_owned())
    }

    /// Returns whether messages of this group cross from one CPU to another in the floor as in the
    /// cases: their times depend on where the two CPUs are.
    pub(crate) fn crosses_cpus(self) -> bool {
        use Comparison::{Rate, Size, Sleep, Spin, Throughput};
        matches!(self, Spin | Sleep | Size | Throughput | Rate)
    }
}

/// Runs one batch of a case. Both ends of the group `one-cpu` get the same CPU in the plan.
pub type Run = fn(&BatchPlan) -> io::Result<Batch>;

/// One of the mechanisms that a group compares.
#[derive(Clone, Copy)]
pub struct Candidate {
    /// Its group.
    pub group: Comparison,
    /// Name within the group. `floor` is the case that the others are compared with.
    pub name: &'static str,
    /// Description for the table.
    pub what: &'static str,
    /// Rounds of one batch. It takes only 10 to 50 ms, so that another case runs before the
    /// machine's state changes.
    pub rounds: usize,
    /// Runs one batch; the CPUs of the plan must fit the group.
    run: Run,
}

impl Candidate {
    /// Group and case, for example `spin/tandem`.
    #[must_use]
    pub fn full_name(&self) -> String {
        format!("{}/{}", self.group.name(), self.name)
    }

    /// Runs one batch.
    ///
    /// # Errors
    /// If the case cannot be measured.
    pub fn run_batch(&self, plan: &BatchPlan) -> io::Result<Batch> {
        match self.group {
            Comparison::OneCpu => (self.run)(&BatchPlan {
                cpus: [plan.cpus[0]; 2],
                ..*plan
            }),
            _ => (self.run)(plan),
        }
    }

    /// Returns whether this is the floor, with which the rest of the group is compared.
    #[must_use]
    pub fn is_floor(&self) -> bool {
        self.name == "floor"
    }
}

/// Cases of a group with the same number of rounds: name, what it is, how to run it.
type Cases = (
    Comparison,
    usize,
    &'static [(&'static str, &'static str, Run)],
);

const KIB: usize = 1 << 10;
const MIB: usize = 1 << 20;
/// Words of a scene of the controller.
const SCENE: usize = 280;
const ADAPTIVE: WaitPolicy = SpinThenSleep { spins: 2000 };

/// Cases whose receiver sleeps in the kernel, on two CPUs or on one.
#[rustfmt::skip]
const SLEEPERS: &[(&str, &str, Run)] = &[
    ("floor", "futex on a shared word", floor::futex),
    ("tandem", "mailbox signal with its value, doorbell, running handler",
        |p| sync::<1>(p, Sleep, Signal)),
    ("tandem-adaptive", "the same, polling 2000 times before it sleeps",
        |p| sync::<1>(p, ADAPTIVE, Signal)),
    ("tandem-scene", "as the controller sends: channel of 280 words, signal, doorbell, handler",
        |p| sync::<SCENE>(p, Sleep, Channel)),
    ("eventfd", "eventfd beside shared memory", kernel::eventfd),
    ("iceoryx2-event", "event with default settings", iceoryx2::event),
    ("iceoryx2-event-tuned", "event by iceoryx2's semaphore, one id", iceoryx2::event_tuned),
    ("io-uring", "message from ring to ring", kernel::io_uring),
    ("pipe", "two pipes", kernel::pipe),
    ("unix-socket", "a pair of SOCK_SEQPACKET", kernel::unix_socket),
];

#[rustfmt::skip]
const CASES: &[Cases] = &[
    (Comparison::Spin, 20_000, &[
        ("floor", "a cache line between two processes", floor::cache_line),
        ("tandem", "mailbox signal with its value, running handler", |p| sync::<1>(p, Spin, Signal)),
        ("tandem-channel", "newest-value channel, mailbox signal, running handler",
            |p| sync::<1>(p, Spin, Channel)),
        ("scene-floor", "the lines of a scene as bare words, with a line that announces them",
            floor::words::<SCENE>),
        ("tandem-scene", "the same with the 280 words of a scene, each written and read",
            |p| sync::<SCENE>(p, Spin, Channel)),
        ("iceoryx2-pubsub", "publish-subscribe with default settings, polled",
            |p| iceoryx2::publish_subscribe(p, Settings::Default, 1)),
        ("iceoryx2-pubsub-tuned", "the same for one subscriber, buffer of 1, no overflow",
            |p| iceoryx2::publish_subscribe(p, Settings::Lean, 1)),
        ("iceoryx2-blackboard", "an entry of the blackboard, polled", iceoryx2::blackboard),
        ("iceoryx2-request", "request and response, polled", iceoryx2::request),
        ("seqlock", "sequence lock, polled", polling::seqlock),
        ("rtrb", "ring buffer between threads", polling::rtrb),
        ("triple-buffer", "newest value between threads", polling::triple_buffer),
    ]),
    (Comparison::Sleep, 250, SLEEPERS),
    (Comparison::OneCpu, 500, SLEEPERS),
    (Comparison::Size, 10_000, &[
        ("floor", "a cache line between two processes",
            |p| Ok(floor::cache_line(p)?.without_facts())),
        ("tandem-4B", "each byte of a lent block written, handed over, polled, read in place",
            in_place::<4>),
        ("tandem-64B", "the same", in_place::<64>),
        ("tandem-1KiB", "the same", in_place::<KIB>),
        ("tandem-4KiB", "the same", in_place::<{ 4 * KIB }>),
        ("iceoryx2-4B", "each byte of a lent sample written, published, polled, read in place",
            |p| iceoryx2::size(p, 4)),
        ("iceoryx2-64B", "the same", |p| iceoryx2::size(p, 64)),
        ("iceoryx2-1KiB", "the same", |p| iceoryx2::size(p, KIB)),
        ("iceoryx2-4KiB", "the same", |p| iceoryx2::size(p, 4 * KIB)),
    ]),
    (Comparison::Size, 1000, &[
        ("tandem-16KiB", "the same", in_place::<{ 16 * KIB }>),
        ("iceoryx2-16KiB", "the same", |p| iceoryx2::size(p, 16 * KIB)),
        ("tandem-64KiB", "the same", in_place::<{ 64 * KIB }>),
        ("iceoryx2-64KiB", "the same", |p| iceoryx2::size(p, 64 * KIB)),
    ]),
    (Comparison::Size, 200, &[
        ("tandem-256KiB", "the same", in_place::<{ 256 * KIB }>),
        ("iceoryx2-256KiB", "the same", |p| iceoryx2::size(p, 256 * KIB)),
        ("tandem-1MiB", "the same", in_place::<MIB>),
        ("iceoryx2-1MiB", "the same", |p| iceoryx2::size(p, MIB)),
    ]),
    (Comparison::Size, 30, &[
        ("tandem-4MiB", "the same", in_place::<{ 4 * MIB }>),
        ("iceoryx2-4MiB", "the same", |p| iceoryx2::size(p, 4 * MIB)),
    ]),
    (Comparison::Size, 8, &[
        ("tandem-16MiB", "the same", in_place::<{ 16 * MIB }>),
        ("iceoryx2-16MiB", "the same", |p| iceoryx2::size(p, 16 * MIB)),
    ]),
    (Comparison::Throughput, 400, &[
        ("floor", "8 bytes each, by full cache lines", floor::full_lines),
        ("fifo-8B", "FIFO between processes", |p| fifo::<2, 512, 1>(p, 4096)),
        ("rtrb-8B", "ring buffer between threads", polling::rtrb_stream),
    ]),
    (Comparison::Throughput, 200, &[
        ("fifo-64B", "FIFO, copied in and out", |p| fifo::<16, 256, 1>(p, 4096)),
        ("fifo-4KiB", "FIFO, copied in and out", |p| fifo::<1024, 32, 1>(p, 64)),
        ("broadcast-1-to-2", "time per message that a receiver got; the two share a CPU",
            broadcast),
        ("fifo-2-to-1", "two FIFOs polled by one; two senders share a CPU",
            |p| fifo::<2, 512, 2>(p, 4096)),
    ]),
    (Comparison::Throughput, 20, &[
        ("pipe-8B", "one write, one read each", kernel::pipe_stream),
        ("iceoryx2-8B", "publish-subscribe that waits when full", iceoryx2::stream),
    ]),
    (Comparison::Lock, 10_000, &[
        ("floor", "CAS and release store", floor::lock),
        ("free", "taken and given back", lock::free),
        ("pthread", "mutex shared by processes, free", |p| mutex::free(p, Death::Fatal)),
        ("pthread-robust", "robust mutex, free", |p| mutex::free(p, Death::Robust)),
    ]),
    // Microseconds of contention: many time slices of the scheduler.
    (Comparison::Lock, 40_000, &[
        ("contended-2-floor", "one word, no turns: from wanting to having it, two CPUs",
            |p| floor::contended_word(p, 2)),
        ("contended-3-floor", "the same by three processes on two CPUs",
            |p| floor::contended_word(p, 3)),
        ("contended-2", "from wanting to having it, two CPUs",
            |p| lock::under_contention(p, 2)),
        ("contended-3", "the same by three processes on two CPUs",
            |p| lock::under_contention(p, 3)),
        ("pthread-contended-2", "from wanting to having it, two CPUs",
            |p| mutex::under_contention(p, 2, Death::Fatal)),
        ("pthread-contended-3", "the same by three processes on two CPUs",
            |p| mutex::under_contention(p, 3, Death::Fatal)),
        ("pthread-robust-contended-2", "from wanting to having it, two CPUs",
            |p| mutex::under_contention(p, 2, Death::Robust)),
    ]),
    // In each round one owner dies.
    (Comparison::Lock, 20, &[
        ("recovery", "from the kill of the owner to the guard", lock::recovery),
        ("pthread-robust-recovery", "from the kill of the owner to the guard",
            mutex::recovery),
    ]),
    (Comparison::Rate, 400, &[
        ("floor", "futex on a shared word, 10 kHz", floor::futex_at_rate),
        ("tandem", "asleep between messages, 10 kHz", |p| tandem::at_rate(p, Sleep)),
        ("tandem-spin", "spinning, 10 kHz", |p| tandem::at_rate(p, Spin)),
        ("iceoryx2-event", "event with default settings, 10 kHz", iceoryx2::event_at_rate),
    ]),
    (Comparison::Topics, 1000, &[
        ("udp-floor", "76 bytes by a bare UDP socket, loopback", topics::udp_floor),
        ("tandem", "DDS, reliable, from node to node, loopback", topics::dds),
        // It decides by itself how long it measures: a second.
        ("ddsperf", "DDS, reliable, Cyclone DDS's own ping-pong, loopback", ddsperf::ping_pong),
        ("shm", "broadcast ring in the LMU, signal, doorbell", topics::lmu),
        ("iceoryx2", "the service of CAN frames, event with default settings", topics::services),
    ]),
    // Each tick takes a millisecond.
    (Comparison::Rtos, 100, &[
        ("tick-floor", "clock_nanosleep to each ms", rtos::tick_floor),
        ("tick", "a task that delays until each tick", rtos::tick),
        ("tick-posix-port", "the same, FreeRTOS's POSIX port", |p| rtos::posix_port(p, "tick")),
        ("switch-from-interrupt", "from the tick's interrupt to the task it wakes",
            rtos::switch_from_interrupt),
        ("switch-from-interrupt-posix-port", "the same, FreeRTOS's POSIX port",
            |p| rtos::posix_port(p, "interrupt")),
    ]),
    (Comparison::Rtos, 20_000, &[("switch", "yield to another task", rtos::switch)]),
    (Comparison::Rtos, 2000, &[
        ("switch-posix-port", "the same, FreeRTOS's POSIX port",
            |p| rtos::posix_port(p, "switch")),
    ]),
    // Each start takes 20 to 300 ms.
    (Comparison::Exec, 3, &[
        ("ready-10", "tandem exec run: from its start to ten processes ready",
            |p| exec::ready_10(p, Supervisor::Tandem)),
        ("ready-10-s6", "s6-svscan, s6-svwait -U", |p| exec::ready_10(p, Supervisor::S6)),
        ("ready-10-runit", "runsvdir; the processes tell when they are ready",
            |p| exec::ready_10(p, Supervisor::Runit)),
        ("ready-10-systemd", "systemd --user in namespaces of its own, until STATUS=Ready.",
            |p| exec::ready_10(p, Supervisor::Systemd)),
    ]),
    // Each batch first lets the processes run for a second.
    (Comparison::Exec, 10, &[
        ("restart", "tandem exec run: from SIGKILL to ready again",
            |p| exec::restart(p, Supervisor::Tandem)),
        ("restart-s6", "the same, s6", |p| exec::restart(p, Supervisor::S6)),
        ("restart-runit", "the same, runit", |p| exec::restart(p, Supervisor::Runit)),
        ("restart-systemd", "the same, systemd --user, RestartSec=0",
            |p| exec::restart(p, Supervisor::Systemd)),
    ]),
    // Each cycle takes a millisecond.
    (Comparison::Exec, 100, &[
        ("skew", "two deterministic clients, 1 kHz, sleeping", |p| skew::clients(p, 0)),
        ("skew-spin", "the same, the last 100 us spinning", 
            |p| skew::clients(p, skew::SPIN_NS)),
        ("skew-floor", "two processes in clock_nanosleep to the same instants, 1 kHz",
            |p| skew::floor(p, 0)),
        ("skew-spin-floor", "the same, the last 100 us spinning",
            |p| skew::floor(p, skew::SPIN_NS)),
    ]),
    (Comparison::Exec, 50, &[
        ("pool", "512 elements of 2 us each by the worker pool, two workers", pool::tandem),
        ("pool-sequential", "512 elements of 2 us each, one after the other", pool::sequential),
        ("pool-rayon", "the same by rayon, two workers", pool::rayon),
    ]),
    (Comparison::Noise, 400, &[
        ("cpu0", "near CPU: longest pause of a spin in each 100 us", |p| noise::gaps(p, p.cpus[0])),
        ("cpu1", "far CPU: longest pause of a spin in each 100 us", |p| noise::gaps(p, p.cpus[1])),
    ]),
    (Comparison::Noise, 60, &[("timer", "how late a sleep of 500 us ends", noise::timer)]),
];

/// Returns all cases in the order in which they are shown.
pub fn all() -> impl Iterator<Item = Candidate> {
    CASES.iter().flat_map(|(group, rounds, cases)| {
        cases.iter().map(|(name, what, run)| Candidate {
            group: *group,
            name,
            what,
            rounds: *rounds,
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
