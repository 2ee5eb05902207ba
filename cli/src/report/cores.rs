//! The cores in the report: a timeline around one important moment, and the figures of the tasks.

use maud::{Markup, html};
use tandem_board::{CoreId, SupplyEvent, SystemId};
use tandem_cores::task_table::TaskCode;
use tandem_cores::trace::Event;

use tandem_page::chart::{WIDTH, plain, round_ticks};
use tandem_page::svg::{Anchor, Color, Stroke, Svg};
use tandem_page::{format, legend, section};
use tandem_record::{RunLog, Takeover};
use tandem_vehicle::Ruling;

use super::sections::system_color;
use crate::metrics::Metrics;
use crate::timeline::{CoreLine, Slice, TaskMetrics, Timeline, Work};

/// Time shown before and after the chosen moment, ms: more than one perception period.
const WIDE_MS: (f64, f64) = (-40.0, 20.0);
/// The span before and after a takeover, ms.
const CLOSE_MS: (f64, f64) = (-2.5, 0.5);
/// The span around a pass through the chain, ms.
const AROUND_CHAIN_MS: f64 = 0.1;
const LABELS: f64 = 150.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 42.0;
const ROW: f64 = 34.0;
const BAR: f64 = 22.0;
/// Space between the two systems, and above the vehicle's row.
const GAP: f64 = 12.0;
/// The smallest width of a slice in the drawing, so that short slices are visible.
const NARROWEST: f64 = 1.2;

/// The legend: the meaning of the colours of slices.
const LEGEND: [(TaskCode, Color); 9] = [
    (TaskCode::CONTROL, Color::A),
    (TaskCode::DEGRADED, Color::WARN),
    (TaskCode::ROLES, Color::CALM),
    (TaskCode::MONITORING, Color::MUTED),
    (TaskCode::STATUS, Color::OTHER),
    (TaskCode::TOPICS, Color::THREADS),
    (TaskCode::TRAJECTORY_INPUT, Color::BAD),
    (TaskCode::PERCEPTION, Color::GOOD),
    (TaskCode::PLANNING, Color::B),
];

/// Draws the timeline around the first takeover from a failed master, else around the first
/// takeover, else around a quiet moment. Draws nothing if no core has left a trace.
pub(super) fn timeline(log: &RunLog, timeline: &Timeline, takeovers: &[Takeover]) -> Markup {
    // Prefer a failed master. A takeover from a held-up one shows a stall of the machine.
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
    let colors = LEGEND.map(|(code, color)| (code.name().unwrap_or_default(), Some(color)));
    let note = format!(
        "What ran when, in milliseconds{}. Arrows are signals from core to core; dots are control \
         frames that the vehicle obeyed, crosses those that it refused. Narrow slices are drawn \
         wider than they were. The whole run is in trace.perfetto-trace: open it at ui.perfetto.dev.",
        if takeover.is_some() {
            " from the new master's first obeyed frame on"
        } else {
            ""
        }
    );
    let pictures = html! {
        (wide)
        @if let Some(close) = close {
            p.note { "The last milliseconds of it." }
            (close)
        }
    };
    html! {
        (section(title, &legend(colors.into_iter()), &note, &pictures))
        @if let Some(chain) = chain {
            (section("One pass through the chain", &html! {}, "From the measurement on core 1 over \
                core 2 to core 0, the median of all passes, in milliseconds.", &chain))
        }
    }
}

/// Returns the pass through the chain whose signals took the median time: its system, the start
/// time of perception and the arrival time on core 0, ns.
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
    // The task sends the signal at its end, so take the slice around the signal.
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

/// Returns a moment between two signals of core 1 of the first system, well within the run.
fn quiet_moment(timeline: &Timeline) -> Option<u64> {
    let first = |flow: &&crate::timeline::Flow| flow.from.0 == CoreId::PERCEPTION;
    let chain: Vec<u64> = timeline
        .flows
        .iter()
        .filter(first)
        .map(|flow| flow.from.1)
        .collect();
    // The first system's signals are about the first half of the list, so 2/5 is well within them.
    let moment = chain.get(2 * chain.len() / 5)?;
    Some(moment + 10_000_000)
}

fn task_color(work: Work) -> Color {
    let known = LEGEND
        .iter()
        .find(|(code, ..)| Work::Task(*code) == work)
        .map(|(.., color)| *color);
    known.unwrap_or(Color::PALE)
}

struct Drawing {
    /// If set, only this system is drawn, without the vehicle.
    only: Option<SystemId>,
    zero_ns: u64,
    from_ms: f64,
    to_ms: f64,
    svg: Svg,
}

impl Drawing {
    fn new(zero_ns: u64, (from_ms, to_ms): (f64, f64)) -> Self {
        Self {
            only: None,
            zero_ns,
            from_ms,
            to_ms,
            // The height is set later, when the rows are known.
            svg: Svg::new(WIDTH, 0.0),
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

    /// Returns the top of the vehicle's row, below the rows of the cores.
    fn vehicle_row(&self) -> f64 {
        let systems = if self.only.is_some() { 1.0 } else { 2.0 };
        TOP + systems * (3.0 * ROW + GAP)
    }

    /// Returns the lower end of all rows.
    fn bottom(&self) -> f64 {
        self.vehicle_row() + if self.only.is_some() { 0.0 } else { ROW }
    }

    fn has(&self, system: SystemId) -> bool {
        self.only.is_none_or(|only| only == system)
    }

    fn draw(mut self, log: &RunLog, timeline: &Timeline, title: &str) -> Markup {
        self.svg = Svg::new(WIDTH, self.bottom() + 26.0);
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
        self.svg.finish("chart", title)
    }

    fn axis(&mut self) {
        let bottom = self.bottom();
        for tick_ms in round_ticks((self.from_ms, self.to_ms), 8) {
            let part = (tick_ms - self.from_ms) / (self.to_ms - self.from_ms);
            let x = LABELS + part * (WIDTH - LABELS - RIGHT);
            self.svg
                .line((x, TOP - 6.0), (x, bottom), Stroke::new(Color::GRID, 1.0));
            let unit = if tick_ms.abs() < 1e-9 { " ms" } else { "" };
            let label = plain(tick_ms) + unit;
            let place = (x, bottom + 18.0);
            self.svg.text(place, Anchor::Middle, Color::MUTED, &label);
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
        let place = (LABELS - 10.0, top + BAR - 5.0);
        self.svg.text(place, Anchor::End, color, &label);
        let base = (LABELS, top + BAR);
        let pale = Stroke::new(Color::PALE, 1.0);
        self.svg.line(base, (WIDTH - RIGHT, top + BAR), pale);
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
            let low = top + BAR;
            let corners = [(x, low), (x - 3.0, low + 6.0), (x + 3.0, low + 6.0)];
            self.svg.shape(corners.into_iter(), Color::MUTED);
        }
    }

    fn slice(&mut self, line: &CoreLine, slice: &Slice, top: f64) {
        let (from, to) = (self.x(slice.begin_ns), self.x(slice.end_ns));
        let inset = (5.0 * slice.depth as f64).min(BAR - 6.0);
        let (width, height) = ((to - from).max(NARROWEST), BAR - inset);
        let (y, fill) = (top + inset, task_color(slice.work));
        let name = slice.work.name(line.core);
        let span_ms = (slice.end_ns - slice.begin_ns) as f64 * 1e-6;
        let begin_ms = self.ms(slice.begin_ns);
        let end = if slice.cut { ", cut short" } else { "" };
        let title = format!("{name}: {span_ms:.3} ms from {begin_ms:.3} ms on{end}");
        self.svg.rect((from, y), (width, height), fill, &title);
    }

    fn flows(&mut self, timeline: &Timeline) {
        for flow in &timeline.flows {
            let ((from, from_ns), (to, to_ns)) = (flow.from, flow.to);
            if !self.has(flow.system) || !self.shows(from_ns) || !self.shows(to_ns) {
                continue;
            }
            let down = self.row(flow.system, to) > self.row(flow.system, from);
            // The arrow begins and ends at the edges of the two bars that face each other.
            let edge =
                |core, lower: bool| self.row(flow.system, core) + if lower { BAR } else { 0.0 };
            let begin = (self.x(from_ns), edge(from, down));
            let end = (self.x(to_ns), edge(to, !down));
            self.svg.line(begin, end, Stroke::new(Color::BAD, 1.5));
            let (x, y) = end;
            let back = y + if down { -7.0 } else { 7.0 };
            let corners = [(x, y), (x - 3.5, back), (x + 3.5, back)];
            self.svg.shape(corners.into_iter(), Color::BAD);
        }
    }

    fn vehicle(&mut self, log: &RunLog) {
        let middle = self.vehicle_row() + BAR / 2.0;
        let label = "control frames";
        let place = (LABELS - 10.0, middle + 5.0);
        self.svg.text(place, Anchor::End, Color::MUTED, label);
        for frame in &log.control {
            if !self.shows(frame.at_ns) {
                continue;
            }
            let x = self.x(frame.at_ns);
            let color = system_color(frame.system);
            if frame.ruling == Ruling::Accepted {
                let title = format!("{}, {:.3} ms", frame.system, self.ms(frame.at_ns));
                self.svg.circle((x, middle), 4.0, color, false, &title);
                continue;
            }
            let stroke = Stroke::new(color, 2.0);
            for rise in [-4.0, 4.0] {
                let (from, to) = ((x - 4.0, middle - rise), (x + 4.0, middle + rise));
                self.svg.line(from, to, stroke);
            }
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
            let dashed = Stroke::new(Color::BAD, 1.5).dashed("4 3");
            self.svg.line((x, top), (x, bottom), dashed);
            let second = lanes_used % 2 == 1;
            let y = if second { 30.0 } else { 14.0 };
            lanes_used += 1;
            let thin = Stroke::new(Color::BAD, 0.7);
            self.svg.line((x, y + 3.0), (x, top), thin);
            // Draw the second label on the right, so that it does not cross the line of the first.
            let (x, anchor) = match second && x < WIDTH - 120.0 {
                true => (x + 4.0, Anchor::Start),
                false => (x - 4.0, Anchor::End),
            };
            self.svg.text((x, y), anchor, Color::BAD, &label);
        }
        let x = self.x(self.zero_ns);
        let (top, bottom) = ((x, TOP - 12.0), (x, self.vehicle_row()));
        self.svg.line(top, bottom, Stroke::new(Color::GOOD, 1.0));
    }
}

/// Returns the table of all tasks and of the signals between cores.
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
            td { (spark(task)) }
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

/// Formats a time span with its unit.
fn short(ms: Option<f64>) -> String {
    ms.map_or("–".to_owned(), |ms| format::time(ms * 1e6))
}

/// Draws response times on a logarithmic axis of six decades.
fn spark(task: &TaskMetrics) -> Markup {
    const LENGTH: f64 = 180.0;
    let place = |ms: f64| ((ms.max(1e-3).log10() + 3.0) / 6.0 * LENGTH).clamp(0.0, LENGTH);
    let mut svg = Svg::new(LENGTH, 14.0);
    let mut rect = |x: f64, y: f64, width: f64, height: f64, fill: Color| {
        svg.rect((x, y), (width, height), fill, "");
    };
    rect(0.0, 6.5, LENGTH, 1.0, Color::GRID);
    if let Some(p99) = task.response_p99_ms {
        rect(0.0, 3.0, place(p99), 8.0, Color::CALM);
    }
    if let Some(p50) = task.response_p50_ms {
        rect(0.0, 3.0, place(p50), 8.0, Color::A);
    }
    if let Some(max) = task.response_max_ms {
        rect(place(max) - 1.0, 1.0, 2.0, 12.0, Color::MUTED);
    }
    if let Some(deadline) = task.deadline_ms {
        rect(place(deadline) - 1.0, 0.0, 2.0, 14.0, Color::BAD);
    }
    svg.finish("spark", &task.task)
}
