//! The results as one HTML page.

use crate::columns::{self, PAGE};
use crate::provider::{Headline, Look, Provider};
use crate::result::{Results, Row};
use maud::{Markup, html};
use std::collections::BTreeSet;
use tandem_page::chart::{Axis, Chart, Series, Style};
use tandem_page::svg::{Color, Stroke, Svg};
use tandem_page::{document, format, legend, section, tile};

/// Returns the page.
pub(crate) fn page(results: &Results) -> String {
    let content = html! {
        (header(results))
        div class="tiles large" {
            @for (name, rows) in results.groups() {
                @if let Some(headline) = Headline::of(rows) { (group_tile(name, headline)) }
            }
        }
        @for (name, rows) in results.groups() { (group(name, rows)) }
        (noise(results))
        (facts("Machine", results.machine.facts().into_iter()))
        @if !results.skipped.is_empty() {
            (facts("Not measured", results.skipped.iter().map(|of| (&of.name[..], of.why.clone()))))
        }
        (explanations(results))
    };
    document("time from core to core", &content)
}

fn header(results: &Results) -> Markup {
    let machine = &results.machine;
    let samples: u64 = results.results.iter().map(|row| row.samples).sum();
    html! {
        h1 { "Time from core to core" }
        p.sub {
            (machine.name()) " · " (results.results.len()) " cases · "
            (format::count(samples as f64)) " samples in "
            (format!("{:.0}", results.duration_s)) " s"
        }
        p.sub { (results.noise_in_words()) }
        @if results.interrupted {
            div.verdict.bad { "Interrupted: fewer samples than planned" }
        }
        @if machine.build != "release" {
            div.verdict.bad { "A " (machine.build) " build: its figures say nothing about Tandem" }
        }
    }
}

/// Tandem beside its floor and the best peer.
fn group_tile(group: &str, headline: Headline<'_>) -> Markup {
    let tandem = headline.tandem;
    let bars = [headline.floor, Some(tandem), headline.peer];
    let bars: Vec<&Row> = bars.into_iter().flatten().collect();
    let largest = bars.iter().map(|row| row.p50_ns).fold(0.0, f64::max);
    // Readers compare sizes by eye, so the scale is linear from 0.
    let bar = |row: &Row| {
        let percent = 100.0 * row.p50_ns / largest.max(1e-9);
        let color = Provider::of(row).look().color.css();
        format!("width:{percent:.1}%;background:{color}")
    };
    let (value, unit) = match tandem.ratio_to_floor_p50 {
        Some(ratio) => (format::ratio(ratio) + "×", "the floor"),
        None => (format::time(tandem.p50_ns), ""),
    };
    let below = html! {
        div.bars {
            @for row in bars {
                span.who { (row.case()) }
                span { i style=(bar(row)) {} }
                span.what { (format::time(row.p50_ns)) }
            }
        }
    };
    let tile = tile(about(group).title, "", &value, unit, &below);
    html! { a href=(format!("#{group}")) { (tile) } }
}

fn group(name: &str, rows: &[Row]) -> Markup {
    let about = about(name);
    let providers: BTreeSet<Provider> = rows.iter().map(Provider::of).collect();
    let looks = providers.into_iter().map(Provider::look);
    let providers = looks.map(|look| (look.name, Some(look.color)));
    let aside = html! { span.unit { (about.measures) } (legend(providers)) };
    let content = html! {
        @if let Some(chart) = curves(rows) { (chart.svg("Percentile curves")) }
        (table(rows))
    };
    html! { div id=(name) { (section(about.title, &aside, about.note, &content)) } }
}

/// The introduction of a group: its heading, what one sample is, and what to compare. A group that
/// is not described here has none: its cases explain it.
struct About {
    title: &'static str,
    measures: &'static str,
    note: &'static str,
}

#[rustfmt::skip]
fn about(group: &str) -> About {
    let one_way = "one way, from send to the running handler";
    let (title, measures, note) = match group {
        "spin" => ("Spinning, two CPUs", one_way,
            "The receiver polls on a CPU of its own. The floor is one cache line that two \
             processes write in turn."),
        "sleep" => ("Sleeping, two CPUs", one_way,
            "The receiver sleeps in the kernel until it is woken, on a CPU of its own. The floor is \
             a futex. What spins a while before it sleeps (adaptive) can be faster than the floor: \
             it never sleeps if the answer comes soon."),
        "one-cpu" => ("Sleeping, one CPU", one_way,
            "Both ends share one CPU, so each message is a change of process. Spinning only keeps the \
             other from running."),
        "size" => ("Payload size", "one way, by bytes of payload",
            "Each word is written and read where it lies, and only its place is sent."),
        "throughput" => ("Throughput", "time per message, messages in a row",
            "As many messages as go, one after the other. Less time is more messages."),
        "lock" => ("Lock", "time to take and give back",
            "The floor is a compare-and-swap and a store. Contended: the others want it all the time. \
             Recovery: from the death of its owner to the next one that has it."),
        "rate" => ("Fixed rate", "one way, from the intended time of sending",
            "Messages are due on a schedule, whether the last one has arrived or not. Naive figures \
             count from the actual sending: they hide what the schedule has lost."),
        "topics" => ("Topics", "half of a round trip, from publishing to the value that was taken",
            "The receiver sleeps. The floor is a bare UDP socket, also for the two ways in shared \
             memory, which need none."),
        "rtos" => ("Real-time operating system", "time per operation", ""),
        _ => ("Further cases", "time per operation", ""),
    };
    About { title, measures, note }
}

/// How to read the page.
fn explanations(results: &Results) -> Markup {
    let has_rate = results.results.iter().any(|row| row.group == "rate");
    let content = html! {
        p {
            "Each group does one thing in several ways. Its floor is the bare mechanism between the \
             same CPUs in the same run: 1.2× means that a fifth is added to it. Quote ratios: the \
             times belong to this machine. All cases take turns in batches of 10 to 50 ms. A curve \
             ends where fewer than ten samples lie beyond it; figures that rest on fewer are grey \
             and slanted. These are processes of a host; on a TriCore no kernel stands between a \
             signal and its handler, and only the ratios carry over. "
            @if has_rate {
                "A ping-pong leaves out the messages that a stall would have delayed; the group at a \
                 fixed rate counts them."
            }
        }
        p {
            code { "tandem bench compare --against OLD" } " tells whether a change of the code made a \
             difference: two pages side by side prove nothing. More is in docs/performance.md."
        }
    };
    section("How to read this page", &html! {}, "", &content)
}

/// The decimal logarithm of 1 / (1 - q) at the median.
const MEDIAN: f64 = std::f64::consts::LOG10_2;

fn percentile_label(nines: f64) -> String {
    if nines == MEDIAN {
        return "50 %".to_owned();
    }
    tandem_page::chart::percentile(nines)
}

/// Returns a round time as text: `200 ns`, `10 µs`.
fn time_label(power: f64) -> String {
    // The computed power of ten may be slightly too small.
    let (value, unit) = format::scaled(10_f64.powf(power) * (1.0 + 1e-9));
    format!("{} {unit}", tandem_page::chart::plain(value))
}

/// Returns whether this is Tandem's first case of its group.
fn is_first(row: &Row, rows: &[Row]) -> bool {
    Headline::of(rows).is_some_and(|headline| headline.tandem.name == row.name)
}

/// Returns the distributions from the median on; `None` if no case has enough samples for a curve.
fn curves(rows: &[Row]) -> Option<Chart> {
    // The most important curve is drawn last, above the others.
    let order = |row: &&Row| match Provider::of(row) {
        _ if is_first(row, rows) => 3,
        Provider::Tandem => 2,
        Provider::Floor => 1,
        _ => 0,
    };
    let mut drawn: Vec<&Row> = rows.iter().collect();
    drawn.sort_by_key(order);
    let series = drawn.into_iter().map(|row| {
        let nines = |quantile: f64| -(1.0 - quantile).log10();
        let beyond = row.curve.iter().filter(|(q, _)| nines(*q) > MEDIAN);
        let beyond = beyond.map(|(q, ns)| (nines(*q), ns.max(0.1).log10()));
        let median = (MEDIAN, row.p50_ns.max(0.1).log10());
        let Look { color, style, .. } = Provider::of(row).look();
        let thickest = Style::Line(3.6);
        Series {
            name: row.case().to_owned(),
            title: format!("{}: {}", row.name, row.what),
            color,
            style: if is_first(row, rows) { thickest } else { style },
            points: std::iter::once(median).chain(beyond).collect(),
        }
    });
    let series: Vec<Series> = series.filter(|series| series.points.len() > 1).collect();
    let points = || series.iter().flat_map(|series| &series.points);
    let rarest = points().map(|point| point.0).fold(1.0, f64::max);
    let mut x = Axis::linear("this share took no longer →", (MEDIAN, rarest), 6);
    x.ticks = std::iter::once(MEDIAN)
        .chain((1..=6).map(f64::from).filter(|nines| *nines <= rarest))
        .collect();
    x.label = percentile_label;
    let y = Axis::powers("", points().map(|point| point.1), time_label)?;
    let height = (54.0 + 18.0 * series.len() as f64).max(370.0);
    let mut chart = Chart::new(height, x, y);
    chart.names = true;
    chart.series = series;
    Some(chart)
}

/// Range of ratios in the small charts of dots; ratios outside it are drawn at the edge.
const SHOWN: (f64, f64) = (0.3, 30.0);

/// Returns the table of a group, with the ratios as dots where it has a floor.
fn table(rows: &[Row]) -> Markup {
    let columns = columns::filled(rows, PAGE);
    let has_floor = rows.iter().any(|row| row.is_floor());
    html! {
        table.bench {
            tr {
                th {}
                @if has_floor {
                    th title="dot: median; ring: p99.9; line: the floor" { "over the floor" }
                }
                @for column in &columns { th.num title=(column.title) { (column.head) } }
            }
            @for row in rows {
                tr.main[is_first(row, rows)] {
                    td.case {
                        i style=(format!("background:{}", Provider::of(row).look().color.css())) {}
                        b { (row.case()) }
                        div.what { (row.what) }
                        @for fact in columns::facts(row) { div.what { (fact) } }
                    }
                    @if has_floor { td { (dots(row)) } }
                    @for column in &columns {
                        td.num.rare[column.is_chance(row)] {
                            (column.cell(row, format::time).unwrap_or_else(|| "–".to_owned()))
                        }
                    }
                }
            }
        }
    }
}

/// Returns the ratios of a row: a line at 1, a dot for the median, a ring for the tail.
fn dots(row: &Row) -> Markup {
    let power = |ratio: f64| ratio.clamp(SHOWN.0, SHOWN.1).log10();
    let axis = Axis::linear("", (SHOWN.0.log10(), SHOWN.1.log10()), 1);
    let at = |ratio: f64| (axis.at(power(ratio), (6.0, 134.0)), 8.0);
    let color = Provider::of(row).look().color;
    let mut svg = Svg::new(140.0, 16.0);
    let floor = at(1.0).0;
    svg.line((floor, 0.0), (floor, 16.0), Stroke::new(Color::FLOOR, 1.5));
    let (median, tail) = (row.ratio_to_floor_p50, row.ratio_to_floor_p99_9);
    if let (Some(median), Some(tail)) = (median, tail) {
        svg.line(at(median), at(tail), Stroke::new(color, 1.0));
    }
    if let Some(tail) = tail {
        svg.circle(at(tail), 3.5, color, true, "p99.9");
    }
    if let Some(median) = median {
        svg.circle(at(median), 4.5, color, false, "median");
    }
    svg.finish("spark", "ratios to the floor")
}

fn noise(results: &Results) -> Markup {
    if results.noise.is_empty() {
        return html! {};
    }
    let (note, table) = (results.noise_in_words(), table(&results.noise));
    section("The machine's own noise", &html! {}, &note, &table)
}

/// Returns a section of names with a note on each.
fn facts<'a>(title: &str, facts: impl Iterator<Item = (&'a str, String)>) -> Markup {
    let content = html! {
        table.facts { @for (name, value) in facts { tr { th { (name) } td { (value) } } } }
    };
    section(title, &html! {}, "", &content)
}

#[cfg(test)]
mod tests;
