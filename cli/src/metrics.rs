//! The figures of one run, as `metrics.json` has them.

use serde::Serialize;
use tandem_cores::trace::Event;
use tandem_record::log::{DriveFigures, Sample};
use tandem_record::reaction::{Reaction, reaction};
use tandem_record::run_log::Stall;
use tandem_record::verdict::{Beside, Figures, Verdict};
use tandem_record::{RunLog, ms_between, start};
use tandem_vehicle::Ruling;

use crate::percentiles::Spans;
use crate::timeline::{InterruptMetrics, TaskMetrics, Timeline, WakeMetrics};

/// Value of [`Metrics::schema`], by which a report folder is recognised.
pub(crate) const SCHEMA: &str = "tandem-metrics/1";
/// Jerk is the change of acceleration over this span, s. Shorter spans show the log's resolution.
const JERK_SPAN_S: f64 = 0.1;

/// The knowledge of the run beside the vehicle's log.
#[derive(Clone, Debug, Default)]
pub struct Surroundings {
    /// The permissions that were granted, in a line: scheduling, pinning, memory.
    pub granted: String,
    /// The timing profile that followed: `rt` or `desktop`.
    pub timing: String,
    /// How long a silent master can stay unnoticed at most, ms, by the configured periods.
    pub detection_bound_ms: Option<f64>,
    /// What the rules of a good run need.
    pub beside: Beside,
    /// How the threads that watched for stalls were scheduled, in words; empty if there were none.
    pub watched_by: String,
}

/// Contents of `metrics.json`. Scripts rely on the names.
#[derive(Clone, Debug, Serialize)]
pub struct Metrics {
    /// [`SCHEMA`]
    pub(crate) schema: String,
    /// Name of the scenario.
    pub(crate) scenario: String,
    /// Seed of the sensors' noise.
    pub(crate) seed: u64,
    /// Scenario time that was driven, s.
    pub(crate) duration_s: f64,
    /// Scenario time that was asked for, s.
    pub(crate) duration_asked_s: f64,
    /// How the run is judged, and the rules that it broke.
    pub(crate) verdict: Verdict,
    /// What the rules read.
    #[serde(flatten)]
    pub(crate) figures: Figures,
    /// The vehicle's own figures.
    #[serde(flatten)]
    pub(crate) drive: DriveFigures,
    /// Control frames that came with an outdated term and were ignored.
    pub(crate) fenced_frames: usize,
    /// Control frames whose protection or content was wrong.
    pub(crate) invalid_frames: usize,
    /// From the first system's power-on to the first accepted control frame, ms.
    pub(crate) first_control_ms: Option<f64>,
    /// Longest time between two accepted control frames, over takeovers and to the end, ms.
    pub(crate) control_gap_max_ms: Option<f64>,
    /// Time between two control frames of one mastership, by the sender's clock: 99 of 100 are not
    /// longer, ms.
    pub(crate) control_period_p99_ms: Option<f64>,
    /// 999 of 1000 are not longer, ms.
    pub(crate) control_period_p99_9_ms: Option<f64>,
    /// The longest, ms.
    pub(crate) control_period_max_ms: Option<f64>,
    /// Median of the time from a measurement to the first control frame that reflects it, ms.
    #[serde(default)]
    pub(crate) reaction_p50_ms: Option<f64>,
    /// 99 of 100 are not longer, ms.
    #[serde(default)]
    pub(crate) reaction_p99_ms: Option<f64>,
    /// The longest, ms.
    #[serde(default)]
    pub(crate) reaction_max_ms: Option<f64>,
    /// Median of the age of the oldest measurement behind a control frame that acts, ms.
    #[serde(default)]
    pub(crate) sensor_age_p50_ms: Option<f64>,
    /// 99 of 100 are not older, ms.
    #[serde(default)]
    pub(crate) sensor_age_p99_ms: Option<f64>,
    /// The oldest, ms.
    #[serde(default)]
    pub(crate) sensor_age_max_ms: Option<f64>,
    /// Median of the time from a measurement over cores 1 and 2 to core 0's command, ms.
    pub(crate) chain_p50_ms: Option<f64>,
    /// 99 of 100 are not longer, ms.
    pub(crate) chain_p99_ms: Option<f64>,
    /// 999 of 1000 are not longer, ms.
    pub(crate) chain_p99_9_ms: Option<f64>,
    /// The longest, ms.
    pub(crate) chain_max_ms: Option<f64>,
    /// How often, and how long at most, the machine stood still.
    pub(crate) stalls: StallMetrics,
    /// How long a silent master can stay unnoticed at most, ms, by the configured periods.
    pub(crate) detection_bound_ms: Option<f64>,
    /// How long the vehicle can be without control at most when a master falls silent, ms.
    pub(crate) gap_bound_ms: Option<f64>,
    /// How far apart the two systems left the start protocol, µs, if they left it together.
    pub(crate) start_skew_us: Option<f64>,
    /// Control cycles that a core reported as late.
    pub(crate) deadline_misses: u64,
    /// How often and how long each task of each core ran, and whether in time.
    pub(crate) tasks: Vec<TaskMetrics>,
    /// How often and how long each handler of an interrupt ran.
    pub(crate) interrupts: Vec<InterruptMetrics>,
    /// How long signals from core to core took.
    pub(crate) wakes: Vec<WakeMetrics>,
    /// The timing profile: `rt` or `desktop`.
    pub(crate) timing: String,
    /// The permissions that were granted, in a line.
    pub(crate) granted: String,
    /// Trace records that were lost because the trace was full.
    pub(crate) lost_trace: u64,
    /// How long the world stood still because the vehicle's process was stopped, ms.
    pub(crate) stalled_ms: f64,
}

/// [`Metrics::stalls`].
#[derive(Clone, Debug, Default, Serialize)]
pub(crate) struct StallMetrics {
    /// How the watching threads were scheduled, in words. Empty on a board in virtual time.
    pub(crate) watched_by: String,
    /// How often it woke late.
    pub(crate) count: usize,
    /// The longest stall, ms; 0 if there was none.
    pub(crate) longest_ms: f64,
    /// How often the vehicle's process, which is the bus, was held up.
    pub(crate) bus_count: usize,
}

/// Times between two control frames that follow each other in one mastership, by the sender's
/// clock, ms.
pub(crate) fn control_periods_ms(log: &RunLog) -> Vec<f64> {
    let accepted: Vec<_> = log.accepted().collect();
    accepted
        .windows(2)
        .filter(|pair| (pair[0].system, pair[0].term) == (pair[1].system, pair[1].term))
        .map(|pair| ms_between(pair[0].sent_ns, pair[1].sent_ns))
        .collect()
}

/// Latencies of the chain core 1 → 2 → 0, ms.
pub(crate) fn chain_ms(log: &RunLog) -> Vec<f64> {
    let latency = |event: Event| match event {
        Event::Chain { latency_ns, .. } => Some(f64::from(latency_ns) * 1e-6),
        _ => None,
    };
    log.events
        .iter()
        .filter_map(|event| latency(event.event))
        .collect()
}

/// Longitudinal jerk over time: (scenario time s, m/s³).
pub(crate) fn jerk(log: &RunLog) -> Vec<(f64, f64)> {
    let mut points = Vec::with_capacity(log.samples.len());
    let mut earlier = log.samples.iter().peekable();
    for sample in &log.samples {
        let span_s = |from: &Sample| (sample.at_ns - from.at_ns) as f64 * 1e-9;
        // The latest sample that is a whole span older.
        let mut from = None;
        while let Some(candidate) = earlier.next_if(|s| span_s(s) >= JERK_SPAN_S - 1e-6) {
            from = Some(candidate);
        }
        if let Some(from) = from {
            let mid_ns = from.at_ns + (sample.at_ns - from.at_ns) / 2;
            points.push((
                log.seconds(mid_ns),
                (sample.accel - from.accel) / span_s(from),
            ));
        }
    }
    points
}

fn first_control_ms(log: &RunLog) -> Option<f64> {
    let on = log.power.iter().find(|change| change.on)?;
    let first_ns = log.accepted().next()?.at_ns;
    Some(first_ns.saturating_sub(on.at_ns) as f64 * 1e-6)
}

/// Longest time without an accepted control frame, ms: between two of them, or from the last one to
/// the end of the run.
fn control_gap_max_ms(log: &RunLog) -> Option<f64> {
    let last_ns = log.accepted().last()?.at_ns;
    let until_ns = log.until_ns().unwrap_or(last_ns);
    Some(log.mastership().gap_max_ns(until_ns) as f64 * 1e-6)
}

fn deadline_misses(log: &RunLog) -> u64 {
    let missed = |event: Event| match event {
        Event::DeadlineMiss { task, missed } if task.is_control() => Some(u64::from(missed)),
        _ => None,
    };
    log.events
        .iter()
        .filter_map(|event| missed(event.event))
        .sum()
}

/// Milliseconds of a stall.
fn stall_ms(stall: &Stall) -> f64 {
    ms_between(stall.from_ns, stall.to_ns)
}

/// Computes all figures of a run.
pub(crate) fn compute(log: &RunLog, timeline: &Timeline, around: &Surroundings) -> Metrics {
    let period = Spans::from_ms(control_periods_ms(log));
    let chain = Spans::from_ms(chain_ms(log));
    let Reaction {
        reaction_ms,
        age_ms,
    } = reaction(log);
    let (reaction, age) = (Spans::from_ms(reaction_ms), Spans::from_ms(age_ms));
    let machine = &around.beside.stalls;
    let figures = Figures::of(log, &around.beside, period.percentile_ms(50.0));
    let count = |verdict| {
        log.control
            .iter()
            .filter(|frame| frame.verdict == verdict)
            .count()
    };
    Metrics {
        schema: SCHEMA.to_owned(),
        scenario: log.header.scenario.clone(),
        seed: log.header.seed,
        duration_s: log.driven_s(),
        duration_asked_s: log.header.duration_s,
        verdict: figures.verdict(log, &around.beside),
        figures,
        drive: log.figures.clone(),
        fenced_frames: count(Ruling::Fenced),
        invalid_frames: count(Ruling::Invalid),
        first_control_ms: first_control_ms(log),
        control_gap_max_ms: control_gap_max_ms(log),
        control_period_p99_ms: period.percentile_ms(99.0),
        control_period_p99_9_ms: period.percentile_ms(99.9),
        control_period_max_ms: period.max_ms(),
        reaction_p50_ms: reaction.percentile_ms(50.0),
        reaction_p99_ms: reaction.percentile_ms(99.0),
        reaction_max_ms: reaction.max_ms(),
        sensor_age_p50_ms: age.percentile_ms(50.0),
        sensor_age_p99_ms: age.percentile_ms(99.0),
        sensor_age_max_ms: age.max_ms(),
        chain_p50_ms: chain.percentile_ms(50.0),
        chain_p99_ms: chain.percentile_ms(99.0),
        chain_p99_9_ms: chain.percentile_ms(99.9),
        chain_max_ms: chain.max_ms(),
        stalls: StallMetrics {
            watched_by: around.watched_by.clone(),
            count: machine.len(),
            longest_ms: machine.iter().map(stall_ms).fold(0.0, f64::max),
            bus_count: log.held_up.len(),
        },
        detection_bound_ms: around.detection_bound_ms,
        gap_bound_ms: Some(around.beside.bounds.silent_ms).filter(|ms| ms.is_finite()),
        start_skew_us: start::skew_ns(log).map(|ns| ns as f64 * 1e-3),
        deadline_misses: deadline_misses(log),
        tasks: timeline.tasks.clone(),
        interrupts: timeline.interrupts(),
        wakes: timeline.wakes(),
        timing: around.timing.clone(),
        granted: around.granted.clone(),
        lost_trace: log.lost_trace,
        stalled_ms: log.stalled_ms,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::synthetic;

    #[test]
    fn scripts_find_the_names_that_they_rely_on() {
        let metrics = compute(
            &synthetic::with_takeover(20.0),
            &Timeline::default(),
            &Surroundings::default(),
        );
        let json = serde_json::to_value(&metrics).unwrap();
        for name in [
            "scenario",
            "duration_s",
            "collisions",
            "control_frames",
            "control_gap_max_ms",
            "control_period_p99_ms",
            "two_masters_ms",
            "takeovers",
            "lateral_error_max_m",
            "false_takeovers",
            "leftovers",
        ] {
            assert!(!json[name].is_null(), "{name}");
        }
        for name in ["cause", "detected_ms", "gap_ms"] {
            assert!(!json["takeovers"][0][name].is_null(), "{name}");
        }
    }

    #[test]
    fn the_figures_of_a_run_with_a_takeover_are_those_it_was_made_with() {
        let metrics = compute(
            &synthetic::with_takeover(20.0),
            &Timeline::default(),
            &Surroundings::default(),
        );
        assert_eq!(metrics.figures.takeovers.len(), 1);
        assert_eq!(metrics.figures.two_masters_ms, 0.0);
        assert_eq!(metrics.figures.false_takeovers, 0);
        assert!((metrics.figures.takeovers[0].at_s - 10.0).abs() < 0.05);
        let gap = metrics.control_gap_max_ms.unwrap();
        assert!((gap - metrics.figures.takeovers[0].gap_ms).abs() < 1e-9);
        let p99 = metrics.control_period_p99_ms.unwrap();
        assert!((9.0..11.0).contains(&p99), "{p99}");
    }

    #[test]
    fn a_controller_that_falls_silent_for_good_is_a_gap_to_the_end() {
        let mut log = synthetic::with_takeover(20.0);
        log.control.retain(|frame| {
            log.start_ns
                .is_some_and(|s| frame.at_ns < s + 5_000_000_000)
        });
        let gap = compute(&log, &Timeline::default(), &Surroundings::default())
            .control_gap_max_ms
            .unwrap();
        assert!((gap - 15_000.0).abs() < 20.0, "{gap}");
    }

    #[test]
    fn jerk_is_the_slope_of_acceleration() {
        let mut log = RunLog {
            start_ns: Some(0),
            ..RunLog::default()
        };
        for step in 0..100_u64 {
            let (at_ns, accel) = (step * 20_000_000, step as f64 * 0.04);
            log.samples.push(Sample {
                at_ns,
                accel,
                ..Sample::default()
            });
        }
        let jerk = jerk(&log);
        assert!(jerk.len() > 90);
        assert!(
            jerk.iter().all(|(_, jerk)| (jerk - 2.0).abs() < 1e-6),
            "{jerk:?}"
        );
    }
}
