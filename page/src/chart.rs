//! Charts: two axes, and lines, dots and shapes between them.
//!
//! A logarithmic axis is a linear axis whose values are base-10 logarithms.

use maud::Markup;

use crate::svg::{Anchor, Color, Place, Stroke, Svg};

/// Width of every chart in its own units; the page scales it.
pub const WIDTH: f64 = 1080.0;
const LEFT: f64 = 70.0;
const RIGHT: f64 = 30.0;
/// Room at the right for the names of curves.
const NAMES: f64 = 230.0;
const TOP: f64 = 10.0;
const BOTTOM: f64 = 40.0;
/// Height of a name.
const NAME: f64 = 18.0;

/// One axis: its range and its labels.
#[derive(Clone, Debug)]
pub struct Axis {
    /// Quantity on this axis, with its unit.
    pub name: &'static str,
    /// From, to.
    pub range: (f64, f64),
    /// Labelled values.
    pub ticks: Vec<f64>,
    /// Returns the label of a value.
    pub label: fn(f64) -> String,
    /// What its values mean.
    pub scale: AxisScale,
}

/// What the values of an axis mean.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AxisScale {
    /// The quantity itself.
    Linear,
    /// Scenario time, s.
    Time,
    /// The base-10 logarithm of the quantity.
    Decades,
    /// The number of nines of a percentile.
    Nines,
}

impl Axis {
    /// A linear axis that covers all `values` and has about `count` round labels.
    pub fn over(name: &'static str, values: impl Iterator<Item = f64>, count: usize) -> Self {
        let (mut low, mut high) = bounds(values).unwrap_or((0.0, 1.0));
        if high - low < 1e-9 {
            (low, high) = (low - 0.5, high + 0.5);
        }
        let margin = 0.06 * (high - low);
        Self::linear(name, (low - margin, high + margin), count)
    }

    /// A linear axis with this range and about `count` round labels.
    #[must_use]
    pub fn linear(name: &'static str, range: (f64, f64), count: usize) -> Self {
        Self {
            name,
            range,
            ticks: round_ticks(range, count),
            label: plain,
            scale: AxisScale::Linear,
        }
    }

    /// Scenario time from 0 to `end_s`.
    #[must_use]
    pub fn time(end_s: f64) -> Self {
        // The last step of a run is a few milliseconds before a whole second.
        let end_s = (end_s * 10.0).round() / 10.0;
        Self::times((0.0, end_s.max(0.1)))
    }

    /// Scenario time in this span, s.
    #[must_use]
    pub fn times(span_s: (f64, f64)) -> Self {
        Self {
            scale: AxisScale::Time,
            ..Self::linear("", span_s, 12)
        }
    }

    /// A percentile by its number of nines, from 0 to `rarest`.
    #[must_use]
    pub fn nines(rarest: i32) -> Self {
        Self {
            scale: AxisScale::Nines,
            ..Self::decades("percentile", (0, rarest), percentile)
        }
    }

    /// An axis of rows. Row 0 is at the bottom and reaches from 0 to 1.
    #[must_use]
    pub fn rows(count: u8, label: fn(f64) -> String) -> Self {
        Self {
            name: "",
            range: (0.0, f64::from(count)),
            ticks: (0..count).map(|row| f64::from(row) + 0.5).collect(),
            label,
            scale: AxisScale::Linear,
        }
    }

    /// A logarithmic axis: the range in powers of ten, and every power labelled.
    #[must_use]
    pub fn decades(name: &'static str, (low, high): (i32, i32), label: fn(f64) -> String) -> Self {
        Self {
            name,
            range: (f64::from(low), f64::from(high)),
            ticks: (low..=high).map(f64::from).collect(),
            label,
            scale: AxisScale::Decades,
        }
    }

    /// A logarithmic axis that covers these powers of ten, with a margin; `None` without powers. A
    /// short range has labels at 1, 2 and 5 times each power.
    pub fn powers(
        name: &'static str,
        powers: impl Iterator<Item = f64>,
        label: fn(f64) -> String,
    ) -> Option<Self> {
        let (low, high) = bounds(powers)?;
        let margin = (0.04 * (high - low)).max(0.05);
        let (low, high) = (low - margin, high + margin);
        let steps: &[f64] = if high - low > 2.6 {
            &[1.0]
        } else {
            &[1.0, 2.0, 5.0]
        };
        let powers = low.floor() as i32..=high.ceil() as i32;
        let ticks =
            powers.flat_map(|power| steps.iter().map(move |s| s.log10() + f64::from(power)));
        Some(Self {
            name,
            range: (low, high),
            ticks: ticks.filter(|tick| (low..=high).contains(tick)).collect(),
            label,
            scale: AxisScale::Decades,
        })
    }

    /// Position of a value between two ends; a value outside the range is at the nearer end.
    #[must_use]
    pub fn at(&self, value: f64, (from, to): (f64, f64)) -> f64 {
        let (low, high) = self.range;
        from + (value.clamp(low, high) - low) / (high - low) * (to - from)
    }
}

fn bounds(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    values
        .filter(|value| value.is_finite())
        .fold(None, |bounds, value| {
            let (low, high) = bounds.unwrap_or((value, value));
            Some((value.min(low), value.max(high)))
        })
}

/// Returns about `count` values in the range: the multiples of 1, 2 or 5 times a power of ten.
#[must_use]
pub fn round_ticks((low, high): (f64, f64), count: usize) -> Vec<f64> {
    let rough = (high - low) / count.max(1) as f64;
    let power = 10.0_f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .map(|factor| factor * power)
        .find(|step| *step >= rough)
        .unwrap_or(rough);
    let first = (low / step).ceil() as i64;
    let last = (high / step).floor() as i64;
    (first..=last).map(|n| n as f64 * step).collect()
}

/// Returns a number without trailing zeros.
#[must_use]
pub fn plain(value: f64) -> String {
    let text = format!("{value:.3}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" {
        "0".to_owned()
    } else {
        text.to_owned()
    }
}

/// Returns the label of a power of ten as a number: 2 → "100".
#[must_use]
pub fn power(power: f64) -> String {
    plain(10.0_f64.powf(power))
}

/// The label of a percentile given by its number of nines: 0 → "0 %", 1 → "90 %", 3 → "99.9 %".
#[must_use]
pub fn percentile(nines: f64) -> String {
    let digits = (nines.round() as usize).saturating_sub(2);
    format!("{:.*} %", digits, 100.0 - 10.0_f64.powf(2.0 - nines))
}

/// How a series is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Style {
    /// A line of this width, broken where a value is not a number.
    Line(f64),
    /// A line of this width with these dashes.
    Dashed(f64, &'static str),
    /// Dots.
    Dots,
}

/// One series of a chart.
#[derive(Clone, Debug)]
pub struct Series {
    /// Name in the legend, or beside the end of the curve.
    pub name: String,
    /// Text of the tooltip.
    pub title: String,
    /// Its colour.
    pub color: Color,
    /// How it is drawn.
    pub style: Style,
    /// Its points.
    pub points: Vec<(f64, f64)>,
}

/// A filled polygon.
#[derive(Clone, Debug)]
pub struct Polygon {
    /// What it shows: the text of its tooltip, or empty.
    pub name: &'static str,
    /// Its colour.
    pub color: Color,
    /// Its corners.
    pub corners: Vec<(f64, f64)>,
}

impl Polygon {
    /// A bar in a row of [`Axis::rows`], for a state that lasted for this span.
    #[must_use]
    pub fn bar(name: &'static str, color: Color, (from, to): (f64, f64), row: u8) -> Self {
        let (low, high) = (f64::from(row) + 0.14, f64::from(row) + 0.86);
        Self {
            name,
            color,
            corners: vec![(from, low), (to, low), (to, high), (from, high)],
        }
    }
}

/// A chart.
#[derive(Clone, Debug)]
pub struct Chart {
    /// Height in its own units.
    pub height: f64,
    /// Horizontal axis.
    pub x: Axis,
    /// Vertical axis.
    pub y: Axis,
    /// Shapes below the series.
    pub shapes: Vec<Polygon>,
    /// The series.
    pub series: Vec<Series>,
    /// Positions of vertical marks over the whole height, for takeovers.
    pub marks: Vec<f64>,
    /// Whether grid lines are drawn.
    pub grid: bool,
    /// Whether each curve has its name at its end.
    pub names: bool,
}

impl Chart {
    /// A chart without content.
    #[must_use]
    pub const fn new(height: f64, x: Axis, y: Axis) -> Self {
        Self {
            height,
            x,
            y,
            shapes: Vec::new(),
            series: Vec::new(),
            marks: Vec::new(),
            grid: true,
            names: false,
        }
    }

    /// Returns the ratio of the plotting area's width to its height.
    #[must_use]
    pub fn aspect(height: f64) -> f64 {
        (WIDTH - LEFT - RIGHT) / (height - TOP - BOTTOM)
    }

    fn right(&self) -> f64 {
        WIDTH - if self.names { NAMES } else { RIGHT }
    }

    fn bottom(&self) -> f64 {
        self.height - BOTTOM
    }

    fn place(&self, (x, y): (f64, f64)) -> Place {
        (
            self.x.at(x, (LEFT, self.right())),
            self.y.at(y, (self.bottom(), TOP)),
        )
    }

    /// Returns the chart as an `<svg>` element; `label` says what it shows.
    #[must_use]
    pub fn svg(&self, label: &str) -> Markup {
        let mut svg = Svg::new(WIDTH, self.height);
        self.draw_axes(&mut svg);
        for shape in &self.shapes {
            let corners = shape.corners.iter().map(|corner| self.place(*corner));
            svg.titled_shape(corners, shape.color, shape.name);
        }
        for series in &self.series {
            self.draw_series(&mut svg, series);
        }
        for mark in &self.marks {
            let (x, _) = self.place((*mark, 0.0));
            let stroke = Stroke::new(Color::BAD, 1.0).dashed("4 4");
            svg.line((x, TOP), (x, self.bottom()), stroke);
        }
        if self.names {
            self.draw_names(&mut svg);
        }
        svg.finish("chart", label)
    }

    fn draw_axes(&self, svg: &mut Svg) {
        let (right, bottom) = (self.right(), self.bottom());
        let (grid, axis) = (Stroke::new(Color::GRID, 1.0), Stroke::new(Color::PALE, 1.0));
        for tick in &self.y.ticks {
            let (_, y) = self.place((0.0, *tick));
            if self.grid {
                svg.line((LEFT, y), (right, y), grid);
            }
            let label = (self.y.label)(*tick);
            svg.text((LEFT - 8.0, y + 4.5), Anchor::End, Color::MUTED, &label);
        }
        for tick in &self.x.ticks {
            let (x, _) = self.place((*tick, 0.0));
            if self.grid {
                svg.line((x, TOP), (x, bottom), grid);
            }
            let (place, label) = ((x, bottom + 18.0), (self.x.label)(*tick));
            svg.text(place, Anchor::Middle, Color::MUTED, &label);
        }
        svg.line((LEFT, TOP), (LEFT, bottom), axis);
        svg.line((LEFT, bottom), (right, bottom), axis);
        let middle = (f64::midpoint(LEFT, right), bottom + 36.0);
        svg.text(middle, Anchor::Middle, Color::MUTED, self.x.name);
        svg.text((4.0, TOP + 5.0), Anchor::Start, Color::MUTED, self.y.name);
    }

    fn draw_series(&self, svg: &mut Svg, series: &Series) {
        let pieces = series.points.split(|point| !point.1.is_finite());
        let stroke = match series.style {
            Style::Dots => {
                let dots = pieces.flatten().map(|point| self.place(*point));
                return svg.dots(dots, 2.0, series.color);
            }
            Style::Line(width) => Stroke::new(series.color, width),
            Style::Dashed(width, dashes) => Stroke::new(series.color, width).dashed(dashes),
        };
        for piece in pieces.filter(|piece| piece.len() > 1) {
            let points = piece.iter().map(|point| self.place(*point));
            svg.polyline(points, stroke, &series.title);
        }
    }

    /// Writes each curve's name beside its end, with a thin line between them.
    fn draw_names(&self, svg: &mut Svg) {
        let named = self
            .series
            .iter()
            .filter_map(|series| Some((series, self.place(*series.points.last()?))));
        let named: Vec<(&Series, Place)> = named.collect();
        let ends: Vec<f64> = named.iter().map(|(_, (_, y))| *y).collect();
        let names = spread(&ends, NAME, (TOP + 4.0, self.bottom() - 2.0));
        let right = self.right();
        for ((series, end), y) in named.into_iter().zip(names) {
            let leader = [end, (right + 22.0, y), (right + 28.0, y)];
            let stroke = Stroke::new(series.color, 0.8).dashed("1.5 3");
            svg.polyline(leader.into_iter(), stroke, "");
            svg.circle(end, 2.5, series.color, false, "");
            let place = (right + 33.0, y + 4.5);
            svg.text(place, Anchor::Start, series.color, &series.name);
        }
    }
}

/// Moves positions apart until no two are closer than `gap`. They stay within the range if they
/// fit.
fn spread(places: &[f64], gap: f64, (top, bottom): (f64, f64)) -> Vec<f64> {
    let mut order: Vec<usize> = (0..places.len()).collect();
    order.sort_by(|i, j| places[*i].total_cmp(&places[*j]));
    let mut spread = places.to_vec();
    let mut next = top;
    for place in &order {
        spread[*place] = spread[*place].max(next);
        next = spread[*place] + gap;
    }
    let mut next = bottom;
    for place in order.iter().rev() {
        spread[*place] = spread[*place].min(next);
        next = spread[*place] - gap;
    }
    spread
}

/// Reduces points to about `limit`: the minimum and maximum of every part, so no peak is lost.
#[must_use]
pub fn thin(points: &[(f64, f64)], limit: usize) -> Vec<(f64, f64)> {
    if points.len() <= limit {
        return points.to_vec();
    }
    let part = (2 * points.len()).div_ceil(limit);
    points
        .chunks(part)
        .flat_map(|chunk| {
            let by_value = |a: &&(f64, f64), b: &&(f64, f64)| a.1.total_cmp(&b.1);
            let lowest = chunk.iter().min_by(by_value);
            let highest = chunk.iter().max_by(by_value);
            let mut ends: Vec<(f64, f64)> = lowest.into_iter().chain(highest).copied().collect();
            ends.sort_by(|a, b| a.0.total_cmp(&b.0));
            ends
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_within_the_range() {
        let ticks = round_ticks((0.0, 60.0), 12);
        assert_eq!(ticks.first(), Some(&0.0));
        assert_eq!(ticks.last(), Some(&60.0));
        assert!((6..=14).contains(&ticks.len()), "{ticks:?}");
        let ticks = round_ticks((-0.13, 0.12), 5);
        assert!(ticks.iter().all(|tick| (-0.13..=0.12).contains(tick)));
    }

    #[test]
    fn a_logarithmic_axis_is_labelled_at_round_values_and_not_too_often() {
        let labels = |low: f64, high: f64| -> Vec<String> {
            let axis = Axis::powers("", [low.log10(), high.log10()].into_iter(), power).unwrap();
            axis.ticks.iter().map(|tick| (axis.label)(*tick)).collect()
        };
        assert_eq!(labels(80.0, 900.0), ["100", "200", "500", "1000"]);
        assert_eq!(labels(1.1, 90_000.0).len(), 6);
        assert!(Axis::powers("", [f64::NAN].into_iter(), power).is_none());
    }

    #[test]
    fn thinning_keeps_the_peak() {
        let mut points: Vec<(f64, f64)> = (0..10_000).map(|i| (f64::from(i), 1.0)).collect();
        points[4_321].1 = 99.0;
        let thinned = thin(&points, 500);
        assert!(thinned.len() <= 520);
        assert!(thinned.contains(&(4_321.0, 99.0)));
    }

    #[test]
    fn labels_are_written_as_people_write_them() {
        assert_eq!([plain(5.0), plain(-0.0), plain(0.25)], ["5", "0", "0.25"]);
        let labels: Vec<String> = (0..5).map(|n| percentile(f64::from(n))).collect();
        assert_eq!(labels, ["0 %", "90 %", "99 %", "99.9 %", "99.99 %"]);
    }

    fn series(name: &str, points: Vec<(f64, f64)>) -> Series {
        Series {
            name: name.to_owned(),
            title: String::new(),
            color: Color::A,
            style: Style::Line(2.0),
            points,
        }
    }

    #[test]
    fn a_value_that_is_not_a_number_breaks_the_line_and_nothing_else() {
        let mut chart = Chart::new(200.0, Axis::time(3.0), Axis::linear("m", (0.0, 1.0), 5));
        let points = [
            (0.0, 0.0),
            (1.0, 0.5),
            (1.5, f64::NAN),
            (2.0, 0.5),
            (3.0, 1.0),
        ];
        chart.series.push(series("x", points.to_vec()));
        let svg = chart.svg("").into_string();
        assert!(!svg.contains("NaN"));
        assert_eq!(svg.matches("style=\"stroke:var(--a)\"").count(), 2);
    }

    #[test]
    fn each_curve_is_named_at_its_end_and_no_name_hides_another() {
        let mut chart = Chart::new(320.0, Axis::time(3.0), Axis::linear("m", (0.0, 1.0), 5));
        chart.names = true;
        for n in 0..12 {
            let end = 0.5 + 0.001 * f64::from(n);
            chart
                .series
                .push(series(&format!("curve {n}"), vec![(0.0, 0.0), (3.0, end)]));
        }
        let svg = chart.svg("").into_string();
        let picture = roxmltree::Document::parse(&svg).unwrap();
        let names = picture.descendants().filter(|node| {
            let text = node.text().unwrap_or_default();
            node.has_tag_name("text") && text.starts_with("curve")
        });
        let mut places: Vec<f64> = names
            .map(|name| name.attribute("y").unwrap().parse().unwrap())
            .collect();
        places.sort_by(f64::total_cmp);
        assert_eq!(places.len(), 12);
        assert!(places.windows(2).all(|pair| pair[1] - pair[0] > 15.0));
    }
}
