//! The part of the report about the vehicle's time: whom each clock followed, and how well.

use maud::{Markup, html};
use tandem_page::chart::{self, Axis, Chart, Polygon, Series, Style, thin};
use tandem_page::legend;
use tandem_page::svg::Color;
use tandem_processes::percentiles::DeviationFigures;
use tandem_record::clocks::{ChainClock, ClockLog};
use tandem_record::description::{is_holdover, time_source};
use tandem_record::log::{ClockSample, ClockState};
use tandem_record::{RunLog, Takeover};

use super::plot_card;
use super::sections::{DOTS, line, series, time_chart};
use crate::time_figures::{CONVERGES_NS, TimeFigures};

/// A state lasts until the next one, but no longer than this, ns.
const LASTS_NS: u64 = 500_000_000;
/// A clock converges for this long; a chart's axis need not show it.
const CONVERGES_S: f64 = CONVERGES_NS as f64 * 1e-9;
/// A shorter skew is drawn with this length, µs, because a logarithmic axis has no zero.
const SHORTEST_US: f64 = 0.1;

const fn color(of: ChainClock) -> Color {
    match of {
        ChainClock::A => Color::A,
        ChainClock::B => Color::B,
        ChainClock::Soc => Color::OTHER,
    }
}

/// What the bar of a state shows.
const HOLDOVER: (&str, Color) = ("holdover", Color::WARN);
const SOURCES: [Color; 3] = [Color::PALE, Color::GOOD, Color::CALM];

fn state_name(state: &ClockState) -> &'static str {
    match is_holdover(state.status) {
        true => HOLDOVER.0,
        false => time_source(state.source),
    }
}

fn state_color(state: &ClockState) -> Color {
    if is_holdover(state.status) {
        return HOLDOVER.1;
    }
    let color = SOURCES.get(usize::from(state.source));
    color.copied().unwrap_or(Color::BAD)
}

/// Returns the section, with a chart of each quantity over time.
pub(super) fn section(log: &RunLog, takeovers: &[Takeover], figures: &TimeFigures) -> Markup {
    let sources = (0..)
        .zip(SOURCES)
        .map(|(code, color)| (time_source(code), Some(color)));
    let legend = legend(sources.chain([(HOLDOVER.0, Some(HOLDOVER.1))]));
    let note = "Whom each clock followed. Red dashes mark takeovers and leaps.";
    let status = tandem_page::section("Time", &legend, note, &status(log, takeovers).plot("Time"));
    let of_samples = |value: fn(&ClockLog, &RunLog) -> Vec<(f64, f64)>, unit, style| {
        let all = ChainClock::ALL.into_iter();
        let all = all.map(|of| {
            let points = thin(&value(log.time.clock(of), log), DOTS);
            series(of.name(), color(of), style, points)
        });
        let all = all.filter(|series| !series.points.is_empty());
        converged(log, takeovers, unit, all.collect())
    };
    html! {
        (status)
        (table(figures))
        (deviation(log, takeovers, figures))
        (plot_card("Offset", "How much later another clock was than the one that heard it thought.",
            &of_samples(offsets, "µs", Style::Dots)))
        (plot_card("Rate", "How much faster the vehicle's time ran than the clock of each system.",
            &of_samples(rates, "ppm", Style::Line(2.0))))
        (plot_card("Delay", "Of the grandmaster's messages, as measured.",
            &of_samples(delays, "µs", Style::Dots)))
        (plot_card("Skew of the control cycles", "Microseconds between the starts in A and in B.",
            &skew(log, takeovers)))
    }
}

/// Returns a chart whose vertical axis covers what follows after the clocks have converged.
fn converged(
    log: &RunLog,
    takeovers: &[Takeover],
    unit: &'static str,
    series: Vec<Series>,
) -> Chart {
    let mut chart = time_chart(log, takeovers, 210.0, unit, series);
    let points = || chart.series.iter().flat_map(|it| &it.points);
    let begin_s = points().map(|it| it.0).fold(f64::INFINITY, f64::min);
    let later = points().filter(|it| it.0 >= begin_s + CONVERGES_S);
    let mut later = later.map(|it| it.1).peekable();
    if later.peek().is_some() {
        chart.y = Axis::over(unit, later, 5);
    }
    chart
}

fn offsets(clock: &ClockLog, log: &RunLog) -> Vec<(f64, f64)> {
    let samples = clock.samples.iter();
    let point = |it: &ClockSample| (log.seconds(it.at_ns), f64::from(it.offset_ns) * 1e-3);
    samples.map(point).collect()
}

fn delays(clock: &ClockLog, log: &RunLog) -> Vec<(f64, f64)> {
    let samples = clock.samples.iter().filter(|it| it.delay_ns > 0);
    let point = |it: &ClockSample| (log.seconds(it.at_ns), f64::from(it.delay_ns) * 1e-3);
    samples.map(point).collect()
}

fn rates(clock: &ClockLog, log: &RunLog) -> Vec<(f64, f64)> {
    let states = clock.states.iter();
    let point = |it: &ClockState| (log.seconds(it.at_ns), f64::from(it.rate_ppb) * 1e-3);
    states.map(point).collect()
}

/// Draws whom each clock followed, as bars.
fn status(log: &RunLog, takeovers: &[Takeover]) -> Chart {
    let name = |value: f64| {
        let of = ChainClock::ALL.iter().rev().nth(value as usize);
        of.map_or("", |of| of.name()).to_owned()
    };
    let y = Axis::rows(3, name);
    let mut chart = time_chart(log, takeovers, 190.0, "", vec![]);
    (chart.y, chart.grid) = (y, false);
    for (of, row) in ChainClock::ALL.into_iter().zip([2, 1, 0]) {
        let clock = log.time.clock(of);
        let mut states = clock.states.iter().peekable();
        while let Some(first) = states.next() {
            let color = state_color(first);
            let mut last_ns = first.at_ns;
            let is_same = |it: &&ClockState, last_ns: u64| {
                state_color(it) == color && it.at_ns < last_ns + LASTS_NS
            };
            while let Some(next) = states.next_if(|it| is_same(it, last_ns)) {
                last_ns = next.at_ns;
            }
            let end_ns = states
                .peek()
                .map_or(last_ns, |it| it.at_ns.min(last_ns + LASTS_NS));
            let (left, right) = (log.seconds(first.at_ns), log.seconds(end_ns));
            let name = state_name(first);
            let bar = Polygon::bar(name, color, (left, right), row);
            chart.shapes.push(bar);
        }
        let leaps = clock.leaps.iter().map(|leap| log.seconds(leap.at_ns));
        chart.marks.extend(leaps);
    }
    chart
}

/// Draws how much later each clock was than the grandmaster, or A than B if the run had none.
fn deviation(log: &RunLog, takeovers: &[Takeover], figures: &TimeFigures) -> Markup {
    let point = |(at_ns, by_ns): (u64, i32)| (log.seconds(at_ns), f64::from(by_ns) * 1e-3);
    let Some(ahead_ns) = figures.grandmaster_ns else {
        let points: Vec<_> = log.time.apart().into_iter().map(point).collect();
        let lines = vec![line("A - B", Color::A, &points)];
        let chart = converged(log, takeovers, "µs", lines);
        return plot_card(
            "A and B apart",
            "How much later the time of A was than that of B.",
            &chart,
        );
    };
    let lines = ChainClock::ALL.into_iter().filter_map(|of| {
        let points = log.time.clock(of).later_than(ahead_ns).map(point);
        let points: Vec<_> = points.collect();
        (!points.is_empty()).then(|| line(of.name(), color(of), &points))
    });
    let chart = converged(log, takeovers, "µs", lines.collect());
    let note = "How much later the time of each clock was than that of the grandmaster. All read \
                the same clock of the machine, so this is the error of the chain.";
    plot_card("Deviation from the grandmaster", note, &chart)
}

/// Draws the times between the starts of the control cycles.
fn skew(log: &RunLog, takeovers: &[Takeover]) -> Chart {
    let skews = log.time.skews();
    let point = |(at_ns, by_ns): &(u64, i64)| {
        let us = by_ns.unsigned_abs() as f64 * 1e-3;
        (log.seconds(*at_ns), us.max(SHORTEST_US).log10())
    };
    let points: Vec<_> = skews.iter().map(point).collect();
    let mut chart = time_chart(log, takeovers, 230.0, "µs", vec![]);
    chart.y = Axis::decades("", (-1, 4), chart::power);
    chart.series = vec![series("skew", Color::A, Style::Dots, thin(&points, DOTS))];
    chart
}

fn table(figures: &TimeFigures) -> Markup {
    let us = |value: f64| format!("{value:.1}");
    let row = |name: &str, what: &str, spread: &Option<DeviationFigures>| {
        html! {
            @if let Some(it) = spread {
                tr {
                    td { (name) } td { (what) }
                    @for value in [it.p50_us, it.p99_us, it.max_us] { td.num { (us(value)) } }
                    td.num { (it.count) }
                }
            }
        }
    };
    html! {
        section {
            h2 { "Time in figures" }
            p.note { "Magnitudes, from 5 s after a clock first has a time." }
            @if let Some(died) = &figures.grandmaster_died {
                div.verdict.warn { "The grandmaster's process ended: " (died) }
            }
            table {
                tr {
                    th { "clock" } th { "µs" }
                    @for name in ["p50", "p99", "max", "count"] { th.num { (name) } }
                }
                @for (name, clock) in &figures.clocks {
                    (row(name, "from the grandmaster", &clock.deviation))
                    (row(name, "from what it heard", &clock.offset))
                    (row(name, "delay", &clock.delay))
                }
                (row("A, B", "apart", &figures.apart))
                (row("A, B", "control cycles apart", &figures.skew))
            }
            table {
                tr { th { "clock" } th.num { "rate, ppm" } th.num { "holdover, s" } th.num { "leaps" } }
                @for (name, clock) in &figures.clocks {
                    tr {
                        td { (name) }
                        td.num { (format!("{:.2}", clock.rate_ppm)) }
                        td.num { (format!("{:.1}", clock.holdover_s)) }
                        td.num { (clock.leaps) }
                    }
                }
            }
        }
    }
}
