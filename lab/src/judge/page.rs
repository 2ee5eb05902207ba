//! The overview page: a card with a small picture for each scenario.

use std::path::Path;

use maud::{Markup, html};
use tandem_page::svg::{Color, Stroke, Svg};
use tandem_page::{document, legend, section};
use tandem_vehicle::geometry::Vec2;

use super::drive::{Judgement, Picture, Verdict};
use super::{goal, name, sums};

/// Size of a picture in its own units.
const SIZE: (f64, f64) = (300.0, 130.0);
/// Margin around the path in a picture, m.
const ROOM_M: f64 = 12.0;

/// Decides whether a judgement belongs to a section of the page.
type Test = fn(&Judgement) -> bool;

/// Returns the page for the scenarios of this folder.
pub(super) fn page(folder: &Path, judged: &[Judgement]) -> String {
    let groups: [(&str, Test); 6] = [
        ("Collisions that the vehicle caused", Judgement::caused),
        ("Collisions that RSS calls unavoidable", |it| {
            it.collision_by_ego && !it.caused()
        }),
        ("Left its lanes", |it| {
            !it.collision_by_ego && it.excursion_m > 0.0
        }),
        ("Driven", |it| is_good(it) && it.verdict == Verdict::Driven),
        ("Stopped", |it| {
            is_good(it) && it.verdict == Verdict::Stopped
        }),
        ("Refused", |it| it.verdict == Verdict::Refused),
    ];
    let content = html! {
        h1 { "Scenarios of " (folder.display()) }
        p.sub { (sums(judged)) }
        (legend([
            ("path", Some(Color::A)),
            ("vehicle at the worst moment", Some(Color::B)),
            ("others then", Some(Color::OTHER)),
            ("first contact", Some(Color::BAD)),
        ].into_iter()))
        @for (title, test) in groups {
            @let cards: Vec<_> = judged.iter().filter(|it| test(it)).collect();
            @if !cards.is_empty() {
                (section(title, &html! { (cards.len()) }, "", &html! {
                    div style="display:grid;gap:14px;grid-template-columns:repeat(auto-fill,minmax(290px,1fr))" {
                        @for it in cards { (card(it)) }
                    }
                }))
            }
        }
    };
    document("judge", &content)
}

fn is_good(it: &Judgement) -> bool {
    !it.collision_by_ego && it.excursion_m <= 0.0
}

fn card(it: &Judgement) -> Markup {
    html! {
        div {
            b style="overflow-wrap:anywhere" { (it.title()) }
            @if it.verdict != Verdict::Refused { (picture(&it.picture, &it.title())) }
            div.remark style="overflow-wrap:anywhere" {
                (name(it.verdict)) " · goal " (goal(it))
                @if it.verdict != Verdict::Refused {
                    (format!(" · {:.0} m in {:.0} s", it.distance_m, it.driven_s))
                    br; (it.picture.worst)
                    table {
                        (row("hardest braking", it.brake_max, it.calm_brake_max, "m/s²"))
                        (row("largest jerk over 0.1 s", it.jerk_max, it.calm_jerk_max, "m/s³"))
                        (figure("lateral acceleration, largest", it.lat_accel_max, "m/s²"))
                        (figure("speed² / radius of the lane, largest", it.curve.lat_accel, "m/s²"))
                        @if let Some(margin_m) = it.rss.margin_m {
                            (figure("distance beyond the safe one (RSS), least", margin_m, "m"))
                        }
                        (figure("dangerously near for (RSS)", it.rss.dangerous_s, "s"))
                        (figure("a corner outside its lanes by", it.excursion_m, "m"))
                        (figure("others forced to brake", f64::from(it.forced_brakes), ""))
                    }
                }
                @let remark = it.remark();
                @if !remark.is_empty() { br; (remark) }
            }
        }
    }
}

/// Returns a figure with its unit.
fn figure(meaning: &str, value: f64, unit: &str) -> Markup {
    let digits = if unit.is_empty() { 0 } else { 2 };
    html! { tr { td { (meaning) } td.num { (format!("{value:.digits$} {unit}")) } } }
}

/// Returns a figure, and in brackets the same outside emergencies.
fn row(meaning: &str, value: f64, calm: f64, unit: &str) -> Markup {
    html! {
        tr {
            td { (meaning) " (outside emergencies)" }
            td.num { (format!("{value:.1} ({calm:.1}) {unit}")) }
        }
    }
}

/// Draws the road from above, north up, as large as possible.
fn picture(picture: &Picture, label: &str) -> Markup {
    let fold = |pick: fn(f64, f64) -> f64, of: &dyn Fn(&Vec2) -> f64, start: f64| {
        picture.path.iter().map(of).fold(start, pick)
    };
    let (west, east) = (
        fold(f64::min, &|p| p.x, f64::INFINITY) - ROOM_M,
        fold(f64::max, &|p| p.x, f64::NEG_INFINITY) + ROOM_M,
    );
    let (south, north) = (
        fold(f64::min, &|p| p.y, f64::INFINITY) - ROOM_M,
        fold(f64::max, &|p| p.y, f64::NEG_INFINITY) + ROOM_M,
    );
    let scale = (SIZE.0 / (east - west)).min(SIZE.1 / (north - south));
    let centre = ((west + east) / 2.0, (south + north) / 2.0);
    let place = |p: &Vec2| {
        (
            SIZE.0 / 2.0 + (p.x - centre.0) * scale,
            SIZE.1 / 2.0 - (p.y - centre.1) * scale,
        )
    };
    let mut svg = Svg::new(SIZE.0, SIZE.1);
    for [left, right] in &picture.lanes {
        let outline = left.iter().chain(right.iter().rev()).map(place);
        svg.shape(outline, Color::ROAD);
    }
    for [left, right] in &picture.lanes {
        for border in [left, right] {
            svg.polyline(border.iter().map(place), Stroke::new(Color::GRID, 0.6), "");
        }
    }
    for corners in &picture.others {
        svg.shape(corners.iter().map(place), Color::OTHER);
    }
    if let Some(corners) = &picture.own {
        svg.shape(corners.iter().map(place), Color::B);
    }
    svg.polyline(
        picture.path.iter().map(place),
        Stroke::new(Color::A, 1.6),
        "",
    );
    if let Some(last) = picture.path.last() {
        svg.circle(place(last), 2.5, Color::A, true, "");
    }
    if let Some(hit) = &picture.hit_at {
        svg.circle(place(hit), 4.0, Color::BAD, true, "first contact");
    }
    svg.finish("map", label)
}
