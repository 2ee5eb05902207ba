//! Percentile curves of a group in one picture, each named at its end.

use super::scale::{Scale, spread};
use crate::family::Family;
use crate::result::Row;
use maud::{Markup, html};
use std::fmt::Write as _;

const WIDTH: f64 = 1080.0;
const LEFT: f64 = 68.0;
/// Where the curves end and their names begin.
const RIGHT: f64 = 850.0;
const TOP: f64 = 14.0;
/// Below the plot: labels of the axis.
const FOOT: f64 = 44.0;
/// Height of a name.
const NAME: f64 = 18.0;
/// The lowest plot.
const LOWEST: f64 = 320.0;

/// The axis of percentiles: powers of ten of 1 / (1 - q), from the median on.
const MEDIAN: f64 = std::f64::consts::LOG10_2;
const PERCENTILES: [(f64, &str); 7] = [
    (MEDIAN, "50 %"),
    (1.0, "90 %"),
    (2.0, "99 %"),
    (3.0, "99.9 %"),
    (4.0, "99.99 %"),
    (5.0, "99.999 %"),
    (6.0, "99.9999 %"),
];

/// A curve in powers of ten of 1 / (1 - q) and ns, from the median on.
struct Curve<'a> {
    row: &'a Row,
    points: Vec<(f64, f64)>,
}

impl<'a> Curve<'a> {
    /// `None` if there are too few samples for one.
    fn of(row: &'a Row) -> Option<Self> {
        let rarer = |(quantile, ns): &(f64, f64)| (-(1.0 - quantile).log10(), *ns);
        let beyond = row
            .curve
            .iter()
            .map(rarer)
            .filter(|(nines, _)| *nines > MEDIAN);
        let points: Vec<(f64, f64)> = std::iter::once((MEDIAN, row.p50_ns))
            .chain(beyond)
            .collect();
        (points.len() > 1).then_some(Self { row, points })
    }

    fn end(&self) -> (f64, f64) {
        self.points
            .last()
            .copied()
            .unwrap_or((MEDIAN, self.row.p50_ns))
    }
}

/// The picture; `None` if no case has a curve.
pub(super) fn svg(rows: &[&Row]) -> Option<Markup> {
    let mut curves: Vec<Curve<'_>> = rows.iter().filter_map(|row| Curve::of(row)).collect();
    let first = first_of_tandem(rows);
    // What matters most is drawn last, above the others.
    curves.sort_by_key(|curve| match Family::of(curve.row) {
        _ if Some(curve.row.name.as_str()) == first => 3,
        Family::Tandem => 2,
        Family::Floor => 1,
        _ => 0,
    });
    let height = LOWEST.max(NAME * curves.len() as f64);
    let bottom = TOP + height;
    let values = curves
        .iter()
        .flat_map(|curve| curve.points.iter().map(|point| point.1));
    let y = Scale::over(values, bottom, TOP)?;
    let rarest = curves.iter().map(|curve| curve.end().0).fold(1.0, f64::max);
    let x = |nines: f64| LEFT + (nines - MEDIAN) / (rarest - MEDIAN) * (RIGHT - LEFT);
    let ends: Vec<f64> = curves.iter().map(|curve| y.at(curve.end().1)).collect();
    let names = spread(&ends, NAME, (TOP + 4.0, bottom - 2.0));
    let ticks = PERCENTILES
        .into_iter()
        .filter(|(nines, _)| *nines <= rarest + 1e-9);
    Some(html! {
        svg viewBox=(format!("0 0 {WIDTH} {}", bottom + FOOT)) role="img"
            aria-label="Percentile curves" {
            @for tick in y.ticks() {
                line.grid x1=(LEFT) x2=(RIGHT) y1=(at(y.at(tick))) y2=(at(y.at(tick))) {}
                text.tick x=(LEFT - 8.0) y=(at(y.at(tick) + 4.5)) text-anchor="end" {
                    (tick_label(tick))
                }
            }
            @for (nines, label) in ticks {
                line.grid x1=(at(x(nines))) x2=(at(x(nines))) y1=(TOP) y2=(bottom) {}
                text.tick x=(at(x(nines))) y=(bottom + 18.0) text-anchor="middle" { (label) }
            }
            text.tick x=(LEFT) y=(bottom + 38.0) {
                "this share took no longer →"
            }
            @for (curve, name) in curves.iter().zip(&names) {
                @let main = Some(curve.row.name.as_str()) == first;
                @let class = class_of(curve.row, main);
                (drawn(curve, &class, &x, &y, *name))
            }
        }
    })
}

/// The case that stands for Tandem.
pub(super) fn first_of_tandem<'a>(rows: &[&'a Row]) -> Option<&'a str> {
    let first = rows.iter().find(|row| Family::of(row) == Family::Tandem);
    first.map(|row| row.name.as_str())
}

fn class_of(row: &Row, main: bool) -> String {
    let family = Family::of(row).class();
    if main {
        format!("curve {family} main")
    } else {
        format!("curve {family}")
    }
}

/// A curve, its name, and a thin line from its end to the name.
fn drawn(curve: &Curve<'_>, class: &str, x: &impl Fn(f64) -> f64, y: &Scale, name: f64) -> Markup {
    let mut path = String::new();
    for (i, (nines, ns)) in curve.points.iter().enumerate() {
        let command = if i == 0 { 'M' } else { 'L' };
        // Writing to a string cannot fail.
        let _ = write!(path, "{command}{:.1} {:.1}", x(*nines), y.at(*ns));
    }
    let (nines, ns) = curve.end();
    let (end_x, end_y) = (x(nines), y.at(ns));
    let leader = format!(
        "M{end_x:.1} {end_y:.1}L{:.1} {name:.1}L{:.1} {name:.1}",
        RIGHT + 22.0,
        RIGHT + 28.0
    );
    html! {
        g class=(class) {
            path.leader d=(leader) {}
            path.line d=(path) { title { (curve.row.name) ": " (curve.row.what) } }
            circle cx=(at(end_x)) cy=(at(end_y)) r="2.5" {}
            text x=(RIGHT + 33.0) y=(at(name + 4.5)) { (curve.row.case()) }
        }
    }
}

/// A coordinate with as many digits as a screen shows.
pub(super) fn at(place: f64) -> String {
    format!("{place:.1}")
}

/// A round time: `200 ns`, `10 µs`.
fn tick_label(ns: f64) -> String {
    let (value, unit) = match ns {
        ns if ns < 999.0 => (ns, "ns"),
        ns if ns < 999e3 => (ns / 1e3, "µs"),
        ns if ns < 999e6 => (ns / 1e6, "ms"),
        ns => (ns / 1e9, "s"),
    };
    // Powers of ten below 1 are not exact.
    format!("{} {unit}", (value * 1000.0).round() / 1000.0)
}
