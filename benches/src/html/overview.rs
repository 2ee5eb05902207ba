//! All groups in one picture: how far each case lies above its floor.

use super::curves::{at, first_of_tandem};
use super::scale::Scale;
use crate::family::{Family, Headline};
use crate::figures;
use crate::result::Row;
use maud::{Markup, html};

const WIDTH: f64 = 1080.0;
const LEFT: f64 = 190.0;
const RIGHT: f64 = 1055.0;
const TOP: f64 = 8.0;
/// Height of a group: its dots, one name above and one below.
const GROUP: f64 = 54.0;
/// Ratios that are told apart; what lies beyond stands at the edge, with its figure.
const SHOWN: (f64, f64) = (0.25, 20.0);
/// Half the width of a name, about.
const HALF_NAME: f64 = 90.0;

/// The picture; `None` if no group has a floor.
pub(super) fn svg(groups: &[(&str, Vec<&Row>)]) -> Option<Markup> {
    let ratio = |row: &&Row| row.ratio_to_floor_p50;
    let with_floor = |group: &&(&str, Vec<&Row>)| group.1.iter().any(|row| row.is_floor());
    let groups: Vec<&(&str, Vec<&Row>)> = groups.iter().filter(with_floor).collect();
    let ratios = groups
        .iter()
        .flat_map(|(_, rows)| rows.iter().filter_map(ratio));
    let x = Scale::within(ratios, SHOWN, LEFT, RIGHT)?;
    let bottom = TOP + GROUP * groups.len() as f64;
    Some(html! {
        svg viewBox=(format!("0 0 {WIDTH} {}", bottom + 26.0)) role="img"
            aria-label="Median of each case over the median of its floor" {
            @for tick in x.ticks() {
                line.grid x1=(at(x.at(tick))) x2=(at(x.at(tick))) y1=(TOP) y2=(bottom) {}
                text.tick x=(at(x.at(tick))) y=(bottom + 18.0) text-anchor="middle" {
                    (round(tick)) "×"
                }
            }
            line.one x1=(at(x.at(1.0))) x2=(at(x.at(1.0))) y1=(TOP) y2=(bottom) {}
            @for (i, (name, rows)) in groups.iter().enumerate() {
                (group(name, rows, TOP + GROUP * (i as f64 + 0.5), &x))
            }
        }
    })
}

fn group(name: &str, rows: &[&Row], y: f64, x: &Scale) -> Markup {
    let mut dots: Vec<&&Row> = rows.iter().collect();
    // Tandem above the others.
    dots.sort_by_key(|row| Family::of(row) == Family::Tandem);
    let first = first_of_tandem(rows);
    let peer = Headline::of(rows).and_then(|headline| headline.peer);
    html! {
        text.group x=(LEFT - 14.0) y=(at(y + 5.0)) text-anchor="end" {
            (super::prose::about(name).title)
        }
        line.row x1=(LEFT) x2=(RIGHT) y1=(at(y)) y2=(at(y)) {}
        @for row in dots {
            @if let Some(ratio) = row.ratio_to_floor_p50 {
                @let main = first == Some(row.name.as_str());
                g class=(format!("dot {}", Family::of(row).class())) {
                    (mark(row, ratio, x, y, if main { 7.0 } else { 4.5 }))
                    @if main { (named(row, ratio, x, y - 12.0)) }
                    @if peer.is_some_and(|peer| peer.name == row.name) {
                        (named(row, ratio, x, y + 20.0))
                    }
                }
            }
        }
    }
}

/// A dot where the ratio stands, or an arrow at the edge beyond which it lies.
fn mark(row: &Row, ratio: f64, x: &Scale, y: f64, radius: f64) -> Markup {
    let place = x.at(ratio);
    let size = radius + 1.5;
    let title = format!("{}: {}×", row.name, figures::ratio(ratio));
    if x.holds(ratio) {
        return html! { circle cx=(at(place)) cy=(at(y)) r=(radius) { title { (title) } } };
    }
    let tip = place + (1.6 * size).copysign(ratio.ln());
    let (above, below) = (y - size, y + size);
    let arrow = format!("M{tip:.1} {y:.1}L{place:.1} {above:.1}L{place:.1} {below:.1}Z");
    html! { path.arrow d=(arrow) { title { (title) } } }
}

/// A name beside its dot, kept within the picture.
fn named(row: &Row, ratio: f64, x: &Scale, y: f64) -> Markup {
    let place = x.at(ratio).clamp(LEFT + HALF_NAME, RIGHT - HALF_NAME);
    html! {
        text x=(at(place)) y=(at(y)) text-anchor="middle" {
            (row.case()) " " (figures::ratio(ratio)) "×"
        }
    }
}

/// A round ratio without needless zeros.
fn round(tick: f64) -> String {
    format!("{}", (tick * 1e6).round() / 1e6)
}
