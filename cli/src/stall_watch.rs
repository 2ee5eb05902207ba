//! Records stalls of the machine during a run. A thread on each CPU sleeps for 2 ms at a time and
//! records late wake-ups. A recorded stall begins at the end of the sleep, so it may be up to 2 ms
//! too short, but is never too long.
//!
//! Where real time is permitted, the threads have priority over the whole run (SCHED_FIFO above
//! the supplies), so only the machine itself can delay them. They do no work, and belong to the
//! process `tandem run`, which the systems do not need.
//!
//! At each tick, core 0 of a system postpones the end of the sleep on its CPU, so a thread sleeps
//! while core 0 runs. If core 0 gets no CPU, is stopped or has died, the thread wakes in time. A
//! stall is recorded only if the thread itself was late.

use std::io::Read as _;
use std::os::unix::net::UnixStream;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;

use signal_hook::SigId;
use signal_hook::consts::SIGCONT;
use signal_hook::low_level::{pipe, unregister};
use tandem_board::Duration;
use tandem_board_host::realtime::{Claim, claim};
use tandem_board_host::{Alarm, Expired, clock};
use tandem_record::run_log::{Stall, Stood};
use tandem_record::verdict::Watch;

use tandem_processes::control_core::WATCH_PERIOD;
use tandem_processes::run_config::StallTimer;

/// Period of the threads before a run, while its limits are chosen.
const FINE_PERIOD: Duration = Duration::from_ms(1);
/// A thread that wakes later than this was stalled. Without a stall, p99.9 is 0.2 ms.
pub const LATE: Duration = Duration::from_us(500);
/// Priorities to claim, in this order: above the supplies, which have 80, or equal to them.
const PRIORITIES: [u8; 2] = [90, 80];
/// Longest time from when a stopped thread continues until the SIGCONT handler runs.
const CONTINUED_WITHIN: Duration = Duration::from_ms(50);
/// Largest number of stored stalls for each CPU. It limits the memory; later stalls are ignored.
const MOST: usize = 100_000;

/// The result of the watch.
#[derive(Clone, Debug, Default)]
pub struct Seen {
    /// The times in which a CPU was stalled, in order of time for each CPU.
    pub stalls: Vec<Stall>,
    /// Whether the threads had priority over the run, so that their lateness is evidence.
    pub watch: Watch,
    /// The scheduling of the threads, in words.
    pub watched_by: String,
}

/// The watching threads, from the start to the end of a run.
pub struct StallWatch {
    over: Arc<AtomicBool>,
    threads: Vec<Watcher>,
    signals: Vec<SigId>,
}

/// The thread that watches a CPU.
struct Watcher {
    cpu: usize,
    alarm: Arc<Alarm>,
    /// The real-time priority that the thread was granted, if any.
    fifo: Option<u8>,
    thread: JoinHandle<Vec<Stall>>,
}

impl StallWatch {
    /// Starts a thread on each of these CPUs. Each CPU is given by its number and by its index
    /// among those that this process may use.
    pub fn start(cpus: &[(usize, usize)], realtime: bool) -> Self {
        Self::with_period(cpus, realtime, WATCH_PERIOD)
    }

    fn with_period(cpus: &[(usize, usize)], realtime: bool, period: Duration) -> Self {
        let over = Arc::new(AtomicBool::new(false));
        let (mut threads, mut signals) = (vec![], vec![]);
        for &(number, place) in cpus {
            let priority = move || realtime.then(|| claim_cpu(place)).flatten();
            // If a thread cannot be started, the run continues without its evidence.
            let Some((continued, signal)) = continuations() else {
                continue;
            };
            signals.push(signal);
            threads.extend(Watcher::start(number, period, priority, &over, continued));
        }
        Self {
            over,
            threads,
            signals,
        }
    }

    /// Returns the timers that each core 0 may postpone, for processes that are started from now
    /// on. A thread without priority over core 0 has none, because core 0 would run before it.
    pub(crate) fn timers(&self) -> Vec<StallTimer> {
        let urgent = self.threads.iter().filter(|watcher| watcher.fifo.is_some());
        urgent
            .map(|watcher| StallTimer {
                cpu: watcher.cpu,
                descriptor: watcher.alarm.number(),
            })
            .collect()
    }

    /// Ends the threads and returns their observations.
    pub fn end(self) -> Seen {
        self.over.store(true, Ordering::Relaxed);
        let mut stalls = vec![];
        let priorities = self.threads.iter().map(|watcher| watcher.fifo);
        let least = priorities.min().flatten();
        for Watcher { alarm, thread, .. } in self.threads {
            // Repeat this, because a core 0 that still runs may postpone the timer again.
            while !thread.is_finished() {
                alarm.postpone(Duration::ZERO);
                clock::sleep_until(clock::now() + FINE_PERIOD);
            }
            stalls.extend(thread.join().unwrap_or_default());
        }
        for signal in self.signals {
            unregister(signal);
        }
        let (watch, watched_by) = match least {
            Some(priority) => (
                Watch::Urgent,
                format!("a thread under SCHED_FIFO {priority} on each CPU"),
            ),
            None => (
                Watch::Ordinary,
                "a thread without real-time priority".to_owned(),
            ),
        };
        Seen {
            stalls,
            watch,
            watched_by,
        }
    }
}

/// Blocks for `span`. Returns the longest stall of these CPUs, or [`LATE`] if there was none.
pub fn longest(cpus: &[(usize, usize)], realtime: bool, span: Duration) -> Duration {
    let watch = StallWatch::with_period(cpus, realtime, FINE_PERIOD);
    clock::sleep_until(clock::now() + span);
    let stalls = watch.end().stalls.into_iter();
    let longest = stalls.map(|stall| Duration::from_ns(stall.to_ns - stall.from_ns));
    longest.max().unwrap_or(LATE)
}

/// Pins the thread to the CPU, and returns the priority that was granted.
fn claim_cpu(place: usize) -> Option<u8> {
    PRIORITIES.into_iter().find_map(|priority| {
        let grant = claim(Claim {
            priority: Some(priority),
            cpu: Some(place),
            lock_memory: false,
        });
        grant.fifo
    })
}

impl Watcher {
    /// Starts the thread, and waits until it has claimed its `priority`.
    fn start(
        cpu: usize,
        period: Duration,
        priority: impl FnOnce() -> Option<u8> + Send + 'static,
        over: &Arc<AtomicBool>,
        continued: UnixStream,
    ) -> Option<Self> {
        let alarm = Arc::new(Alarm::new().ok()?);
        let (over, its_alarm) = (Arc::clone(over), Arc::clone(&alarm));
        let (granted, grant) = mpsc::channel();
        let watch = move || {
            let _ = granted.send(priority());
            look(cpu, period, &its_alarm, &over, &continued)
        };
        let named = std::thread::Builder::new().name(format!("stalls of CPU {cpu}"));
        Some(Self {
            cpu,
            alarm,
            thread: named.spawn(watch).ok()?,
            fifo: grant.recv().ok()?,
        })
    }
}

/// Returns a stream that becomes readable after this process was stopped and continued.
fn continuations() -> Option<(UnixStream, SigId)> {
    let (read, write) = UnixStream::pair().ok()?;
    read.set_nonblocking(true).ok()?;
    Some((read, pipe::register(SIGCONT, write).ok()?))
}

fn look(
    cpu: usize,
    period: Duration,
    alarm: &Alarm,
    over: &AtomicBool,
    mut continued: &UnixStream,
) -> Vec<Stall> {
    let mut stalls: Vec<Stall> = Vec::with_capacity(1_024);
    loop {
        alarm.postpone(period);
        let expired = alarm.wait(continued);
        // `end` also makes the timer expire.
        if over.load(Ordering::Relaxed) {
            return stalls;
        }
        // A stop of this process is not a stall. Remove a stall recorded just before the signal.
        if continued.read(&mut [0; 16]).is_ok() {
            let since_ns = clock::now()
                .as_ns()
                .saturating_sub(CONTINUED_WITHIN.as_ns());
            let _stop = stalls.pop_if(|stall| stall.to_ns > since_ns);
            continue;
        }
        let Ok(Some(Expired { due, woken })) = expired else {
            continue;
        };
        if woken.since(due) > LATE && stalls.len() < MOST {
            stalls.push(Stall {
                of: Stood::Cpu(cpu),
                from_ns: due.as_ns(),
                to_ns: woken.as_ns(),
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_watch_ends_at_once_and_its_stalls_lie_within_it() {
        let begin = clock::now();
        let watch = StallWatch::start(&[(0, 0)], false);
        clock::sleep_until(begin + Duration::from_ms(20));
        let seen = watch.end();
        let end = clock::now();
        assert_eq!(seen.watched_by, "a thread without real-time priority");
        assert_eq!(seen.watch, Watch::Ordinary);
        for stall in seen.stalls {
            assert!(begin.as_ns() < stall.from_ns && stall.to_ns <= end.as_ns());
            assert!(stall.to_ns - stall.from_ns > LATE.as_ns());
        }
    }

    /// If another part of the run or a signal delays core 0, core 0 stops postponing the timer.
    /// The sleep then ends in time, and no stall is recorded.
    #[test]
    fn a_core_0_that_is_held_up_is_no_stall() {
        let watch = StallWatch::start(&[(0, 0)], false);
        let alarm = Arc::clone(&watch.threads[0].alarm);
        let core_0 = |ticks| {
            for _ in 0..ticks {
                alarm.postpone(WATCH_PERIOD);
                clock::sleep_until(clock::now() + FINE_PERIOD);
            }
        };
        let held_up = Duration::from_ms(30);
        let mut spans = vec![];
        // The machine may stall in some of the spans, but not in all.
        for _ in 0..10 {
            core_0(40);
            let from = clock::now();
            clock::sleep_until(from + held_up);
            spans.push((from.as_ns(), clock::now().as_ns()));
        }
        core_0(1);
        let stalls = watch.end().stalls;
        let is_calm = |(from_ns, to_ns): &(u64, u64)| {
            let within = |stall: &&Stall| stall.from_ns < *to_ns && *from_ns < stall.to_ns;
            let ns: u64 = stalls
                .iter()
                .filter(within)
                .map(|s| s.to_ns - s.from_ns)
                .sum();
            ns < held_up.as_ns() / 2
        };
        assert!(spans.iter().any(is_calm), "{stalls:?} {spans:?}");
    }
}
