//! The changing parts of the page, drawn as the report draws them. The server sends them with each
//! state, and the page puts them in place.

use maud::{Markup, html};
use serde::Serialize;
use tandem_board::SystemId;
use tandem_page::chart::{Axis, Chart, Polygon, Series, Style};
use tandem_page::svg::Color;
use tandem_page::tile;

use crate::history::{History, Moment};
use crate::state::{ahead_m, events, state_name};

/// The view of the lane: metres behind and ahead of the vehicle.
const LANE_VIEW_M: (f64, f64) = (-15.0, 85.0);
/// Half of the displayed height of the view, m.
const ASIDE_M: f64 = 3.8;
/// Half of the displayed width of the lane, m: motorway lanes are 3.5 to 3.75 m wide.
const HALF_LANE_M: f64 = 1.85;
/// Length and half width of a vehicle in the drawing, m.
const VEHICLE_M: (f64, f64) = (4.6, 0.95);
/// The chart of gaps reaches at least this, ms.
const GAP_TOP_MS: f64 = 25.0;
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
    roles: String,
    gaps: String,
    lateral: String,
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
            roles: roles(history).svg("roles over time").into_string(),
            gaps: gaps(history).svg("gaps over time").into_string(),
            lateral: lateral(history)
                .svg("distance from the lane's centre")
                .into_string(),
            events: event_table(history).into_string(),
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

/// Draws the lane from above: its edges, its centre, the vehicle, and the vehicle ahead.
fn lane(history: &History) -> Markup {
    let Some(vehicle) = history.picture.vehicle else {
        return html! { p.note { "no vehicle yet" } };
    };
    let x = Axis::linear("m ahead of the own vehicle", LANE_VIEW_M, 10);
    let y = Axis::linear("m, left +", (-ASIDE_M, ASIDE_M), 4);
    let mut chart = Chart::new(190.0, x, y);
    chart.grid = false;
    let (behind_m, ahead_end_m) = LANE_VIEW_M;
    let rectangle = |(from_x, to_x): (f64, f64), (low, high): (f64, f64)| {
        vec![(from_x, low), (to_x, low), (to_x, high), (from_x, high)]
    };
    chart.shapes.push(Polygon {
        color: Color::ROAD,
        corners: rectangle((behind_m, ahead_end_m), (-HALF_LANE_M, HALF_LANE_M)),
    });
    let offset = vehicle.lateral_error;
    let (length_m, half_m) = VEHICLE_M;
    let aside = |at: f64| (at - half_m, at + half_m);
    if let Some(gap_m) = ahead_m(vehicle.lead_gap).filter(|gap| gap + length_m < ahead_end_m) {
        chart.shapes.push(Polygon {
            color: Color::MUTED,
            corners: rectangle((gap_m, gap_m + length_m), aside(0.0)),
        });
    }
    chart.shapes.push(Polygon {
        color: Color::A,
        corners: rectangle((-length_m, 0.0), aside(offset)),
    });
    for (at, dashes) in [(HALF_LANE_M, ""), (0.0, "6 8"), (-HALF_LANE_M, "")] {
        let points = vec![(behind_m, at), (ahead_end_m, at)];
        chart
            .series
            .push(series("", Color::OTHER, Style::Dashed(1.0, dashes), points));
    }
    let side = if offset >= 0.0 { "left" } else { "right" };
    html! {
        p.note {
            (format!("Lane {}: {:.2} m {side} of its centre, {:+.1} m/s² across, {:+.1} m/s² along. \
                The vehicle ahead is drawn in the middle of the lane.",
                vehicle.lane, offset.abs(), vehicle.lat_accel, vehicle.accel))
        }
        (chart.svg("the lane from above"))
    }
}

/// Draws the roles of both systems as bars.
fn roles(history: &History) -> Chart {
    let y = Axis {
        name: "",
        range: (0.0, 2.0),
        ticks: vec![0.5, 1.5],
        label: |value| if value < 1.0 { "B" } else { "A" }.to_owned(),
    };
    let mut chart = Chart::new(150.0, Axis::linear("s", history.span_s(), 12), y);
    chart.grid = false;
    for (index, base) in [(0, 1.0), (1, 0.0)] {
        for (state, from_s, to_s) in spans(history, index) {
            if let Some(color) = state_color(state) {
                let (low, high) = (base + 0.14, base + 0.86);
                let corners = vec![(from_s, low), (to_s, low), (to_s, high), (from_s, high)];
                chart.shapes.push(Polygon { color, corners });
            }
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
    let mut chart = Chart::new(190.0, Axis::linear("s", history.span_s(), 12), y);
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
        assert_eq!(roles(&history).marks, [80.0]);
    }
}
