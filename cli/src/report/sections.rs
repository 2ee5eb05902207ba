//! The charts of a report, with the data of the run that each one shows.

use crate::metrics::{chain_ms, control_periods_ms, jerk};
use tandem_processes::percentiles::Spans;

use tandem_board::SystemId;
use tandem_page::chart::{self, Axis, Chart, Polygon, Series, Style, thin};
use tandem_page::svg::Color;
use tandem_record::log::Sample;
use tandem_record::roles::{RoleState, timeline};
use tandem_record::{RunLog, Takeover, ms_between};

/// Largest number of points in a line: all of the first 80 s of a run. More would enlarge the file.
const LINE_POINTS: usize = 4_000;
/// Largest number of dots: all control frames of the first 80 s.
pub(super) const DOTS: usize = 8_000;
/// Time before the sample at which a line breaks, s. The samples are 20 ms apart.
const BREAK_S: f64 = 0.001;

/// Shorter spans are drawn with this length, ms, because a logarithmic axis has no zero.
const SHORTEST_MS: f64 = 0.001;

/// Returns the colour of a system.
pub(super) const fn system_color(system: SystemId) -> Color {
    match system {
        SystemId::A => Color::A,
        SystemId::B => Color::B,
    }
}

/// Returns the colour of a state.
pub(super) const fn state_color(state: RoleState) -> Option<Color> {
    match state {
        RoleState::Master => Some(Color::GOOD),
        RoleState::Degraded => Some(Color::WARN),
        RoleState::Parking => Some(Color::A),
        RoleState::SafeStop => Some(Color::B),
        RoleState::Standby => Some(Color::CALM),
        RoleState::Starting => Some(Color::PALE),
        RoleState::Suspended => Some(Color::BAD),
        RoleState::Off => None,
    }
}

fn over_time(log: &RunLog, value: impl Fn(&Sample) -> f64) -> Vec<(f64, f64)> {
    log.samples
        .iter()
        .map(|sample| (log.seconds(sample.at_ns), value(sample)))
        .collect()
}

pub(super) fn line(name: &str, color: Color, points: &[(f64, f64)]) -> Series {
    // Thinning sorts values. Do not thin a line with gaps, because its pieces must stay apart.
    let whole = points.iter().any(|point| !point.1.is_finite());
    let points = if whole {
        points.to_vec()
    } else {
        thin(points, LINE_POINTS)
    };
    series(name, color, Style::Line(2.0), points)
}

/// Returns a series without a tooltip.
pub(super) fn series(
    name: impl Into<String>,
    color: Color,
    style: Style,
    points: Vec<(f64, f64)>,
) -> Series {
    Series {
        name: name.into(),
        title: String::new(),
        color,
        style,
        points,
    }
}

/// Returns a chart over scenario time, with marks of the takeovers.
pub(super) fn time_chart(
    log: &RunLog,
    takeovers: &[Takeover],
    height: f64,
    unit: &'static str,
    series: Vec<Series>,
) -> Chart {
    let values = series
        .iter()
        .flat_map(|series| &series.points)
        .map(|point| point.1);
    let y = Axis::over(unit, values, 5);
    let mut chart = Chart::new(height, Axis::time(log.driven_s()), y);
    chart.marks = marks(log, takeovers);
    chart.series = series;
    chart
}

fn marks(log: &RunLog, takeovers: &[Takeover]) -> Vec<f64> {
    takeovers
        .iter()
        .map(|takeover| log.seconds(takeover.at_ns))
        .collect()
}

/// Draws the roles of both systems as bars, and below them when one of them was alone.
pub(super) fn roles(log: &RunLog, takeovers: &[Takeover], alone: &[(f64, f64)]) -> Chart {
    let y = Axis::rows(3, |value| {
        ["alone", "B", "A"][value as usize % 3].to_owned()
    });
    let mut chart = Chart::new(150.0, Axis::time(log.driven_s()), y);
    chart.grid = false;
    for (system, row) in [(SystemId::A, 2), (SystemId::B, 1)] {
        for span in timeline(log, system) {
            if let Some(color) = state_color(span.state) {
                let span_s = (span.from_s, span.to_s);
                let bar = Polygon::bar(span.state.name(), color, span_s, row);
                chart.shapes.push(bar);
            }
        }
    }
    let alone =
        { alone.iter() }.map(|span_s| Polygon::bar("no redundancy", Color::BAD, *span_s, 0));
    chart.shapes.extend(alone);
    chart.marks = marks(log, takeovers);
    chart
}

/// Draws the distance from the centre of the lane. The line is broken where the vehicle crosses
/// into another lane, because the distance jumps.
pub(super) fn lateral(log: &RunLog, takeovers: &[Takeover]) -> Chart {
    let mut points: Vec<(f64, f64)> = Vec::with_capacity(log.samples.len());
    let mut lane = None;
    for sample in &log.samples {
        let at_s = log.seconds(sample.at_ns);
        if lane
            .replace(sample.lane)
            .is_some_and(|before| before != sample.lane)
        {
            // Between the two samples: a plot has one value at a time.
            points.push((at_s - BREAK_S, f64::NAN));
        }
        points.push((at_s, sample.lateral_error));
    }
    let series = vec![line("lateral error", Color::A, &points)];
    let mut chart = time_chart(log, takeovers, 230.0, "m, left +", series);
    let (low, high) = chart.y.range;
    // Make the axis wide enough that noise of a centimetre does not look like a swerve.
    chart.y = Axis::linear("m, left +", (low.min(-0.3), high.max(0.3)), 5);
    chart
}

/// Draws the speed and the requested speed.
pub(super) fn speed(log: &RunLog, takeovers: &[Takeover]) -> Chart {
    let set = thin(
        &over_time(log, |s| s.set_speed.unwrap_or(f64::NAN)),
        LINE_POINTS,
    );
    let series = vec![
        series(
            "set by the driver",
            Color::MUTED,
            Style::Dashed(1.0, "6 4"),
            set,
        ),
        line("own speed", Color::A, &over_time(log, |s| s.speed)),
    ];
    time_chart(log, takeovers, 230.0, "m/s", series)
}

/// Draws the distance to the vehicle ahead; `None` if no vehicle was ever ahead.
pub(super) fn lead_gap(log: &RunLog, takeovers: &[Takeover]) -> Option<Chart> {
    log.samples
        .iter()
        .any(|sample| sample.lead_gap.is_some())
        .then(|| {
            let points = over_time(log, |s| s.lead_gap.unwrap_or(f64::NAN));
            let mut chart = time_chart(
                log,
                takeovers,
                210.0,
                "m",
                vec![line("gap", Color::A, &points)],
            );
            chart.y = Axis::linear("m", (0.0, chart.y.range.1), 5);
            chart
        })
}

/// Draws the accelerations, and the jerk.
pub(super) fn comfort(log: &RunLog, takeovers: &[Takeover]) -> [Chart; 2] {
    let accelerations = vec![
        line("lateral", Color::OTHER, &over_time(log, |s| s.lat_accel)),
        line("longitudinal", Color::A, &over_time(log, |s| s.accel)),
    ];
    let jerk = vec![line("jerk", Color::A, &jerk(log))];
    [
        time_chart(log, takeovers, 210.0, "m/s²", accelerations),
        time_chart(log, takeovers, 190.0, "m/s³", jerk),
    ]
}

/// Draws every gap between two accepted control frames, by the system that ended it.
pub(super) fn gaps(log: &RunLog, takeovers: &[Takeover]) -> Chart {
    let accepted: Vec<_> = log.accepted().collect();
    let gaps: Vec<_> = accepted
        .windows(2)
        .map(|pair| {
            let gap_ms = ms_between(pair[0].at_ns, pair[1].at_ns);
            (
                pair[1].system,
                log.seconds(pair[1].at_ns),
                gap_ms.max(0.1).log10(),
            )
        })
        .collect();
    let top = gaps.iter().map(|gap| gap.2.ceil() as i32).fold(2, i32::max);
    let y = Axis::decades("ms", (0, top), chart::power);
    let mut chart = Chart::new(230.0, Axis::time(log.driven_s()), y);
    for system in SystemId::ALL {
        let points: Vec<_> = gaps
            .iter()
            .filter(|gap| gap.0 == system)
            .map(|gap| (gap.1, gap.2.max(0.0)))
            .collect();
        let name = format!("accepted from {system}");
        let dots = thin(&points, DOTS);
        let color = system_color(system);
        chart.series.push(series(name, color, Style::Dots, dots));
    }
    chart.marks = marks(log, takeovers);
    chart
}

/// Draws the distributions of the control period and of the chain over percentiles.
pub(super) fn percentiles(log: &RunLog) -> Chart {
    let curves = [
        (
            "control period",
            Color::A,
            Spans::from_ms(control_periods_ms(log)).curve(),
        ),
        (
            "chain core 1 → 2 → 0",
            Color::B,
            Spans::from_ms(chain_ms(log)).curve(),
        ),
    ];
    let all_series: Vec<Series> = curves
        .into_iter()
        .filter(|(_, _, curve)| !curve.is_empty())
        .map(|(name, color, curve)| {
            let place = |(rarity, ms): &(f64, f64)| (rarity.log10(), ms.max(SHORTEST_MS).log10());
            let points = curve.iter().map(place).collect();
            series(name, color, Style::Line(2.0), points)
        })
        .collect();
    let all = || all_series.iter().flat_map(|series| &series.points);
    let rarest = all().map(|point| point.0.ceil() as i32).fold(1, i32::max);
    let low = all().map(|point| point.1.floor() as i32).fold(0, i32::min);
    let top = all().map(|point| point.1.ceil() as i32).fold(1, i32::max);
    let x = Axis::nines(rarest);
    let y = Axis::decades("ms", (low, top), chart::power);
    let mut chart = Chart::new(260.0, x, y);
    chart.series = all_series;
    chart
}
