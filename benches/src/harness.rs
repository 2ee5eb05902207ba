//! Two ends that pass a stamp to each other, in two processes or two threads, and time each
//! direction.
//!
//! Each message carries the sender's time stamp as its 4 bytes of data. When the value has reached
//! the receiver's code, the receiver subtracts it from its own time stamp. Both directions of a
//! ping-pong are samples of one-way latency. All cases of a run use this loop, so that floor, peers
//! and Tandem differ only in the mechanism.

use crate::clock::{ticks, to_ps, to_ps_spread};
use crate::shared::{CPU_NS, Log, SharedPage};
use crate::system_calls::count;
use crate::worker::{BatchPart, PartContext, perform, pin};
use std::hint::spin_loop;
use std::io;
use std::sync::atomic::{AtomicU32, Ordering};
use tandem_board_host::UnsupervisedSystem;

/// Settings of a batch.
#[derive(Clone, Copy, Debug)]
pub struct BatchPlan {
    /// Measured rounds: round trips, or the case's own kind of round.
    pub rounds: usize,
    /// Earlier rounds that are not measured.
    pub warm_up: usize,
    /// CPUs of the near and the far end.
    pub cpus: [usize; 2],
    /// The system to whose cores Tandem's ends belong; it has power.
    pub system: Option<&'static UnsupervisedSystem>,
}

/// The results of one batch of a case, which takes about 10 to 50 ms.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Batch {
    /// One sample each: one-way time, or time per operation or per message, in picoseconds.
    pub samples_ps: Vec<u64>,
    /// Round trips in picoseconds, where the case is a ping-pong; else empty.
    pub round_trips_ps: Vec<u64>,
    /// Latencies from when each message left, if messages are due at fixed times; else empty.
    pub naive_ps: Vec<u64>,
    /// CPU time (user and system, all ends) per message in ns, where it applies.
    pub cpu_ns_per_message: Option<f64>,
    /// Bytes of payload per message.
    pub payload_bytes: u64,
    /// Further facts by name. If a name begins with `longest`, the maximum of all batches counts,
    /// else the median.
    pub facts: Vec<(&'static str, f64)>,
}

impl Batch {
    /// Collects the records of the parts of a batch of `messages` messages: samples from track 0,
    /// round trips from track 1, and CPU time.
    pub(crate) fn collect(shared: &SharedPage, parts: usize, messages: usize) -> Self {
        let logs: Vec<Log> = (0..parts).map(|number| shared.log(number)).collect();
        let all = |track| {
            let samples = logs.iter().flat_map(move |log| log.samples(track));
            let spread = |(n, ticks)| to_ps_spread(n, ticks);
            samples.enumerate().map(spread).collect()
        };
        let cpu_ns: f64 = logs.iter().map(|log| log.noted(CPU_NS)).sum();
        Self {
            samples_ps: all(0),
            round_trips_ps: all(1),
            cpu_ns_per_message: (cpu_ns > 0.0).then(|| cpu_ns / messages.max(1) as f64),
            payload_bytes: 4,
            ..Self::default()
        }
    }

    /// Converts samples and CPU time of `chunk` operations to those of one operation.
    pub(crate) fn per_operation(mut self, chunk: usize) -> Self {
        for sample in &mut self.samples_ps {
            *sample /= chunk as u64;
        }
        self.cpu_ns_per_message = self.cpu_ns_per_message.map(|ns| ns / chunk as f64);
        self
    }

    /// Sets the payload per message, bytes.
    pub(crate) fn carrying(mut self, payload_bytes: u64) -> Self {
        self.payload_bytes = payload_bytes;
        self
    }

    /// Removes the facts, because another group already shows them.
    pub(crate) fn without_facts(mut self) -> Self {
        self.facts.clear();
        self
    }

    /// Adds a fact.
    pub(crate) fn with_fact(mut self, name: &'static str, value: f64) -> Self {
        self.facts.push((name, value));
        self
    }
}

/// Returns the median, or the larger of the two middle samples; 0 if there is none.
pub(crate) fn median<T: Copy + Default + Ord>(samples: &mut [T]) -> T {
    samples.sort_unstable();
    samples.get(samples.len() / 2).copied().unwrap_or_default()
}

/// Gives the CPU to another process.
pub(crate) fn give_way() {
    std::thread::yield_now();
}

/// Polls until a value arrives.
#[inline(always)]
pub(crate) fn polled<T>(mut look: impl FnMut() -> Option<T>) -> T {
    loop {
        if let Some(found) = look() {
            return found;
        }
        spin_loop();
    }
}

/// Runs a batch of one process on this CPU.
pub(crate) fn alone(
    cpu: usize,
    shared: &SharedPage,
    run: impl FnOnce(&mut PartContext<'_>),
) -> io::Result<()> {
    let part = BatchPart::on(cpu, |role| {
        run(role);
        Ok(())
    });
    perform(shared, vec![part])
}

/// Times an operation that one process does by itself on the near CPU: each round is a chunk of
/// `chunk` operations, so that reading the clock does not count. A sample is the mean time of one
/// operation.
pub(crate) fn repeated<F: FnMut()>(
    plan: &BatchPlan,
    shared: &SharedPage,
    chunk: usize,
    prepare: impl FnOnce() -> F,
) -> io::Result<Batch> {
    alone(plan.cpus[0], shared, |role| {
        let mut operation = prepare();
        for round in 0..plan.warm_up + plan.rounds {
            if round == plan.warm_up {
                role.begin();
            }
            let begin = ticks();
            (0..chunk).for_each(|_| operation());
            let took = ticks().wrapping_sub(begin);
            if round >= plan.warm_up {
                role.log.push(0, took);
            }
        }
        role.end();
    })?;
    Ok(Batch::collect(shared, 1, plan.rounds).per_operation(chunk))
}

/// One end of a mechanism that passes 4 bytes in both directions.
pub(crate) trait End {
    /// Sends a stamp to the other end.
    fn send(&mut self, stamp: u32);
    /// Waits for the next stamp of the other end.
    fn receive(&mut self) -> u32;
}

/// A function that sends, and one that receives.
impl<S: FnMut(u32), R: FnMut() -> u32> End for (S, R) {
    #[inline(always)]
    fn send(&mut self, stamp: u32) {
        self.0(stamp);
    }

    #[inline(always)]
    fn receive(&mut self) -> u32 {
        self.1()
    }
}

/// Index of the note in which the near end records how long a send takes, in ticks. The two notes
/// of [`count_calls`] come before it.
const SEND_AT: usize = 2;
/// The near end records the median of this many last sends.
const SENDS: usize = 255;

fn near_end(end: &mut impl End, plan: &BatchPlan, role: &mut PartContext<'_>) {
    let mut sends = [0; SENDS];
    for round in 0..plan.warm_up + plan.rounds {
        if round == plan.warm_up {
            role.begin();
        }
        let sent = ticks();
        end.send(sent);
        sends[round % SENDS] = ticks().wrapping_sub(sent);
        let stamp = end.receive();
        let now = ticks();
        if round >= plan.warm_up {
            role.log.push(0, now.wrapping_sub(stamp));
            role.log.push(1, now.wrapping_sub(sent));
        }
    }
    role.end();
    let sends = &mut sends[..SENDS.min(plan.warm_up + plan.rounds)];
    role.log.note(SEND_AT, f64::from(median(sends)));
}

fn far_end(end: &mut impl End, plan: &BatchPlan, role: &mut PartContext<'_>) {
    for round in 0..plan.warm_up + plan.rounds {
        if round == plan.warm_up {
            role.begin();
        }
        let stamp = end.receive();
        let way = ticks().wrapping_sub(stamp);
        if round >= plan.warm_up {
            role.log.push(0, way);
        }
        end.send(ticks());
    }
    role.end();
}

/// Passes a stamp to and fro between two processes with ends of one type: the near one writes to
/// way 0 and reads from way 1.
pub(crate) fn between_processes<E: End>(
    plan: &BatchPlan,
    end: impl Fn(&SharedPage, [usize; 2]) -> E,
) -> io::Result<Batch> {
    between_unlike(
        plan,
        |shared| end(shared, [0, 1]),
        |shared| end(shared, [1, 0]),
    )
}

/// As [`between_processes`], with ends of two types.
///
/// Each end is made in its own process, which lives for this batch only: it inherits nothing from
/// earlier batches except what the caller had opened.
pub(crate) fn between_unlike<N: End, F: End>(
    plan: &BatchPlan,
    near: impl FnOnce(&SharedPage) -> N,
    far: impl FnOnce(&SharedPage) -> F,
) -> io::Result<Batch> {
    // Counting takes ten rounds: skip it if it would take longer than the measurement.
    timed_between(plan, near, far, plan.rounds > 10)
}

/// As [`between_unlike`]; counts system calls if `is_counted`, which takes some 10 ms.
pub(crate) fn timed_between<N: End, F: End>(
    plan: &BatchPlan,
    near: impl FnOnce(&SharedPage) -> N,
    far: impl FnOnce(&SharedPage) -> F,
    is_counted: bool,
) -> io::Result<Batch> {
    let shared = SharedPage::new()?;
    let near = BatchPart::on(plan.cpus[0], |role| {
        let mut end = near(role.shared);
        role.shared.meet(2);
        near_end(&mut end, plan, role);
        if is_counted {
            count_calls(&mut end, role);
        }
        Ok(())
    });
    let far = BatchPart::on(plan.cpus[1], |role| {
        let mut end = far(role.shared);
        role.shared.meet(2);
        far_end(&mut end, plan, role);
        if is_counted {
            be_counted(&mut end, role);
        }
        Ok(())
    });
    perform(&shared, vec![near, far])?;
    let mut batch = there_and_back(plan, &shared);
    let calls = [0, 1].map(|at| shared.log(0).noted(at));
    if is_counted && calls[0] >= 0.0 {
        batch = batch
            .with_fact("syscalls per send", calls[0])
            .with_fact("syscalls per send to one awake", calls[1]);
    }
    Ok(batch)
}

/// Collects the records of both ends of a ping-pong: each direction, and the sender's own cost.
fn there_and_back(plan: &BatchPlan, shared: &SharedPage) -> Batch {
    let median_ns = |end: usize| {
        let mut ways: Vec<u32> = shared.log(end).samples(0).collect();
        to_ps(median(&mut ways)) as f64 / 1e3
    };
    let send = shared.log(0).noted(SEND_AT) as u32;
    Batch::collect(shared, 2, 2 * plan.rounds)
        .with_fact("send takes, ns", to_ps(send) as f64 / 1e3)
        .with_fact("near to far p50, ns", median_ns(1))
        .with_fact("far to near p50, ns", median_ns(0))
}

/// The number of sends of each kind whose system calls are counted, after the timed rounds.
const COUNTED: u32 = 4;

/// A waiting far end that has used this much CPU time polls, and will not sleep, ns.
const STAYS_AWAKE_NS: u64 = 1_000_000;

/// Waits until the process sleeps, or has run for [`STAYS_AWAKE_NS`] and so must be polling. Counts
/// its CPU time, because the machine may keep the process from running.
fn let_wait(pid: u32) {
    let read = |name| std::fs::read_to_string(format!("/proc/{pid}/{name}")).unwrap_or_default();
    // proc(5): the state follows the name in brackets; the first number is the time on a CPU, ns.
    let is_running = || {
        read("stat")
            .rsplit_once(") ")
            .is_some_and(|it| it.1.starts_with('R'))
    };
    let ran_ns = || -> Option<u64> { read("schedstat").split(' ').next()?.parse().ok() };
    let begin_ns = ran_ns();
    loop {
        std::thread::sleep(std::time::Duration::from_millis(1));
        let so_far_ns = ran_ns().zip(begin_ns).map(|(now, begin)| now - begin);
        if !is_running() || so_far_ns.is_none_or(|ns| ns >= STAYS_AWAKE_NS) {
            return;
        }
    }
}

/// Counts the system calls of sends to a far end that waits as it does in the timed rounds, then of
/// sends to one that is awake and busy with something else.
fn count_calls(end: &mut impl End, role: &mut PartContext<'_>) {
    let flag = &role.shared.flag;
    // Acquire pairs with the Release in `be_counted`.
    while flag.load(Ordering::Acquire) == 0 {
        give_way();
    }
    let far = flag.swap(0, Ordering::AcqRel);
    for awake in [false, true] {
        let mut calls = Some(0);
        for round in 0..=COUNTED {
            if !awake {
                // The far end has sent its answer and may now go to sleep.
                let_wait(far);
            }
            if round == 0 {
                // The first send may have to open the doorbell, so it is not counted.
                end.send(ticks());
            } else {
                let made = count(|| end.send(ticks()));
                calls = calls.zip(made).map(|(calls, made)| calls + made);
            }
            if awake {
                // Release pairs with the Acquire in `be_counted`.
                role.shared.flag.store(round + 1, Ordering::Release);
            }
            end.receive();
        }
        let per_send = calls.map_or(-1.0, |calls| f64::from(calls) / f64::from(COUNTED));
        role.log.note(usize::from(awake), per_send);
    }
}

/// The far end of [`count_calls`].
fn be_counted(end: &mut impl End, role: &PartContext<'_>) {
    // Release pairs with the Acquire in `count_calls`.
    role.shared
        .flag
        .store(std::process::id(), Ordering::Release);
    for awake in [false, true] {
        for round in 0..=COUNTED {
            while awake && role.shared.flag.load(Ordering::Acquire) != round + 1 {
                give_way();
            }
            end.receive();
            end.send(ticks());
        }
    }
}

/// Passes a stamp to and fro between two threads of one process, for peers that only work there.
pub(crate) fn between_threads<E: End + Send>(
    plan: &BatchPlan,
    [mut near, mut far]: [E; 2],
) -> io::Result<Batch> {
    let near = |role: &mut PartContext<'_>| near_end(&mut near, plan, role);
    let far = |role: &mut PartContext<'_>| far_end(&mut far, plan, role);
    let shared = in_threads(plan.cpus, near, far)?;
    Ok(there_and_back(plan, &shared))
}

/// Two threads of one process: parts 0 and 1, on these CPUs.
pub(crate) fn in_threads(
    cpus: [usize; 2],
    first: impl FnOnce(&mut PartContext<'_>),
    second: impl FnOnce(&mut PartContext<'_>) + Send,
) -> io::Result<SharedPage> {
    let shared = SharedPage::new()?;
    let part = BatchPart::on(cpus[0], |role| {
        let mut beside = role.beside(1);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                pin(cpus[1]);
                beside.shared.meet(2);
                second(&mut beside);
                beside.log.close();
            });
            role.shared.meet(2);
            first(role);
        });
        Ok(())
    });
    perform(&shared, vec![part])?;
    Ok(shared)
}

/// Returns a number for a name that no other batch on this machine uses at the same time.
pub(crate) fn next_run() -> u32 {
    static RUNS: AtomicU32 = AtomicU32::new(0);
    (std::process::id() << 8) | (RUNS.fetch_add(1, Ordering::Relaxed) & 0xFF)
}
