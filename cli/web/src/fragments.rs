//! The changing parts of the page, drawn as the report draws them. The server sends them with each
//! state, and the page puts them in place.

use maud::{Markup, html};
use serde::Serialize;
use tandem_board::SystemId;
use tandem_cores::driving::types::Lanes;
use tandem_page::chart::{Axis, Chart, Polygon, Series, Style};
use tandem_page::plot::Plot;
use tandem_page::svg::Color;
use tandem_page::tile;

use crate::history::{History, Moment};
use crate::state::{ahead_m, events};
use tandem_watch::state_name;

/// The view of the road: metres behind and ahead of the vehicle.
const VIEW_M: (f64, f64) = (-25.0, 90.0);
/// Half of the displayed height of the view, m.
const ASIDE_M: f64 = 8.0;
/// Height of the view in its own units: a metre has the same length along and across.
const VIEW_HEIGHT: f64 = 190.0;
/// The lanes are drawn this much beyond the view, m: their ends are not at right angles to it.
const BEYOND_M: f64 = 4.0;
/// Length and width of the own vehicle in the drawing, m.
const VEHICLE_M: (f64, f64) = (4.6, 1.9);
/// The chart of gaps reaches at least this, ms.
const GAP_TOP_MS: f64 = 25.0;
/// Most shown times without redundancy that are over.
const LOSSES: usize = 3;
/// Rows of the event log.
const EVENT_ROWS: usize = 16;

/// The parts, as HTML. The name of each is the id of the element whose content it is.
#[derive(Debug, Serialize)]
pub(crate) struct Fragments {
    head: String,
    system_a: String,
    system_b: String,
    tiles: String,
    lane: String,
    events: String,
}

impl Fragments {
    /// Draws the newest state.
    pub(crate) fn of(history: &History) -> Self {
        Self {
            head: head(history).into_string(),
            system_a: system(history, SystemId::A).into_string(),
            system_b: system(history, SystemId::B).into_string(),
            tiles: tiles(history).into_string(),
            lane: lane(history).into_string(),
            events: event_table(history).into_string(),
        }
    }
}

/// The plots over the last minute.
pub(crate) struct Plots {
    roles: Chart,
    gaps: Chart,
    lateral: Chart,
}

/// Their data. The name of each is the id of the element that shows it.
#[derive(Debug, Serialize)]
pub(crate) struct PlotData<'a> {
    roles: Plot<'a>,
    gaps: Plot<'a>,
    lateral: Plot<'a>,
}

impl Plots {
    /// Returns the plots of the newest state.
    pub(crate) fn of(history: &History) -> Self {
        Self {
            roles: roles(history),
            gaps: gaps(history),
            lateral: lateral(history),
        }
    }

    /// Returns their data.
    pub(crate) fn data(&self) -> PlotData<'_> {
        PlotData {
            roles: self.roles.data("roles"),
            gaps: self.gaps.data("longest gap"),
            lateral: self.lateral.data("distance"),
        }
    }
}

/// Returns the colour of a state, as in the report.
const fn state_color(code: u8) -> Option<Color> {
    Some(match code {
        1 => Color::PALE,
        2 => Color::CALM,
        3 => Color::GOOD,
        4 => Color::WARN,
        5 => Color::B,
        6 => Color::BAD,
        7 => Color::A,
        _ => return None,
    })
}

fn head(history: &History) -> Markup {
    let picture = &history.picture;
    html! {
        p.sub {
            (picture.run)
            @if let Some(roles) = &picture.roles {
                (format!(" · {:.1} s of {:.0} s · {} frames/s", roles.time_s, roles.duration_s,
                    picture.frames_per_s()))
            }
        }
        @if picture.has_ended() {
            div class="verdict bad" { "the run has ended" }
        } @else {
            div class="verdict good" { "live" }
        }
        @if let Some(since_s) = picture.alone_since_s() {
            div class="verdict bad" {
                (format!("no redundancy since {since_s:.1} s"))
                @if let Some(driver) = picture.obeyed() { ": " (driver) " drives alone" }
            }
        }
        @for alone in picture.alone.iter().rev().take(LOSSES) {
            @if let Some(until_s) = alone.until_s {
                div class="verdict warn" {
                    (format!("no redundancy from {:.1} s to {until_s:.1} s", alone.since_s))
                }
            }
        }
        @if !history.said.is_empty() {
            div class="verdict warn" { (history.said) }
        }
    }
}

fn lamp(name: &str, on: bool) -> Markup {
    let color = if on { Color::GOOD } else { Color::BAD };
    html! {
        span { i style=(format!("background:{}", color.css())) {} (name) }
    }
}

/// Draws one system: its state, its cores and its heartbeats.
fn system(history: &History, system: SystemId) -> Markup {
    let Some(roles) = history.picture.roles else {
        return html! { p.note { "no news yet" } };
    };
    let index = system.index();
    let state = roles.state[index];
    let color = state_color(state).unwrap_or(Color::PALE);
    html! {
        p {
            i.state style=(format!("background:{}", color.css())) {}
            b { (state_name(state)) }
            @if history.picture.obeyed() == Some(system) {
                " · the vehicle obeys it, term " (roles.term)
            }
        }
        div.legend {
            @for core in 0..3 {
                (lamp(&format!("core {core}"), roles.alive[3 * index + core] != 0))
            }
            @for line in 0..2 {
                (lamp(&format!("heartbeat {}", line + 1), roles.beats[index] >> line & 1 == 1))
            }
            @for wire in roles.cut_wires(index) { (lamp(&format!("cut: {wire}"), false)) }
        }
    }
}

fn tiles(history: &History) -> Markup {
    let (roles, vehicle) = (history.picture.roles, history.picture.vehicle);
    let number = |value: Option<f64>, digits: usize| {
        value.map_or("–".to_owned(), |value| format!("{value:.digits$}"))
    };
    let count = roles.map_or("–".to_owned(), |it| it.takeovers.to_string());
    let without_ms = { roles.filter(|it| it.takeovers > 0) }.map(|it| it.takeover_gap_ms);
    let ahead = vehicle.and_then(|it| ahead_m(it.lead_gap));
    let remark = |text: &str| html! { div.remark { (text) } };
    html! {
        (tile("Takeovers", "", &count, "", &remark("")))
        (tile("Last takeover", "", &number(without_ms, 1), "ms", &remark("without control")))
        (tile("Largest control gap", "", &number(roles.map(|it| it.gap_max_ms), 1), "ms",
            &remark("between accepted frames")))
        (tile("Speed", "", &number(vehicle.map(|it| it.speed * 3.6), 0), "km/h", &remark("")))
        (tile("Ahead", "", &ahead.map_or("free".to_owned(), |it| format!("{it:.0}")),
            if ahead.is_some() { "m" } else { "" }, &remark("in the lane")))
    }
}

/// Draws the road from above: the lanes, the planned path, the vehicle and its neighbours, as the
/// sensors show them.
fn lane(history: &History) -> Markup {
    let (Some(vehicle), Some((scene, path))) = (history.picture.vehicle, &history.seen) else {
        return html! { p.note { "no vehicle yet" } };
    };
    let x = Axis::linear("m ahead of the own vehicle", VIEW_M, 10);
    let y = Axis::linear("m, left +", (-ASIDE_M, ASIDE_M), 4);
    let mut chart = Chart::new(VIEW_HEIGHT, x, y);
    chart.grid = false;
    if let Some(lanes) = &scene.lanes {
        draw_lanes(&mut chart, lanes);
    }
    let path = { path.points.iter() }.map(|it| (f64::from(it.x), f64::from(it.y)));
    let path = path
        .filter(|point| point.0 <= VIEW_M.1)
        .map(visible)
        .collect();
    chart
        .series
        .push(series("", Color::GOOD, Style::Line(3.0), path));
    for object in &scene.objects {
        let (name, color) = match object.cuts_in {
            true => ("a vehicle that cuts in", Color::WARN),
            false => ("another vehicle", Color::MUTED),
        };
        let centre = (f64::from(object.x), f64::from(object.y));
        let size = (f64::from(object.length), f64::from(object.width));
        draw_vehicle(
            &mut chart,
            name,
            color,
            (centre, tandem_watch::yaw(object)),
            size,
        );
    }
    draw_vehicle(
        &mut chart,
        "the own vehicle",
        Color::A,
        ((0.0, 0.0), 0.0),
        VEHICLE_M,
    );
    let offset = vehicle.lateral_error;
    let side = if offset >= 0.0 { "left" } else { "right" };
    html! {
        p.note {
            (format!("Lane {}: {:.2} m {side} of its centre, {:+.1} m/s² across, {:+.1} m/s² along. \
                Green: the planned path. Yellow: cuts in.",
                vehicle.lane, offset.abs(), vehicle.lat_accel, vehicle.accel))
        }
        (chart.svg("the road from above"))
    }
}

/// Draws the surface of the lanes and their borders. Those of the road are solid.
fn draw_lanes(chart: &mut Chart, lanes: &Lanes) {
    let ends_m = (VIEW_M.0 - BEYOND_M, VIEW_M.1 + BEYOND_M);
    let borders = tandem_watch::borders(lanes, ends_m.0 as f32, ends_m.1 as f32).into_iter();
    let point = |(x, y)| visible((f64::from(x), f64::from(y)));
    let borders: Vec<Vec<(f64, f64)>> = borders
        .map(|border| border.into_iter().map(point).collect())
        .collect();
    if let (Some(left), Some(right)) = (borders.first(), borders.last()) {
        chart.shapes.push(Polygon {
            name: "",
            color: Color::ROAD,
            corners: left.iter().chain(right.iter().rev()).copied().collect(),
        });
    }
    let last = borders.len().saturating_sub(1);
    for (index, border) in borders.into_iter().enumerate() {
        let dashes = if index == 0 || index == last {
            ""
        } else {
            "6 8"
        };
        let style = Style::Dashed(1.5, dashes);
        chart.series.push(series("", Color::OTHER, style, border));
    }
}

/// Moves a point outside the view to its edge.
fn visible((x, y): (f64, f64)) -> (f64, f64) {
    (x.clamp(VIEW_M.0, VIEW_M.1), y.clamp(-ASIDE_M, ASIDE_M))
}

/// Draws a vehicle with this centre, direction, length and width, if all of it is in the view.
fn draw_vehicle(
    chart: &mut Chart,
    name: &'static str,
    color: Color,
    (centre, yaw): ((f64, f64), f64),
    (length, width): (f64, f64),
) {
    let (sin, cos) = yaw.sin_cos();
    let corner = |(along, across): (f64, f64)| {
        let (along, across) = (along * length / 2.0, across * width / 2.0);
        let x = centre.0 + along * cos - across * sin;
        (x, centre.1 + along * sin + across * cos)
    };
    let corners = [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)].map(corner);
    let is_seen =
        |(x, y): &(f64, f64)| (VIEW_M.0..=VIEW_M.1).contains(x) && (-ASIDE_M..=ASIDE_M).contains(y);
    if corners.iter().all(is_seen) {
        chart.shapes.push(Polygon {
            name,
            color,
            corners: corners.to_vec(),
        });
    }
}

/// Draws the roles of both systems as bars, and below them when one of them was alone.
fn roles(history: &History) -> Chart {
    let y = Axis::rows(3, |value| {
        ["alone", "B", "A"][value as usize % 3].to_owned()
    });
    let span_s = history.span_s();
    let mut chart = Chart::new(150.0, Axis::times(span_s), y);
    for (index, row) in [(0, 2), (1, 1)] {
        for (state, from_s, to_s) in spans(history, index) {
            if let Some(color) = state_color(state) {
                let bar = Polygon::bar(state_name(state), color, (from_s, to_s), row);
                chart.shapes.push(bar);
            }
        }
    }
    let now_s = history.picture.roles.map_or(0.0, |it| it.time_s);
    for alone in &history.picture.alone {
        let span_s = (alone.since_s.max(span_s.0), alone.until_s.unwrap_or(now_s));
        if span_s.0 < span_s.1 {
            let bar = Polygon::bar("no redundancy", Color::BAD, span_s, 0);
            chart.shapes.push(bar);
        }
    }
    chart.marks = history.takeovers_s.iter().copied().collect();
    chart
}

/// Returns the states of one system, each with the time from which and to which it lasted, s.
fn spans(history: &History, index: usize) -> Vec<(u8, f64, f64)> {
    let mut spans: Vec<(u8, f64, f64)> = Vec::new();
    for moment in &history.moments {
        let state = moment.state[index];
        if let Some((last, _, to_s)) = spans.last_mut() {
            *to_s = moment.time_s;
            if *last == state {
                continue;
            }
        }
        spans.push((state, moment.time_s, moment.time_s));
    }
    spans
}

fn series(name: &str, color: Color, style: Style, points: Vec<(f64, f64)>) -> Series {
    Series {
        name: name.to_owned(),
        title: String::new(),
        color,
        style,
        points,
    }
}

/// Returns a chart of one value over time, with marks at the takeovers.
fn over_time(history: &History, y: Axis, value: impl Fn(&Moment) -> f64) -> Chart {
    let mut chart = Chart::new(190.0, Axis::times(history.span_s()), y);
    let points = history.moments.iter().map(|it| (it.time_s, value(it)));
    chart.series = vec![series("", Color::A, Style::Line(2.0), points.collect())];
    chart.marks = history.takeovers_s.iter().copied().collect();
    chart
}

fn gaps(history: &History) -> Chart {
    let top = { history.moments.iter() }.fold(GAP_TOP_MS, |top, it| top.max(it.gap_ms));
    over_time(history, Axis::linear("ms", (0.0, top), 5), |it| it.gap_ms)
}

fn lateral(history: &History) -> Chart {
    let values = history.moments.iter().map(|it| it.lateral_m);
    let widest = values
        .filter(|it| it.is_finite())
        .fold(0.3, |widest: f64, it| widest.max(it.abs()));
    let y = Axis::linear("m, left +", (-widest, widest), 5);
    over_time(history, y, |it| it.lateral_m)
}

fn event_table(history: &History) -> Markup {
    html! {
        table {
            tr { th { "at" } th { "who" } th { "what" } }
            @for event in events(history).iter().take(EVENT_ROWS) {
                tr {
                    td.time { (format!("{:.2} s", event.at_s)) }
                    td { (event.who) }
                    td { (event.what) }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::history::tests::history;

    /// Each part is well-formed, and escapes what a core has written.
    #[test]
    fn each_part_is_well_formed() {
        for history in [History::new("tandem-1-a"), history()] {
            let parts = serde_json::to_value(Fragments::of(&history)).unwrap();
            for (name, part) in parts.as_object().unwrap() {
                let text = format!("<div>{}</div>", part.as_str().unwrap());
                let read = roxmltree::Document::parse(&text);
                assert!(read.is_ok(), "{name}: {read:?}\n{text}");
            }
        }
    }

    #[test]
    fn a_takeover_is_seen() {
        let history = history();
        let of_b = Fragments::of(&history).system_b;
        assert!(
            of_b.contains("degraded master") && of_b.contains("term 13"),
            "{of_b}"
        );
        assert!(!Fragments::of(&history).system_a.contains("obeys"));
        let states: Vec<u8> = spans(&history, 1).iter().map(|span| span.0).collect();
        assert_eq!(states, [2, 4]);
        let roles = roles(&history);
        assert_eq!(roles.marks, [80.0]);
        let alone: Vec<_> = { roles.shapes.iter() }
            .filter(|it| it.name == "no redundancy")
            .map(|it| it.corners[0].0)
            .collect();
        assert_eq!(alone, [80.0]);
        let head = Fragments::of(&history).head;
        assert!(
            head.contains("no redundancy since 80.0 s: B drives alone"),
            "{head}"
        );
    }
}
