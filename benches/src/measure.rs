//! Measures the cases in turn, batch by batch, in a new order in each turn, so that the machine's
//! changes affect all cases alike.

use crate::cases::{Candidate, Comparison};
use crate::floor;
use crate::hardware::stolen_ms;
use crate::harness::{Batch, BatchPlan, median};
use crate::shared::draw;
use hdrhistogram::Histogram;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tandem_board_host::UnsupervisedSystem;

/// Measurements of one case so far.
pub(crate) struct Measurement {
    pub(crate) case: Candidate,
    /// All samples, in picoseconds.
    pub(crate) times: Histogram<u64>,
    /// All round trips, in picoseconds; empty if the case is not a ping-pong.
    pub(crate) round_trips: Histogram<u64>,
    /// All latencies from when a message left; empty if messages were not due at fixed times.
    pub(crate) naive: Histogram<u64>,
    /// Summary of each batch, in order, without its samples.
    pub(crate) batches: Vec<Batch>,
    /// Median of each batch, in picoseconds.
    pub(crate) p50_ps: Vec<u64>,
    /// Time of a bare cache line before and after each batch, in picoseconds; `None` if the group
    /// does not depend on it, or if it could not be measured.
    pub(crate) lines_ps: Vec<Option<[u64; 2]>>,
    /// Time that the hypervisor took during each batch, all CPUs, ms, in steps of 10.
    pub(crate) steal_ms: Vec<f64>,
    /// Why the case could not be measured; it is not tried again.
    pub(crate) skipped: Option<String>,
}

impl Measurement {
    /// A measurement without batches.
    pub(crate) fn new(case: Candidate) -> Self {
        let histogram = || Histogram::new(3).expect("3 digits are allowed");
        Self {
            case,
            times: histogram(),
            round_trips: histogram(),
            naive: histogram(),
            batches: vec![],
            p50_ps: vec![],
            lines_ps: vec![],
            steal_ms: vec![],
            skipped: None,
        }
    }

    /// Adds a batch during which the hypervisor took `steal_ms`.
    pub(crate) fn add(&mut self, mut batch: Batch, steal_ms: f64) {
        self.p50_ps.push(median(&mut batch.samples_ps));
        for (into, samples) in [
            (&mut self.times, &mut batch.samples_ps),
            (&mut self.round_trips, &mut batch.round_trips_ps),
            (&mut self.naive, &mut batch.naive_ps),
        ] {
            for sample in std::mem::take(samples) {
                // The histogram grows as needed; only a lack of memory could make this fail.
                let _ = into.record(sample);
            }
        }
        self.steal_ms.push(steal_ms);
        self.batches.push(batch);
    }
}

/// How long to measure.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Span {
    /// Turns continue at least for this time.
    pub(crate) at_least: Duration,
    /// Turns continue at least until each case has had this number of turns.
    pub(crate) turns: usize,
    /// The last turn is cut short after this time, once each case has had a turn.
    pub(crate) at_most: Duration,
}

impl Span {
    /// `tandem bench --seconds`: at least one turn of each case.
    pub(crate) fn of_seconds(seconds: u16) -> Self {
        let at_least = Duration::from_secs(seconds.into());
        Self {
            at_least,
            turns: 1,
            at_most: 4 * at_least + Duration::from_secs(10),
        }
    }

    /// Returns whether to cut this turn short; never the first, because cases would be missing.
    fn is_over(&self, turns: usize, elapsed: Duration) -> bool {
        turns > 0 && elapsed >= self.at_most
    }
}

/// `tandem bench --quick`: always under 40 seconds.
pub(crate) const QUICK: Span = Span {
    at_least: Duration::from_secs(28),
    turns: 3,
    at_most: Duration::from_secs(35),
};

/// `tandem bench`.
pub(crate) const FULL: Span = Span {
    at_least: Duration::from_secs(230),
    turns: 20,
    at_most: Duration::from_secs(400),
};

static INTERRUPTED: AtomicBool = AtomicBool::new(false);

extern "C" fn interrupt(_signal: libc::c_int) {
    INTERRUPTED.store(true, Ordering::Relaxed);
}

/// Returns whether Ctrl-C was pressed since [`run`] began.
pub(crate) fn was_interrupted() -> bool {
    INTERRUPTED.load(Ordering::Relaxed)
}

/// Measures the cases in turn on these two CPUs. `progress` is called before each batch with the
/// part of the span (0 to 1) that has passed, and the case. Ctrl-C ends it early with the results
/// so far.
///
/// Call it while the process has one thread.
pub(crate) fn run(
    system: &'static UnsupervisedSystem,
    cases: impl IntoIterator<Item = Candidate>,
    cpus: [usize; 2],
    span: Span,
    mut progress: impl FnMut(f64, &Candidate),
) -> Vec<Measurement> {
    // SAFETY: the handler only stores to an atomic.
    unsafe {
        let handler: extern "C" fn(libc::c_int) = interrupt;
        libc::signal(libc::SIGINT, handler as libc::sighandler_t);
    }
    let mut all: Vec<Measurement> = cases.into_iter().map(Measurement::new).collect();
    let groups: Vec<Comparison> = all.iter().map(|one| one.case.group).collect();
    let begin = Instant::now();
    let mut turns = 0;
    loop {
        let mut tried = false;
        let mut line_ps = None;
        for at in order(&groups) {
            let measurement = &mut all[at];
            if measurement.skipped.is_some() {
                continue;
            }
            if was_interrupted() || span.is_over(turns, begin.elapsed()) {
                return all;
            }
            let passed = begin.elapsed().as_secs_f64() / span.at_least.as_secs_f64();
            progress(passed.min(1.0), &measurement.case);
            tried = true;
            turn(system, measurement, cpus, &mut line_ps);
        }
        turns += 1;
        if !tried || (turns >= span.turns && begin.elapsed() >= span.at_least) {
            return all;
        }
    }
}

/// Returns the numbers of the cases of these groups in random order, so that no case always follows
/// the same case. The cases of a group stay together, so that mostly they meet the same state.
fn order(groups: &[Comparison]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..groups.len()).collect();
    for at in (1..order.len()).rev() {
        order.swap(at, draw(at + 1));
    }
    let places: Vec<Comparison> = order.iter().map(|at| groups[*at]).collect();
    // The first case of a group, which is any of them, says when the group's turn is.
    order.sort_by_key(|at| places.iter().position(|group| *group == groups[*at]));
    order
}

/// Measures a batch. `line_ps` is the line's time after the batch before, if it was measured, and
/// then that after this batch.
fn turn(
    system: &'static UnsupervisedSystem,
    measurement: &mut Measurement,
    cpus: [usize; 2],
    line_ps: &mut Option<u64>,
) {
    let case = measurement.case;
    let line_now = |known: Option<u64>| {
        let crosses = case.group.crosses_cpus();
        known.or_else(|| crosses.then(|| floor::line_now(cpus).ok())?)
    };
    let line_before = line_now(line_ps.take());
    let plan = BatchPlan {
        rounds: case.rounds,
        // At least 2 rounds, so that each slot of a channel of two slots is used.
        warm_up: (case.rounds / 10).max(2),
        cpus,
        system: Some(system),
    };
    let before_ms = stolen_ms();
    match case.run_batch(&plan) {
        Ok(batch) => {
            measurement.add(batch, stolen_ms() - before_ms);
            *line_ps = line_now(None);
            let lines_ps = line_before
                .zip(*line_ps)
                .map(|(before, after)| [before, after]);
            measurement.lines_ps.push(lines_ps);
        }
        Err(_) if was_interrupted() => {}
        Err(error) => measurement.skipped = Some(error.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cases;

    #[test]
    fn each_turn_has_an_order_of_its_own() {
        let groups: Vec<Comparison> = cases::all().map(|case| case.group).collect();
        let orders: Vec<Vec<usize>> = (0..20).map(|_| order(&groups)).collect();
        for one in &orders {
            let parts = one.chunk_by(|a, b| groups[*a] == groups[*b]).count();
            assert_eq!(parts, groups.chunk_by(|a, b| a == b).count());
            let mut sorted = one.clone();
            sorted.sort_unstable();
            assert!(sorted.into_iter().eq(0..groups.len()));
        }
        let firsts: std::collections::HashSet<usize> = orders.iter().map(|one| one[0]).collect();
        assert!(firsts.len() > 10, "{firsts:?}");
    }

    #[test]
    fn each_case_has_a_turn_however_long_it_takes() {
        let hour = Duration::from_secs(3600);
        for span in [Span::of_seconds(1), QUICK, FULL] {
            assert!(!span.is_over(0, hour) && span.is_over(1, hour));
        }
    }
}
