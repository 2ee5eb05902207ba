//! The report of a run: one HTML file that loads no other file.

mod clocks;
mod cores;
mod sections;
mod soc;
mod top_view;

use std::fmt;

use maud::{Markup, html};
use tandem_board::SystemId;
use tandem_page::chart::Chart;
use tandem_page::{legend, section, tile};
use tandem_record::happenings::happenings;
use tandem_record::roles::RoleState;
use tandem_record::verdict::{Grade, modes};
use tandem_record::{RunLog, Takeover, description, takeovers};

use crate::metrics::Metrics;
use crate::timeline::Timeline;

/// Rows of the event log. With more rows the important ones would be hard to find.
const EVENT_ROWS: usize = 200;

/// Returns the whole page. `trace_ns` is the time of the first event in the trace, ns.
pub(crate) fn page(log: &RunLog, timeline: &Timeline, metrics: &Metrics, trace_ns: u64) -> String {
    let takeovers = takeovers(log);
    let alone = alone(log);
    let content = html! {
        (header(metrics, &alone))
        (tiles(metrics))
        (roles(log, &takeovers, &alone))
        (cores::timeline(log, timeline, &takeovers))
        (driving(log, &takeovers))
        (control(log, metrics, &takeovers))
        (takeover_table(metrics))
        @if let Some(soc) = &metrics.soc { (soc::topics(soc)) }
        @if let Some(figures) = &metrics.time { (clocks::section(log, &takeovers, figures)) }
        (cores::tasks(metrics))
        (conditions(metrics))
        (events(log))
        footer {
            "Files beside this page: " code { "metrics.json" } " (all figures), "
            code { "candump.log" } " (every CAN frame; the repository's DBC file reads it), "
            code { "control-period.hgrm" } " and " code { "chain.hgrm" }
            " (distributions, for HdrHistogram plotters), " code { "trace.perfetto-trace" }
            " (what ran when on which core, for ui.perfetto.dev)."
        }
        (moment(log, trace_ns))
    };
    tandem_page::document_with_plots(&metrics.scenario, &content, "", None)
}

/// Returns the bar that names the shown span and the chosen moment, with buttons that zoom.
fn moment(log: &RunLog, trace_ns: u64) -> Markup {
    let start_ns = log.start_ns.unwrap_or_default();
    html! {
        div.moment id="moment" data-start-ns=(start_ns) data-trace-ns=(trace_ns) {
            span.at role="status" { "A click on a time in the tables moves all plots there; a drag zooms." }
            span.tools {
                span.span {} " "
                button data-zoom="0.5" aria-label="zoom in" { "+" } " "
                button data-zoom="2" aria-label="zoom out" { "−" } " "
                button data-zoom="whole" { "whole run" }
            }
        }
    }
}

/// Returns a time that moves all plots there when it is clicked.
fn at(at_s: f64, digits: usize) -> Markup {
    // Avoid "-0.0000".
    let rounded = (at_s * 1e6).round() * 1e-6 + 0.0;
    html! { button.at data-at=(format!("{rounded:.6}")) { (format!("{rounded:.digits$} s")) } }
}

fn header(metrics: &Metrics, alone: &[Alone]) -> Markup {
    html! {
        h1 { "Scenario " (metrics.scenario) }
        p.sub {
            (format!("{:.1} s", metrics.duration_s)) " driven of "
            (format!("{:.1} s", metrics.duration_asked_s)) " asked for"
            " · seed " (metrics.seed) " · " (metrics.figures.control_frames) " control frames"
        }
        @for (grade, part) in metrics.verdict.parts() {
            div class=(format!("verdict {}", class(grade))) { (part) }
        }
        // The verdict has what is lost to the end.
        @for it in alone.iter().filter(|it| it.until_s.is_some()) {
            div.verdict.warn { (it) }
        }
    }
}

/// Returns the CSS class of a grade's colour.
const fn class(grade: Grade) -> &'static str {
    match grade {
        Grade::Good => "good",
        Grade::Reported => "warn",
        Grade::Bad => "bad",
    }
}

fn tiles(metrics: &Metrics) -> Markup {
    let ms = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.1}"));
    let last = metrics.figures.takeovers.last();
    let takeover_remark = last.map_or(String::new(), |t| {
        format!("last: {} → {} at {:.1} s", t.from, t.to, t.at_s)
    });
    let lateral = format!("{:.2}", metrics.drive.lateral_error_max_m);
    let period_remark = format!("median {} ms", ms(metrics.figures.control_period_p50_ms));
    let reaction_remark = format!("median; p99 {} ms", ms(metrics.reaction_p99_ms));
    let age_remark = format!("median; p99 {} ms", ms(metrics.sensor_age_p99_ms));
    let fenced = format!("{} frame(s) fenced off", metrics.fenced_frames);
    let false_ones = format!("{} of them false", metrics.figures.false_takeovers);
    let takeover_remark = if metrics.figures.false_takeovers > 0 {
        false_ones
    } else {
        takeover_remark
    };
    let state = |good: bool| if good { "good" } else { "bad" };
    let remark = |text: &str| html! { div.remark { (text) } };
    let takeovers = metrics.figures.takeovers.len().to_string();
    let two_masters = format!("{:.1}", metrics.figures.two_masters_ms);
    let is_false = metrics.figures.false_takeovers > 0;
    html! {
        div.tiles.large {
            (tile("Collisions", state(metrics.drive.collisions == 0), &metrics.drive.collisions.to_string(), "",
                &remark("")))
            (tile("Sensor to control", "", &ms(metrics.reaction_p50_ms), "ms", &remark(&reaction_remark)))
            (tile("Age of sensor data", "", &ms(metrics.sensor_age_p50_ms), "ms", &remark(&age_remark)))
            (tile("Takeovers", if is_false { "bad" } else { "" }, &takeovers, "",
                &remark(&takeover_remark)))
            (tile("Largest control gap", "", &ms(metrics.control_gap_max_ms), "ms",
                &remark("between accepted frames")))
            (tile("Two masters", state(metrics.figures.two_masters_ms <= 0.0), &two_masters, "ms",
                &remark(&fenced)))
            (tile("Control period p99", "", &ms(metrics.control_period_p99_ms), "ms",
                &remark(&period_remark)))
            (tile("Lateral error, max", "", &lateral, "m", &remark("outside lane changes")))
        }
    }
}

/// Returns a section with a chart and a legend of its series.
fn card(title: &str, note: &str, chart: &Chart) -> Markup {
    let named = chart.series.iter().filter(|series| !series.name.is_empty());
    let entries: Vec<_> = named
        .map(|series| (series.name.as_str(), Some(series.color)))
        .collect();
    let aside = match entries.len() {
        0 | 1 => html! {},
        _ => legend(entries.into_iter()),
    };
    section(title, &aside, note, &chart.svg(title))
}

/// Returns a section with a plot, which names its series itself.
fn plot_card(title: &str, note: &str, chart: &Chart) -> Markup {
    section(title, &html! {}, note, &chart.plot(title))
}

/// A time in which one system drove alone.
struct Alone {
    from_s: f64,
    /// `None`: to the end of the run.
    until_s: Option<f64>,
    driver: Option<SystemId>,
}

impl fmt::Display for Alone {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "no redundancy from {:.1} s ", self.from_s)?;
        match self.until_s {
            Some(until_s) => write!(f, "to {until_s:.1} s")?,
            None => write!(f, "to the end")?,
        }
        self.driver
            .map_or(Ok(()), |driver| write!(f, ": {driver} drove alone"))
    }
}

fn alone(log: &RunLog) -> Vec<Alone> {
    let end_s = log.driven_s();
    let spans = modes::alone(log).into_iter().map(|(from_s, to_s)| {
        let within = log.accepted().filter(|frame| {
            let at_s = log.seconds(frame.at_ns);
            from_s <= at_s && at_s < to_s
        });
        Alone {
            from_s,
            until_s: (to_s < end_s).then_some(to_s),
            driver: within.last().map(|frame| frame.system),
        }
    });
    spans.collect()
}

fn roles(log: &RunLog, takeovers: &[Takeover], alone: &[Alone]) -> Markup {
    let states = RoleState::ALL.map(|state| (state.name(), sections::state_color(state)));
    let note = match takeovers.len() {
        0 => "What each system was, over scenario time in seconds.",
        _ => "What each system was, over scenario time in seconds. Red dashes mark takeovers.",
    };
    let end_s = log.driven_s();
    let spans = alone.iter();
    let spans: Vec<_> = { spans.map(|it| (it.from_s, it.until_s.unwrap_or(end_s))) }.collect();
    let chart = sections::roles(log, takeovers, &spans).plot("Roles");
    let content = html! {
        @if alone.is_empty() {
            p.note { "A system that could drive stood by all the time." }
        } @else {
            @for it in alone {
                p.note { (at(it.from_s, 4)) ": " (it) "." }
            }
        }
        (chart)
    };
    section("Roles", &legend(states.into_iter()), note, &content)
}

fn driving(log: &RunLog, takeovers: &[Takeover]) -> Markup {
    let [acceleration, jerk] = sections::comfort(log, takeovers);
    let gap = sections::lead_gap(log, takeovers);
    let moment = takeovers
        .first()
        .map(|takeover| takeover.at_ns)
        .or(log.start_ns);
    let view = moment.and_then(|at_ns| top_view::top_view(log, at_ns));
    let view_title = if takeovers.is_empty() {
        "The road at the start"
    } else {
        "The road at the takeover"
    };
    html! {
        @if let Some((at_s, chart)) = view {
            (card(view_title, &format!("From above at {at_s:.1} s: lanes, other vehicles, and the \
                whole path of the own vehicle."), &chart))
        }
        (plot_card("Lateral error", "Distance of the vehicle's centre from the centre of its lane.",
            &sections::lateral(log, takeovers)))
        (plot_card("Speed", "", &sections::speed(log, takeovers)))
        @if let Some(chart) = gap {
            (plot_card("Distance to the vehicle ahead", "Bumper to bumper, in the own lane.", &chart))
        }
        (plot_card("Acceleration", "", &acceleration))
        (plot_card("Longitudinal jerk", "Change of acceleration over a tenth of a second.", &jerk))
    }
}

fn control(log: &RunLog, metrics: &Metrics, takeovers: &[Takeover]) -> Markup {
    let figures = |name: &str, values: [Option<f64>; 4]| {
        html! {
            tr {
                td { (name) }
                @for value in values {
                    td.num { (value.map_or("–".to_owned(), |value| format!("{value:.3}"))) }
                }
            }
        }
    };
    let period = [
        metrics.figures.control_period_p50_ms,
        metrics.control_period_p99_ms,
        metrics.control_period_p99_9_ms,
        metrics.control_period_max_ms,
    ];
    let chain = [
        metrics.chain_p50_ms,
        metrics.chain_p99_ms,
        metrics.chain_p99_9_ms,
        metrics.chain_max_ms,
    ];
    html! {
        (plot_card("Gaps between accepted control frames",
            "As the vehicle saw them: each dot is the time since the accepted frame before.",
            &sections::gaps(log, takeovers)))
        (plot_card("Control period and chain latency by percentile",
            "Control period: by the sender's clock, within one mastership. Chain: from the \
             measurement on core 1 over core 2 to the command of core 0.",
            &sections::percentiles(log)))
        section {
            h2 { "Distributions" }
            table {
                tr {
                    th { "ms" }
                    @for name in ["p50", "p99", "p99.9", "max"] { th.num { (name) } }
                }
                (figures("Control period", period))
                (figures("Chain core 1 → 2 → 0", chain))
            }
        }
    }
}

fn system(name: &str) -> Markup {
    html! { span class=(format!("sys {name}")) { (name) } }
}

fn takeover_table(metrics: &Metrics) -> Markup {
    let bound = metrics.detection_bound_ms;
    html! {
        section {
            h2 { "Takeovers" }
            @if metrics.figures.takeovers.is_empty() {
                p.note { "None: the same system drove from start to end." }
            } @else {
                table {
                    tr {
                        th { "at" } th { "from → to" } th { "sign" } th.num { "detected" }
                        th.num { "bound" } th.num { "without control" } th.num { "bound" }
                        th { "" }
                    }
                    @for takeover in &metrics.figures.takeovers {
                        tr {
                            td.time { (at(takeover.at_s, 3)) }
                            td { (system(&takeover.from)) " → " (system(&takeover.to)) }
                            td { (takeover.cause) }
                            td.num { (optional_ms(takeover.detected_ms)) }
                            td.num { (optional_ms(bound)) }
                            td.num { (format!("{:.2} ms", takeover.gap_ms)) }
                            td.num { (format!("{:.2} ms", takeover.bound_ms)) }
                            td.bad {
                                @if takeover.is_false { "the old master had not failed" }
                                @if takeover.held_up { "the old master had been held up" }
                            }
                        }
                    }
                }
            }
        }
    }
}

fn optional_ms(value: Option<f64>) -> String {
    value.map_or("–".to_owned(), |value| format!("{value:.2} ms"))
}

fn conditions(metrics: &Metrics) -> Markup {
    let row = |name: &str, value: String| html! { tr { td.time { (name) } td { (value) } } };
    let unit = |value: Option<f64>, unit: &str| {
        value.map_or("–".to_owned(), |value| format!("{value:.2} {unit}"))
    };
    let comfort = &metrics.drive.comfort;
    html! {
        section {
            h2 { "Figures and conditions" }
            div.two {
                table {
                    (row("Timing profile", metrics.timing.clone()))
                    (row("Granted", metrics.granted.clone()))
                    (row("Late control cycles", metrics.deadline_misses.to_string()))
                    (row("Invalid control frames", metrics.invalid_frames.to_string()))
                    (row("Lost trace records", metrics.lost_trace.to_string()))
                    (row("The world stood still", format!("{:.0} ms", metrics.stalled_ms)))
                    (row("Stalls of the machine", stalls(metrics)))
                    (row("Left behind", match metrics.figures.leftovers.as_slice() {
                        [] => "nothing".to_owned(),
                        found => found.join(", "),
                    }))
                }
                table {
                    (row("Smallest distance ahead", unit(metrics.drive.lead_gap_min_m, "m")))
                    (row("Smallest time to collision", unit(metrics.drive.ttc_min_s, "s")))
                    (row("Strongest acceleration", unit(Some(comfort.accel_max), "m/s²")))
                    (row("Strongest braking", unit(Some(comfort.brake_max), "m/s²")))
                    @if let Some(reason) = &metrics.drive.brake_reason {
                        (row("Braked hard for", reason.clone()))
                    }
                    (row("Strongest braking outside emergencies",
                        unit(Some(comfort.calm_brake_max), "m/s²")))
                    (row("Strongest lateral acceleration",
                        unit(Some(comfort.lat_accel_max), "m/s²")))
                    (row("Jerk, 99 % of the time below", unit(Some(comfort.jerk_p99), "m/s³")))
                    (row("Largest jerk", unit(Some(comfort.jerk_max), "m/s³")))
                    (row("Largest jerk outside emergencies",
                        unit(Some(comfort.calm_jerk_max), "m/s³")))
                    (row("Lane changes", metrics.drive.lane_changes.to_string()))
                    (row("Distance driven", format!("{:.0} m", metrics.drive.distance_m)))
                }
            }
        }
    }
}

fn stalls(metrics: &Metrics) -> String {
    let stalls = &metrics.stalls;
    if stalls.watched_by.is_empty() {
        return "none: virtual time".to_owned();
    }
    format!(
        "{}, {:.1} ms at most (seen by {}); the vehicle's process was held up {} times",
        stalls.count, stalls.longest_ms, stalls.watched_by, stalls.bus_count
    )
}

/// One row of the event log: scenario time, source, event.
type EventRow = (f64, String, String);

fn events(log: &RunLog) -> Markup {
    let mut rows: Vec<EventRow> = log
        .events
        .iter()
        .filter_map(|event| {
            let who = format!("{}{}", event.system, event.core);
            let what = description::core_event(event.event)?;
            Some((log.seconds(event.at_ns), who, what))
        })
        .collect();
    rows.extend(log.supplies.iter().map(|(at_ns, system, event)| {
        let what = description::supply_event(*event);
        (log.seconds(*at_ns), format!("supply {system}"), what)
    }));
    let told = happenings(log).into_iter();
    rows.extend(told.map(|(at_ns, who, what)| (log.seconds(at_ns), who.to_string(), what)));
    rows.sort_by(|a, b| a.0.total_cmp(&b.0));
    let rows = merged(rows);
    let more = rows.len().saturating_sub(EVENT_ROWS);
    html! {
        section {
            h2 { "Events" }
            table {
                tr { th { "at" } th { "who" } th { "what" } }
                @for (at_s, who, what) in rows.iter().take(EVENT_ROWS) {
                    tr { td.time { (at(*at_s, 4)) } td { (who) } td { (what) } }
                }
            }
            @if more > 0 { p.note { "and " (more) " more" } }
        }
    }
}

/// Merges consecutive equal events into one row that counts them.
fn merged(rows: Vec<EventRow>) -> Vec<EventRow> {
    let mut merged: Vec<(EventRow, u32)> = Vec::new();
    for row in rows {
        match merged.last_mut() {
            Some((last, times)) if (&last.1, &last.2) == (&row.1, &row.2) => *times += 1,
            _ => merged.push((row, 1)),
        }
    }
    let counted = |((at_s, who, what), times): (EventRow, u32)| match times {
        1 => (at_s, who, what),
        _ => (at_s, who, format!("{what} ({times} times)")),
    };
    merged.into_iter().map(counted).collect()
}

#[cfg(test)]
mod tests;
