//! The figures of the vehicle's time in a run, for `metrics.json`. S-1

use std::collections::BTreeMap;

use serde::Serialize;
use tandem_processes::percentiles::DeviationFigures;
use tandem_record::RunLog;
use tandem_record::clocks::{ChainClock, ClockLog};
use tandem_record::description::is_holdover;

use crate::grandmaster::GrandmasterEnd;

/// A clock converges for this long after it first has a time, ns. Spreads are of what follows.
pub(crate) const CONVERGES_NS: u64 = 5_000_000_000;
/// A time between two states that is longer than this is a time without a clock, ns.
const STATES_APART_NS: u64 = 500_000_000;

/// The figures of one clock. Spreads begin 5 s after it first has a time.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct ClockFigures {
    /// From what other clocks told it.
    pub(crate) offset: Option<DeviationFigures>,
    /// From the run's grandmaster, in holdover too.
    pub(crate) deviation: Option<DeviationFigures>,
    /// Delay of the messages of the clock that it follows.
    pub(crate) delay: Option<DeviationFigures>,
    /// How much faster the vehicle's time ran than the system's clock, in the end, ppm.
    pub(crate) rate_ppm: f64,
    /// For how long it was in holdover, s.
    pub(crate) holdover_s: f64,
    /// How many leaps of another clock it found, told or followed.
    pub(crate) leaps: usize,
}

impl ClockFigures {
    /// `None` if it never had a time.
    fn of(clock: &ClockLog, grandmaster_ns: Option<u64>) -> Option<Self> {
        let first_ns = clock.states.first()?.at_ns;
        let is_counted = |at_ns: u64| at_ns >= first_ns + CONVERGES_NS;
        let samples = || clock.samples.iter().filter(|it| is_counted(it.at_ns));
        let deviations = grandmaster_ns
            .into_iter()
            .flat_map(|it| clock.later_than(it));
        let deviations = deviations.filter(|(at_ns, _)| is_counted(*at_ns));
        let delays = samples().map(|it| i64::from(it.delay_ns));
        Some(Self {
            offset: DeviationFigures::of_ns(samples().map(|it| it.offset_ns.into())),
            deviation: DeviationFigures::of_ns(deviations.map(|(_, by_ns)| by_ns.into())),
            delay: DeviationFigures::of_ns(delays.filter(|ns| *ns > 0)),
            rate_ppm: clock.states.last().map_or(0.0, |it| f64::from(it.rate_ppb)) * 1e-3,
            holdover_s: holdover_ns(clock) as f64 * 1e-9,
            leaps: clock.leaps.len(),
        })
    }
}

fn holdover_ns(clock: &ClockLog) -> u64 {
    let pairs = clock.states.windows(2);
    let pairs = pairs.filter(|pair| is_holdover(pair[0].status));
    let spans = pairs.map(|pair| pair[1].at_ns.saturating_sub(pair[0].at_ns));
    spans.filter(|span| *span < STATES_APART_NS).sum()
}

/// The section `time` of `metrics.json`.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct TimeFigures {
    /// The clocks that had a time: A, B, SoC.
    pub(crate) clocks: BTreeMap<&'static str, ClockFigures>,
    /// The times of A and B apart from each other, from 5 s after A first has one.
    pub(crate) apart: Option<DeviationFigures>,
    /// Starts of the control cycles of A and B apart from each other, since then.
    pub(crate) skew: Option<DeviationFigures>,
    /// By how much the grandmaster's time was later than the run's clock, ns.
    pub(crate) grandmaster_ns: Option<u64>,
    /// How the grandmaster's process ended before the run did.
    pub(crate) grandmaster_died: Option<String>,
}

impl TimeFigures {
    /// `None` if no clock had a time.
    pub(crate) fn of(log: &RunLog, grandmaster: Option<&GrandmasterEnd>) -> Option<Self> {
        let grandmaster_ns = grandmaster.and_then(|it| it.ahead_ns);
        let figures = |of: ChainClock| {
            Some((
                of.name(),
                ClockFigures::of(log.time.clock(of), grandmaster_ns)?,
            ))
        };
        let clocks: BTreeMap<_, _> = ChainClock::ALL.into_iter().filter_map(figures).collect();
        if clocks.is_empty() {
            return None;
        }
        let first = log.time.clock(ChainClock::A).states.first();
        let from_ns = first.map_or(u64::MAX, |it| it.at_ns + CONVERGES_NS);
        let apart = log.time.apart().into_iter();
        let apart = apart.filter(|(at_ns, _)| *at_ns >= from_ns);
        let skews = log.time.skews().into_iter();
        let skews = skews.filter(|(at_ns, _)| *at_ns >= from_ns);
        Some(Self {
            clocks,
            apart: DeviationFigures::of_ns(apart.map(|(_, by_ns)| by_ns.into())),
            skew: DeviationFigures::of_ns(skews.map(|(_, by_ns)| by_ns)),
            grandmaster_ns,
            grandmaster_died: grandmaster.and_then(|it| it.died.clone()),
        })
    }
}
