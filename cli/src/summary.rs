//! The table at the end of a run.

use std::fmt::Write as _;
use std::path::Path;

use tandem_processes::percentiles::DeviationFigures;
use tandem_record::slowest::Part;
use tandem_record::verdict::{Outcome, Verdict};

use crate::metrics::Metrics;
use crate::soc::SocFigures;
use crate::time_figures::TimeFigures;
use crate::topics::IdFigures;

/// Returns the verdict, then the most important figures, and the path of the report.
/// `besides` is what else fails the run.
pub(crate) fn table(metrics: &Metrics, besides: &[String], report: &Path) -> String {
    let mut text = String::new();
    let mut row = |name: &str, value: String| {
        let _ = writeln!(text, "  {name:22}{value}");
    };
    let ms = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.2}"));
    row("verdict", verdict(&metrics.verdict, besides));
    row(
        "scenario",
        format!(
            "{}, {:.1} s, {:.0} m",
            metrics.scenario, metrics.duration_s, metrics.drive.distance_m
        ),
    );
    row("collisions", metrics.drive.collisions.to_string());
    row(
        "lateral error",
        format!("{:.2} m at most", metrics.drive.lateral_error_max_m),
    );
    row(
        "control period",
        format!(
            "p50 {}  p99 {}  p99.9 {}  max {} ms",
            ms(metrics.figures.control_period_p50_ms),
            ms(metrics.control_period_p99_ms),
            ms(metrics.control_period_p99_9_ms),
            ms(metrics.control_period_max_ms)
        ),
    );
    for (name, p50, p99, max) in [
        (
            "sensor to control",
            metrics.reaction_p50_ms,
            metrics.reaction_p99_ms,
            metrics.reaction_max_ms,
        ),
        (
            "age of sensor data",
            metrics.sensor_age_p50_ms,
            metrics.sensor_age_p99_ms,
            metrics.sensor_age_max_ms,
        ),
    ] {
        row(
            name,
            format!("p50 {}  p99 {}  max {} ms", ms(p50), ms(p99), ms(max)),
        );
    }
    if let Some(slowest) = &metrics.reaction_slowest {
        let part = |of: &Part| format!("{} {:.1} ({:.1})", of.part, of.slowest_ms, of.p50_ms);
        let parts: Vec<String> = slowest.parts.iter().map(part).collect();
        row("its slowest 1 % (p50)", format!("{} ms", parts.join(", ")));
        row(
            "",
            format!(
                "{} of {} met a stall; p99 without {} ms",
                slowest.stalled,
                slowest.count,
                ms(slowest.p99_unstalled_ms)
            ),
        );
    }
    row(
        "chain core 1-2-0",
        format!(
            "p50 {}  p99 {}  max {} ms",
            ms(metrics.chain_p50_ms),
            ms(metrics.chain_p99_ms),
            ms(metrics.chain_max_ms)
        ),
    );
    row(
        "control frames",
        format!(
            "{} accepted, {} fenced off",
            metrics.figures.control_frames, metrics.fenced_frames
        ),
    );
    row(
        "first control frame",
        format!("{} ms after power-on", ms(metrics.first_control_ms)),
    );
    row(
        "largest gap",
        format!("{} ms", ms(metrics.control_gap_max_ms)),
    );
    row(
        "two masters",
        format!("{:.1} ms", metrics.figures.two_masters_ms),
    );
    row(
        "both transmitted",
        format!("{:.1} ms", metrics.figures.both_transmitted_ms),
    );
    row("takeovers", takeovers(metrics));
    if let Some(soc) = &metrics.soc {
        row("SoC", parking(soc));
        row("topics", topics(soc));
    }
    if let Some(time) = &metrics.time {
        row("time", together(time));
    }
    row("report", report.display().to_string());
    text
}

/// Returns the verdict in one word or two, and why.
fn verdict(of: &Verdict, besides: &[String]) -> String {
    let parts = of.parts().into_iter().map(|(_, part)| part);
    let parts: Vec<String> = besides.iter().cloned().chain(parts).collect();
    let why = parts.join(&format!("\n{:24}", ""));
    match of.outcome {
        Outcome::UnderControl if besides.is_empty() => format!("good: {why}"),
        Outcome::NotJudged if besides.is_empty() => why,
        _ => format!("failed: {why}"),
    }
}

/// How far A and B were apart.
fn together(time: &TimeFigures) -> String {
    let spread = |what: &str, of: &Option<DeviationFigures>| match of {
        Some(it) => format!("{what} p50 {:.1}  p99 {:.1} us", it.p50_us, it.p99_us),
        None => format!("{what} unknown"),
    };
    let cycles = spread("; control cycles", &time.skew);
    format!("A and B apart: {}{cycles}", spread("clocks", &time.apart))
}

fn parking(soc: &SocFigures) -> String {
    let at_s = soc.phases.last().map_or(0.0, |last| last.at_s);
    match &soc.not_parked {
        None => format!(
            "parked at {at_s:.1} s, {:.2} of {} m",
            soc.driven_m, soc.way_m
        ),
        Some(why) => format!("not parked: {why}"),
    }
}

/// The figures of all frames together.
fn topics(soc: &SocFigures) -> String {
    let sum = |of: fn(&IdFigures) -> u64| soc.ids.iter().map(of).sum::<u64>();
    format!(
        "{} ids, {} frames, {} lost; samples: {} of A, {} of B",
        soc.ids.len(),
        sum(|id| id.frames),
        soc.lost,
        sum(|id| id.samples.a),
        sum(|id| id.samples.b)
    )
}

fn takeovers(metrics: &Metrics) -> String {
    if metrics.figures.takeovers.is_empty() {
        return "none".to_owned();
    }
    let each = metrics.figures.takeovers.iter().map(|takeover| {
        let detected = takeover
            .detected_ms
            .map_or(String::new(), |ms| format!(", detected in {ms:.2} ms"));
        format!(
            "{} to {} at {:.2} s: {}{detected}, {:.1} ms without control",
            takeover.from, takeover.to, takeover.at_s, takeover.cause, takeover.gap_ms
        )
    });
    each.collect::<Vec<_>>().join(&format!("\n{:24}", ""))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::{Surroundings, compute};
    use crate::tests::synthetic;
    use crate::timeline::Timeline;

    #[test]
    fn the_table_names_the_takeover_and_the_report() {
        let metrics = compute(
            &synthetic::with_takeover(10.0),
            &Timeline::default(),
            &Surroundings::default(),
        );
        let text = table(&metrics, &[], Path::new("/x/report.html"));
        assert!(text.contains("A to B at 5.0"), "{text}");
        assert!(text.contains("/x/report.html"), "{text}");
    }

    /// The first line says how the run ended, and why.
    #[test]
    fn the_verdict_stands_first() {
        let mut metrics = compute(
            &synthetic::with_takeover(10.0),
            &Timeline::default(),
            &Surroundings::default(),
        );
        let mut first_line = |outcome, besides: &[&str]| {
            metrics.verdict = Verdict {
                outcome,
                findings: vec![],
            };
            let besides: Vec<String> = besides.iter().map(|it| (*it).to_owned()).collect();
            let text = table(&metrics, &besides, Path::new("/x"));
            let line = text.lines().next().unwrap_or_default().trim();
            let (name, verdict) = line.split_once(' ').unwrap_or_default();
            assert_eq!(name, "verdict");
            verdict.trim().to_owned()
        };
        let good = "good: The vehicle was under control";
        assert!(first_line(Outcome::UnderControl, &[]).starts_with(good));
        assert!(first_line(Outcome::NotJudged, &[]).starts_with("not judged: no real time"));
        let refused = first_line(Outcome::UnderControl, &["no update"]);
        assert_eq!(refused, "failed: no update");
    }
}
