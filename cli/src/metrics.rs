//! Computes the figures of one run, which `metrics.json` contains.

use serde::Serialize;
use tandem_cores::trace::Event;
use tandem_processes::percentiles::Spans;
use tandem_record::log::{DriveFigures, Sample};
use tandem_record::reaction::{Reaction, reaction};
use tandem_record::run_log::Stall;
use tandem_record::slowest::{Slowest, slowest};
use tandem_record::verdict::{Beside, Figures, Verdict};
use tandem_record::{RunLog, ms_between, start};
use tandem_vehicle::Ruling;

use crate::grandmaster::GrandmasterEnd;
use crate::soc::{SocEnd, SocFigures};
use crate::time_figures::TimeFigures;
use crate::timeline::{InterruptMetrics, TaskMetrics, Timeline, WakeMetrics};

/// Value of [`Metrics::schema`]. It identifies a folder as a report.
pub(crate) const SCHEMA: &str = "tandem-metrics/1";
/// Jerk is the change of acceleration over this span, s. A shorter span adds quantisation noise.
const JERK_SPAN_S: f64 = 0.1;

/// Facts about a run that the vehicle's log does not contain.
#[derive(Clone, Debug, Default)]
pub struct Surroundings {
    /// The permissions that the machine granted, in one line: scheduling, pinning, memory.
    pub granted: String,
    /// The timing profile that was chosen: `rt` or `desktop`.
    pub timing: String,
    /// Upper bound of the time until a silent master is detected, from the configured periods, ms.
    pub detection_bound_ms: Option<f64>,
    /// Inputs of the rules of the verdict.
    pub beside: Beside,
    /// Scheduling of the threads that watched for stalls, in words; empty if there were none.
    pub watched_by: String,
    /// How the SoC ended; `None` if the run had none.
    pub soc: Option<SocEnd>,
    /// The grandmaster; `None` if the run had none.
    pub grandmaster: Option<GrandmasterEnd>,
}

/// Contents of `metrics.json`. Scripts rely on the names.
#[derive(Clone, Debug, Serialize)]
pub struct Metrics {
    /// Always [`SCHEMA`].
    pub(crate) schema: String,
    /// Name of the scenario.
    pub(crate) scenario: String,
    /// Seed of the sensors' noise.
    pub(crate) seed: u64,
    /// Scenario time that was driven, s.
    pub(crate) duration_s: f64,
    /// Scenario time that was requested, s.
    pub(crate) duration_asked_s: f64,
    /// The verdict on the run, with the rules that it broke.
    pub(crate) verdict: Verdict,
    /// The figures that the rules read.
    #[serde(flatten)]
    pub(crate) figures: Figures,
    /// The figures that the vehicle itself measured.
    #[serde(flatten)]
    pub(crate) drive: DriveFigures,
    /// Control frames with an outdated term, which the vehicle ignored.
    pub(crate) fenced_frames: usize,
    /// Control frames with wrong protection or content.
    pub(crate) invalid_frames: usize,
    /// Time from the first system's power-on to the first accepted control frame, ms.
    pub(crate) first_control_ms: Option<f64>,
    /// Longest time without an accepted control frame, including takeovers and the run's end, ms.
    pub(crate) control_gap_max_ms: Option<f64>,
    /// Time between two control frames of one mastership, on the sender's clock: 99th percentile,
    /// ms.
    pub(crate) control_period_p99_ms: Option<f64>,
    /// 99.9th percentile of the same, ms.
    pub(crate) control_period_p99_9_ms: Option<f64>,
    /// Maximum of the same, ms.
    pub(crate) control_period_max_ms: Option<f64>,
    /// Median of the time from a measurement to the first control frame that reflects it, ms.
    #[serde(default)]
    pub(crate) reaction_p50_ms: Option<f64>,
    /// 99th percentile of the same, ms.
    #[serde(default)]
    pub(crate) reaction_p99_ms: Option<f64>,
    /// Maximum of the same, ms.
    #[serde(default)]
    pub(crate) reaction_max_ms: Option<f64>,
    /// Where the slowest percent of these times was spent; `None` if the trace has no chain.
    pub(crate) reaction_slowest: Option<Slowest>,
    /// Median of the age of the oldest measurement behind an accepted control frame, ms.
    #[serde(default)]
    pub(crate) sensor_age_p50_ms: Option<f64>,
    /// 99th percentile of the same, ms.
    #[serde(default)]
    pub(crate) sensor_age_p99_ms: Option<f64>,
    /// Maximum of the same, ms.
    #[serde(default)]
    pub(crate) sensor_age_max_ms: Option<f64>,
    /// Median of the time from a measurement over cores 1 and 2 to core 0's command, ms.
    pub(crate) chain_p50_ms: Option<f64>,
    /// 99th percentile of the same, ms.
    pub(crate) chain_p99_ms: Option<f64>,
    /// 99.9th percentile of the same, ms.
    pub(crate) chain_p99_9_ms: Option<f64>,
    /// Maximum of the same, ms.
    pub(crate) chain_max_ms: Option<f64>,
    /// Number and longest duration of the machine's stalls.
    pub(crate) stalls: StallMetrics,
    /// Upper bound of the time until a silent master is detected, from the configured periods, ms.
    pub(crate) detection_bound_ms: Option<f64>,
    /// Upper bound of the time without control after a master falls silent, ms.
    pub(crate) gap_bound_ms: Option<f64>,
    /// Time between the ends of the start protocol in both systems, µs, if they left it together.
    pub(crate) start_skew_us: Option<f64>,
    /// Number of control cycles that a core reported as missed.
    pub(crate) deadline_misses: u64,
    /// Number, duration and punctuality of the jobs of each task of each core.
    pub(crate) tasks: Vec<TaskMetrics>,
    /// Number and duration of the runs of each interrupt handler.
    pub(crate) interrupts: Vec<InterruptMetrics>,
    /// Latency of the signals between cores.
    pub(crate) wakes: Vec<WakeMetrics>,
    /// The timing profile: `rt` or `desktop`.
    pub(crate) timing: String,
    /// The permissions that the machine granted, in one line.
    pub(crate) granted: String,
    /// Trace records that were lost because the trace was full.
    pub(crate) lost_trace: u64,
    /// Time in which the world did not advance because the vehicle's process was stopped, ms.
    pub(crate) stalled_ms: f64,
    /// What the SoC did and heard; only in runs with one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) soc: Option<SocFigures>,
    /// The vehicle's time; only in runs with one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) time: Option<TimeFigures>,
}

/// The type of [`Metrics::stalls`].
#[derive(Clone, Debug, Default, Serialize)]
pub(crate) struct StallMetrics {
    /// Scheduling of the watching threads, in words. Empty on a board in virtual time.
    pub(crate) watched_by: String,
    /// Number of late wake-ups of these threads.
    pub(crate) count: usize,
    /// The longest stall, ms; 0 if there was none.
    pub(crate) longest_ms: f64,
    /// Number of delays of the vehicle's process, which is the bus.
    pub(crate) bus_count: usize,
}

/// Returns the times between two consecutive control frames of one mastership, on the sender's
/// clock, ms.
pub(crate) fn control_periods_ms(log: &RunLog) -> Vec<f64> {
    let accepted: Vec<_> = log.accepted().collect();
    accepted
        .windows(2)
        .filter(|pair| (pair[0].system, pair[0].term) == (pair[1].system, pair[1].term))
        .map(|pair| ms_between(pair[0].sent_ns, pair[1].sent_ns))
        .collect()
}

/// Returns the latencies of the chain core 1 → 2 → 0, ms.
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

/// Returns the longitudinal jerk over time: (scenario time s, m/s³).
pub(crate) fn jerk(log: &RunLog) -> Vec<(f64, f64)> {
    let mut points = Vec::with_capacity(log.samples.len());
    let mut earlier = log.samples.iter().peekable();
    for sample in &log.samples {
        let span_s = |from: &Sample| (sample.at_ns - from.at_ns) as f64 * 1e-9;
        // Take the latest sample that is at least one span older.
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

/// Returns the longest time without an accepted control frame, ms: between two of them, or from
/// the last one to the end of the run.
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

/// Returns the duration of a stall, ms.
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
        ..
    } = reaction(log);
    let (reaction, age) = (Spans::from_ms(reaction_ms), Spans::from_ms(age_ms));
    let machine = &around.beside.stalls;
    let figures = Figures::of(log, &around.beside, period.percentile_ms(50.0));
    let count = |ruling| {
        log.control
            .iter()
            .filter(|frame| frame.ruling == ruling)
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
        reaction_slowest: slowest(log, machine),
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
        soc: around.soc.as_ref().map(|end| SocFigures::of(end, log)),
        time: TimeFigures::of(log, around.grandmaster.as_ref()),
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
