//! Evidence of what the machine did during a run: a bare thread on each CPU that sleeps for two
//! milliseconds again and again, and notes when it woke late. A stall is noted from the end of the
//! sleep, so up to two milliseconds too short, never too long.
//!
//! Where real time is permitted, the threads go before all of the run (SCHED_FIFO above the
//! supplies): what holds them up is not Tandem, but the machine below it. They do no work, share
//! nothing with the run, and run in `tandem run`, without which the systems would drive as well.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use signal_hook::SigId;
use signal_hook::consts::SIGCONT;
use tandem_board::Duration;
use tandem_board_host::clock;
use tandem_board_host::realtime::{Claim, claim};
use tandem_record::run_log::{Stall, Stood};

/// Time between two looks at the clock during a run: each look is a wake-up of a CPU that drives.
const PERIOD: Duration = Duration::from_ms(2);
/// The same before a run, when its limits are chosen.
const FINE_PERIOD: Duration = Duration::from_ms(1);
/// A thread that wakes later than this was held up. Seen without a stall: 0.2 ms at p99.9.
pub const LATE: Duration = Duration::from_us(500);
/// Above the supplies, which have 80; less where no more is permitted.
const PRIORITIES: [u8; 2] = [90, 80];
/// More stalls than this are not kept: a machine in this state explains no run.
const MOST: usize = 100_000;

/// The observations of the threads.
#[derive(Clone, Debug, Default)]
pub struct Seen {
    /// The times in which a CPU was gone, in order of each CPU.
    pub stalls: Vec<Stall>,
    /// How the threads were scheduled, in words.
    pub watched_by: String,
}

/// The threads, from the start to the end of a run.
pub struct StallWatch {
    over: Arc<AtomicBool>,
    threads: Vec<JoinHandle<(Option<u8>, Vec<Stall>)>>,
    signals: Vec<SigId>,
}

impl StallWatch {
    /// Starts a thread on each of these CPUs, given by number and by place among those that this
    /// process may use.
    pub fn start(cpus: &[(usize, usize)], realtime: bool) -> Self {
        Self::with_period(cpus, realtime, PERIOD)
    }

    fn with_period(cpus: &[(usize, usize)], realtime: bool, period: Duration) -> Self {
        let over = Arc::new(AtomicBool::new(false));
        let (mut threads, mut signals) = (vec![], vec![]);
        for &(number, place) in cpus {
            let continued = Arc::new(AtomicBool::new(false));
            // Without the signal a stop of this process would look like a stall.
            signals.extend(signal_hook::flag::register(SIGCONT, Arc::clone(&continued)));
            let over = Arc::clone(&over);
            let watch = move || {
                let fifo = realtime.then(|| claim_cpu(place)).flatten();
                (fifo, look(number, period, &over, &continued))
            };
            let named = std::thread::Builder::new().name(format!("stalls of CPU {number}"));
            // A machine without room for a thread gives no evidence; the run goes on.
            threads.extend(named.spawn(watch));
        }
        Self {
            over,
            threads,
            signals,
        }
    }

    /// Ends the threads; what they saw.
    pub fn end(self) -> Seen {
        self.over.store(true, Ordering::Relaxed);
        let (mut stalls, mut fifo) = (vec![], None);
        for thread in self.threads {
            if let Ok((granted, seen)) = thread.join() {
                fifo = granted;
                stalls.extend(seen);
            }
        }
        for signal in self.signals {
            signal_hook::low_level::unregister(signal);
        }
        let watched_by = match fifo {
            Some(priority) => format!("a thread under SCHED_FIFO {priority} on each CPU"),
            None => "a thread without real-time priority".to_owned(),
        };
        Seen { stalls, watched_by }
    }
}

/// The longest stall of these CPUs within `span`; of shorter ones than [`LATE`] nothing is known.
/// Blocks for that long.
pub fn longest(cpus: &[(usize, usize)], realtime: bool, span: Duration) -> Duration {
    let watch = StallWatch::with_period(cpus, realtime, FINE_PERIOD);
    clock::sleep_until(clock::now() + span);
    let stalls = watch.end().stalls.into_iter();
    let longest = stalls.map(|stall| Duration::from_ns(stall.to_ns - stall.from_ns));
    longest.max().unwrap_or(LATE)
}

/// Claims the CPU; the priority that was granted.
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

fn look(cpu: usize, period: Duration, over: &AtomicBool, continued: &AtomicBool) -> Vec<Stall> {
    let mut stalls = Vec::with_capacity(1_024);
    while !over.load(Ordering::Relaxed) {
        let due = clock::now() + period;
        clock::sleep_until(due);
        let now = clock::now();
        let was_stopped = continued.swap(false, Ordering::Relaxed);
        if now.since(due) > LATE && !was_stopped && stalls.len() < MOST {
            stalls.push(Stall {
                of: Stood::Cpu(cpu),
                from_ns: due.as_ns(),
                to_ns: now.as_ns(),
            });
        }
    }
    stalls
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
        for stall in seen.stalls {
            assert!(begin.as_ns() < stall.from_ns && stall.to_ns <= end.as_ns());
            assert!(stall.to_ns - stall.from_ns > LATE.as_ns());
        }
    }
}
