//! The cores in the report: a timeline around the moment that matters, and the tasks' figures.

use std::fmt::Write as _;

use maud::{Markup, PreEscaped, html};
use plotters::style::RGBColor;
use tandem_board::{CoreId, SupplyEvent, SystemId};
use tandem_cores::task_table::TaskCode;
use tandem_cores::trace::Event;

use tandem_record::{RunLog, Takeover};
use tandem_vehicle::Verdict;

use super::charts::{color, plain, round_ticks};
use crate::metrics::Metrics;
use crate::timeline::{CoreLine, Slice, TaskMetrics, Timeline, Work};

/// What the timeline shows before and after its moment, ms: a period of perception and more.
const WIDE_MS: (f64, f64) = (-40.0, 20.0);
/// The same of a takeover alone.
const CLOSE_MS: (f64, f64) = (-2.5, 0.5);
/// What is shown around a pass through the chain, ms.
const AROUND_CHAIN_MS: f64 = 0.1;
const WIDTH: f64 = 1080.0;
const LABELS: f64 = 150.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 42.0;
const ROW: f64 = 34.0;
const BAR: f64 = 22.0;
/// Space between the two systems, and before the vehicle.
const GAP: f64 = 12.0;
/// A shorter slice is drawn this wide, else nobody would see it.
const NARROWEST: f64 = 1.2;

/// The legend: what the colours of slices mean.
const LEGEND: [(TaskCode, RGBColor); 8] = [
    (TaskCode::CONTROL, color::A),
    (TaskCode::DEGRADED, color::WARN),
    (TaskCode::ROLES, color::CALM),
    (TaskCode::MONITORING, color::MUTED),
    (TaskCode::STATUS, color::OTHER),
    (TaskCode::TRAJECTORY_INPUT, color::BAD),
    (TaskCode::PERCEPTION, color::GOOD),
    (TaskCode::PLANNING, color::B),
];

/// The timeline around the first takeover from a master that failed, or of some moment of a run
/// without a takeover; nothing if no core has left a trace.
pub(super) fn timeline(log: &RunLog, timeline: &Timeline, takeovers: &[Takeover]) -> Markup {
    // One from a master that was only held up shows the machine, not the controller.
    let failed = takeovers.iter().find(|takeover| !takeover.held_up);
    let takeover = failed.or(takeovers.first());
    let Some(zero_ns) = takeover.map(|t| t.at_ns).or_else(|| quiet_moment(timeline)) else {
        return html! {};
    };
    let title = if takeover.is_some() {
        "The cores around the takeover"
    } else {
        "The cores at work"
    };
    let wide = Drawing::new(zero_ns, WIDE_MS).draw(log, timeline, title);
    let close = takeover.map(|_| Drawing::new(zero_ns, CLOSE_MS).draw(log, timeline, title));
    let chain = median_chain(timeline).map(|(system, from_ns, to_ns)| {
        let span_ms = (to_ns - from_ns) as f64 * 1e-6;
        let window = (-AROUND_CHAIN_MS, span_ms + AROUND_CHAIN_MS);
        let mut drawing = Drawing::new(from_ns, window);
        drawing.only = Some(system);
        drawing.draw(log, timeline, "One pass through the chain")
    });
    html! {
        section {
            div.head {
                h2 { (title) }
                div.legend {
                    @for (code, RGBColor(r, g, b)) in LEGEND {
                        span {
                            i.box style=(format!("background:#{r:02x}{g:02x}{b:02x}")) {}
                            (code.name().unwrap_or_default())
                        }
                    }
                }
            }
            p.note {
                "What ran when, in milliseconds"
                @if takeover.is_some() { " from the new master's first obeyed frame on" }
                ". Arrows are signals from core to core; dots are control frames that the vehicle \
                 obeyed (a cross: did not). Narrow slices are drawn wider than they were. The \
                 whole run is in "
                code { "trace.perfetto-trace" }
                ": open it at ui.perfetto.dev."
            }
            (PreEscaped(wide))
            @if let Some(close) = close {
                p.note { "The last milliseconds of it." }
                (PreEscaped(close))
            }
        }
        @if let Some(chain) = chain {
            section {
                h2 { "One pass through the chain" }
                p.note {
                    "From the measurement on core 1 over core 2 to core 0, the median of all passes, \
                     in milliseconds."
                }
                (PreEscaped(chain))
            }
        }
    }
}

/// System, begin of perception and the arrival on core 0, ns, of the pass whose signals took the
/// median time.
fn median_chain(timeline: &Timeline) -> Option<(SystemId, u64, u64)> {
    let mut passes: Vec<(SystemId, u64, u64)> = Vec::new();
    for second in &timeline.flows {
        let before = timeline.flows.iter().filter(|first| {
            first.system == second.system
                && first.to.0 == second.from.0
                && first.to.1 <= second.from.1
        });
        let last = before.max_by_key(|first| first.to.1);
        passes.extend(last.map(|first| (second.system, first.from.1, second.to.1)));
    }
    passes.sort_by_key(|(_, from_ns, to_ns)| to_ns - from_ns);
    let (system, from_ns, to_ns) = *passes.get(passes.len() / 2)?;
    // The signal stands at the end of its task.
    let perception = timeline
        .cores
        .iter()
        .filter(|line| line.system == system)
        .flat_map(|line| &line.slices)
        .filter(|slice| slice.work == Work::Task(TaskCode::PERCEPTION))
        .find(|slice| (slice.begin_ns..=slice.end_ns).contains(&from_ns));
    let begin_ns = perception.map_or(from_ns, |slice| slice.begin_ns);
    Some((system, begin_ns, to_ns))
}

/// Just before a signal of core 1 in the middle of the run.
fn quiet_moment(timeline: &Timeline) -> Option<u64> {
    let first = |flow: &&crate::timeline::Flow| flow.from.0 == CoreId::PERCEPTION;
    let chain: Vec<u64> = timeline
        .flows
        .iter()
        .filter(first)
        .map(|flow| flow.from.1)
        .collect();
    // Two fifths of the signals are those of the first system's first half or so.
    let moment = chain.get(2 * chain.len() / 5)?;
    Some(moment + 10_000_000)
}

fn hex(RGBColor(r, g, b): RGBColor) -> String {
    format!("#{r:02X}{g:02X}{b:02X}")
}

fn task_color(work: Work) -> RGBColor {
    let known = LEGEND
        .iter()
        .find(|(code, ..)| Work::Task(*code) == work)
        .map(|(.., color)| *color);
    known.unwrap_or(color::PALE)
}

struct Drawing {
    /// Only this system, and not the vehicle.
    only: Option<SystemId>,
    zero_ns: u64,
    from_ms: f64,
    to_ms: f64,
    svg: String,
}

impl Drawing {
    fn new(zero_ns: u64, (from_ms, to_ms): (f64, f64)) -> Self {
        Self {
            only: None,
            zero_ns,
            from_ms,
            to_ms,
            svg: String::new(),
        }
    }

    fn ms(&self, at_ns: u64) -> f64 {
        (at_ns as f64 - self.zero_ns as f64) * 1e-6
    }

    fn x(&self, at_ns: u64) -> f64 {
        let part = (self.ms(at_ns) - self.from_ms) / (self.to_ms - self.from_ms);
        LABELS + part.clamp(0.0, 1.0) * (WIDTH - LABELS - RIGHT)
    }

    fn shows(&self, at_ns: u64) -> bool {
        (self.from_ms..=self.to_ms).contains(&self.ms(at_ns))
    }

    fn row(&self, system: SystemId, core: CoreId) -> f64 {
        let above = if self.only.is_some() {
            0.0
        } else {
            system.index() as f64
        };
        TOP + above * (3.0 * ROW + GAP) + core.index() as f64 * ROW
    }

    /// The row below those of the cores.
    fn vehicle_row(&self) -> f64 {
        let systems = if self.only.is_some() { 1.0 } else { 2.0 };
        TOP + systems * (3.0 * ROW + GAP)
    }

    /// The lower end of all rows.
    fn bottom(&self) -> f64 {
        self.vehicle_row() + if self.only.is_some() { 0.0 } else { ROW }
    }

    fn has(&self, system: SystemId) -> bool {
        self.only.is_none_or(|only| only == system)
    }

    fn draw(mut self, log: &RunLog, timeline: &Timeline, title: &str) -> String {
        let height = self.bottom() + 26.0;
        let _ = write!(
            self.svg,
            r#"<svg role="img" aria-label="{title}" viewBox="0 0 {WIDTH} {height}" font-size="14" font-family="sans-serif">"#
        );
        self.axis();
        let only = self.only;
        for line in timeline
            .cores
            .iter()
            .filter(|line| only.is_none_or(|only| only == line.system))
        {
            self.core(line);
        }
        self.flows(timeline);
        if self.only.is_none() {
            self.vehicle(log);
        }
        self.deaths(timeline);
        self.svg += "</svg>";
        self.svg
    }

    fn text(&mut self, x: f64, y: f64, anchor: &str, fill: RGBColor, text: &str) {
        let fill = hex(fill);
        let _ = write!(
            self.svg,
            r#"<text x="{x:.1}" y="{y:.1}" text-anchor="{anchor}" fill="{fill}">{text}</text>"#
        );
    }

    fn line(&mut self, from: (f64, f64), to: (f64, f64), stroke: RGBColor, more: &str) {
        let ((x1, y1), (x2, y2), stroke) = (from, to, hex(stroke));
        let _ = write!(
            self.svg,
            r#"<line x1="{x1:.1}" y1="{y1:.1}" x2="{x2:.1}" y2="{y2:.1}" stroke="{stroke}" {more}/>"#
        );
    }

    fn axis(&mut self) {
        let bottom = self.bottom();
        for tick_ms in round_ticks((self.from_ms, self.to_ms), 8) {
            let part = (tick_ms - self.from_ms) / (self.to_ms - self.from_ms);
            let x = LABELS + part * (WIDTH - LABELS - RIGHT);
            self.line((x, TOP - 6.0), (x, bottom), color::GRID, "");
            let unit = if tick_ms.abs() < 1e-9 { " ms" } else { "" };
            let label = plain(tick_ms) + unit;
            self.text(x, bottom + 18.0, "middle", color::MUTED, &label);
        }
    }

    fn core(&mut self, line: &CoreLine) {
        let top = self.row(line.system, line.core);
        let name = match line.core {
            CoreId::CONTROL => "control",
            CoreId::PERCEPTION => "perception",
            _ => "planning",
        };
        let label = format!("{}{} {name}", line.system, line.core.index());
        let color = system_color(line.system);
        self.text(LABELS - 10.0, top + BAR - 5.0, "end", color, &label);
        let base = (LABELS, top + BAR);
        self.line(base, (WIDTH - RIGHT, top + BAR), color::PALE, "");
        let shown = |slice: &&Slice| {
            self.ms(slice.end_ns) >= self.from_ms && self.ms(slice.begin_ns) <= self.to_ms
        };
        let slices: Vec<Slice> = line.slices.iter().filter(shown).cloned().collect();
        for slice in slices {
            self.slice(line, &slice, top);
        }
        let rung = |mark: &&crate::timeline::Mark| {
            matches!(mark.event, Event::Interrupted { .. }) && self.shows(mark.at_ns)
        };
        let rings: Vec<u64> = line.marks.iter().filter(rung).map(|m| m.at_ns).collect();
        for at_ns in rings {
            let x = self.x(at_ns);
            let (low, fill) = (top + BAR, hex(color::MUTED));
            let _ = write!(
                self.svg,
                r#"<path d="M{x:.1} {low:.1}l-3 6h6z" fill="{fill}"><title>doorbell</title></path>"#
            );
        }
    }

    fn slice(&mut self, line: &CoreLine, slice: &Slice, top: f64) {
        let (from, to) = (self.x(slice.begin_ns), self.x(slice.end_ns));
        let inset = (5.0 * slice.depth as f64).min(BAR - 6.0);
        let (width, height) = ((to - from).max(NARROWEST), BAR - inset);
        let (y, fill) = (top + inset, hex(task_color(slice.work)));
        let name = slice.work.name(line.core);
        let span_ms = (slice.end_ns - slice.begin_ns) as f64 * 1e-6;
        let begin_ms = self.ms(slice.begin_ns);
        let end = if slice.cut { ", cut short" } else { "" };
        let _ = write!(
            self.svg,
            r#"<rect x="{from:.1}" y="{y:.1}" width="{width:.1}" height="{height:.1}" fill="{fill}"><title>{name}: {span_ms:.3} ms from {begin_ms:.3} ms on{end}</title></rect>"#
        );
    }

    fn flows(&mut self, timeline: &Timeline) {
        for flow in &timeline.flows {
            let ((from, from_ns), (to, to_ns)) = (flow.from, flow.to);
            if !self.has(flow.system) || !self.shows(from_ns) || !self.shows(to_ns) {
                continue;
            }
            let down = self.row(flow.system, to) > self.row(flow.system, from);
            // From the edge of the bar that is nearer to the other one.
            let edge =
                |core, lower: bool| self.row(flow.system, core) + if lower { BAR } else { 0.0 };
            let begin = (self.x(from_ns), edge(from, down));
            let end = (self.x(to_ns), edge(to, !down));
            self.line(begin, end, color::BAD, r#"stroke-width="1.5""#);
            let (x, y, fill) = (end.0, end.1, hex(color::BAD));
            let tip = if down { -7 } else { 7 };
            let _ = write!(
                self.svg,
                r#"<path d="M{x:.1} {y:.1}l-3.5 {tip}h7z" fill="{fill}"/>"#
            );
        }
    }

    fn vehicle(&mut self, log: &RunLog) {
        let middle = self.vehicle_row() + BAR / 2.0;
        let label = "control frames";
        self.text(LABELS - 10.0, middle + 5.0, "end", color::MUTED, label);
        for frame in &log.control {
            if !self.shows(frame.at_ns) {
                continue;
            }
            let x = self.x(frame.at_ns);
            let color = system_color(frame.system);
            let (name, ms, fill) = (frame.system, self.ms(frame.at_ns), hex(color));
            let _ = match frame.verdict {
                Verdict::Accepted => write!(
                    self.svg,
                    r#"<circle cx="{x:.1}" cy="{middle:.1}" r="4" fill="{fill}"><title>{name}, {ms:.3} ms</title></circle>"#
                ),
                _ => write!(
                    self.svg,
                    r#"<path d="M{x:.1} {middle:.1}m-4 -4l8 8m0 -8l-8 8" stroke="{fill}" stroke-width="2"/>"#
                ),
            };
        }
    }

    fn deaths(&mut self, timeline: &Timeline) {
        let mut lanes_used = 0;
        for (at_ns, system, event) in &timeline.supplies {
            let label = match event {
                SupplyEvent::CoreDied { core, signal: 9 } => {
                    format!("{system}{} killed", core.index())
                }
                SupplyEvent::CoreDied { core, .. } => format!("{system}{} died", core.index()),
                SupplyEvent::Reset(_) => format!("{system} reset"),
                SupplyEvent::CoreStarted { .. } | SupplyEvent::Suspended => continue,
            };
            if !self.has(*system) || !self.shows(*at_ns) {
                continue;
            }
            let x = self.x(*at_ns);
            let top = self.row(*system, CoreId::CONTROL) - 4.0;
            let bottom = self.row(*system, CoreId::PLANNING) + BAR + 4.0;
            let dashed = r#"stroke-width="1.5" stroke-dasharray="4 3""#;
            self.line((x, top), (x, bottom), color::BAD, dashed);
            let second = lanes_used % 2 == 1;
            let y = if second { 30.0 } else { 14.0 };
            lanes_used += 1;
            self.line((x, y + 3.0), (x, top), color::BAD, r#"stroke-width="0.7""#);
            // The second one to the right, so that it does not cross the line of the first.
            if second && x < WIDTH - 120.0 {
                self.text(x + 4.0, y, "start", color::BAD, &label);
            } else {
                self.text(x - 4.0, y, "end", color::BAD, &label);
            }
        }
        let x = self.x(self.zero_ns);
        let line = r#"stroke-width="1""#;
        self.line((x, TOP - 12.0), (x, self.vehicle_row()), color::GOOD, line);
    }
}

const fn system_color(system: SystemId) -> RGBColor {
    match system {
        SystemId::A => color::A,
        SystemId::B => color::B,
    }
}

/// The table of all tasks and of the signals between cores.
pub(super) fn tasks(metrics: &Metrics) -> Markup {
    if metrics.tasks.is_empty() {
        return html! {};
    }
    let stacks = metrics.tasks.iter().any(|t| t.stack_free_bytes.is_some());
    html! {
        section {
            h2 { "Tasks" }
            p.note {
                "Response: from the release of a job to its end. Execution: without tasks and \
                 handlers within it; what the machine's scheduler took away is in it. The bars are \
                 response times from 1 µs to 1 s: half of the jobs up to the dark end, 99 of 100 \
                 up to the light end, the longest at the mark; red is the deadline."
            }
            table.tight {
                tr {
                    th { "core" } th { "task" } th.num { "jobs" } th.num { "period" }
                    th.num { "deadline" } th.num { "missed" }
                    th.num { "response p50" } th.num { "p99" } th.num { "max" } th { "" }
                    th.num { "execution p50" } th.num { "max" }
                    @if stacks { th.num { "stack free" } }
                }
                @for task in &metrics.tasks { (task_row(task, stacks)) }
            }
        }
        section {
            h2 { "Signals from core to core" }
            p.note { "From just before the signal until the signalled core's task takes it up." }
            table {
                tr {
                    th { "from → to" } th.num { "signals" }
                    th.num { "p50" } th.num { "p99" } th.num { "max" }
                }
                @for wake in &metrics.wakes {
                    tr {
                        td {
                            (super::system(&wake.system)) (wake.from) " → "
                            (super::system(&wake.system)) (wake.to)
                        }
                        td.num { (wake.count) }
                        @for value in [
                            wake.latency_p50_ms, wake.latency_p99_ms, wake.latency_max_ms,
                        ] {
                            td.num { (short(value)) }
                        }
                    }
                }
            }
        }
    }
}

fn task_row(task: &TaskMetrics, stacks: bool) -> Markup {
    let class = if task.deadline_misses > 0 {
        "num bad"
    } else {
        "num"
    };
    html! {
        tr {
            td { (super::system(&task.system)) (task.core) }
            td { (task.task) }
            td.num { (task.jobs) }
            td.num { (short(task.period_ms)) }
            td.num { (short(task.deadline_ms)) }
            td class=(class) {
                @if task.deadline_ms.is_some() { (task.deadline_misses) } @else { "–" }
            }
            td.num { (short(task.response_p50_ms)) }
            td.num { (short(task.response_p99_ms)) }
            td.num { (short(task.response_max_ms)) }
            td { (PreEscaped(spark(task))) }
            td.num { (short(task.execution_p50_ms)) }
            td.num { (short(task.execution_max_ms)) }
            @if stacks {
                td.num {
                    (task.stack_free_bytes.map_or("–".to_owned(), |bytes| format!("{bytes} B")))
                }
            }
        }
    }
}

/// A span with three digits and its unit.
fn short(ms: Option<f64>) -> String {
    let Some(ms) = ms else {
        return "–".to_owned();
    };
    let (value, unit) = if ms < 1.0 {
        (ms * 1e3, "µs")
    } else {
        (ms, "ms")
    };
    let digits = match value {
        v if v < 10.0 => 2,
        v if v < 100.0 => 1,
        _ => 0,
    };
    let text = format!("{value:.digits$}");
    let text = match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
        false => text,
    };
    format!("{text} {unit}")
}

/// Response times on a logarithmic line of six decades.
fn spark(task: &TaskMetrics) -> String {
    const LENGTH: f64 = 180.0;
    let place = |ms: f64| ((ms.max(1e-3).log10() + 3.0) / 6.0 * LENGTH).clamp(0.0, LENGTH);
    let mut svg = format!(
        r#"<svg class="spark" viewBox="0 0 {LENGTH} 14" role="img" aria-label="{}">"#,
        task.task
    );
    let mut rect = |x: f64, y: f64, width: f64, height: f64, fill: RGBColor| {
        let fill = hex(fill);
        let _ = write!(
            svg,
            r#"<rect x="{x:.1}" y="{y}" width="{width:.1}" height="{height}" fill="{fill}"/>"#
        );
    };
    rect(0.0, 6.5, LENGTH, 1.0, color::GRID);
    if let Some(p99) = task.response_p99_ms {
        rect(0.0, 3.0, place(p99), 8.0, color::CALM);
    }
    if let Some(p50) = task.response_p50_ms {
        rect(0.0, 3.0, place(p50), 8.0, color::A);
    }
    if let Some(max) = task.response_max_ms {
        rect(place(max) - 1.0, 1.0, 2.0, 12.0, color::MUTED);
    }
    if let Some(deadline) = task.deadline_ms {
        rect(place(deadline) - 1.0, 0.0, 2.0, 14.0, color::BAD);
    }
    svg + "</svg>"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spans_have_three_digits_and_a_unit() {
        let shown: Vec<String> = [0.000_4, 0.012_34, 0.5, 5.0, 12.34, 123.4]
            .into_iter()
            .map(|ms| short(Some(ms)))
            .collect();
        assert_eq!(
            shown,
            ["0.4 µs", "12.3 µs", "500 µs", "5 ms", "12.3 ms", "123 ms"]
        );
        assert_eq!(short(None), "–");
    }
}
