//! Charts as inline SVG: axes, lines, dots, bars.
//!
//! Colours are written into the SVG as for a light page; `style.css` maps the same values to others
//! in the dark, by attribute.

use anyhow::anyhow;
use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint, Ranged};
use plotters::prelude::*;

/// Width of every chart in its own units; the page scales it.
pub(crate) const WIDTH: u32 = 1080;
const LABEL_WIDTH: u32 = 64;
const LABEL_HEIGHT: u32 = 40;

/// The colours of the report; `style.css` knows each of them.
pub(crate) mod color {
    use plotters::style::RGBColor;
    pub(crate) const MUTED: RGBColor = RGBColor(0x5F, 0x6B, 0x7A);
    pub(crate) const GRID: RGBColor = RGBColor(0xE3, 0xE8, 0xEE);
    pub(crate) const ROAD: RGBColor = RGBColor(0xEC, 0xEF, 0xF3);
    pub(crate) const A: RGBColor = RGBColor(0x25, 0x63, 0xEB);
    pub(crate) const B: RGBColor = RGBColor(0xE0, 0x6C, 0x00);
    pub(crate) const OTHER: RGBColor = RGBColor(0x8A, 0x94, 0xA3);
    pub(crate) const GOOD: RGBColor = RGBColor(0x1A, 0x9C, 0x5B);
    pub(crate) const WARN: RGBColor = RGBColor(0xE2, 0xB1, 0x04);
    pub(crate) const BAD: RGBColor = RGBColor(0xD2, 0x3B, 0x3B);
    pub(crate) const CALM: RGBColor = RGBColor(0x9C, 0xBF, 0xDD);
    pub(crate) const PALE: RGBColor = RGBColor(0xC9, 0xCF, 0xD6);
}

/// One axis: its range, where it is labelled and how.
pub(crate) struct Axis {
    /// What it shows, with its unit.
    pub(crate) name: &'static str,
    /// From, to.
    pub(crate) range: (f64, f64),
    /// Labelled values.
    pub(crate) ticks: Vec<f64>,
    /// The label of a value.
    pub(crate) label: fn(f64) -> String,
}

impl Axis {
    /// A linear axis that holds all `values`, and about `count` round labels.
    pub(crate) fn over(
        name: &'static str,
        values: impl Iterator<Item = f64>,
        count: usize,
    ) -> Self {
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for value in values.filter(|value| value.is_finite()) {
            low = low.min(value);
            high = high.max(value);
        }
        if low > high {
            (low, high) = (0.0, 1.0);
        }
        if high - low < 1e-9 {
            (low, high) = (low - 0.5, high + 0.5);
        }
        let margin = 0.06 * (high - low);
        Self::linear(name, (low - margin, high + margin), count)
    }

    /// A linear axis with this range and about `count` round labels.
    pub(crate) fn linear(name: &'static str, range: (f64, f64), count: usize) -> Self {
        Self {
            name,
            range,
            ticks: round_ticks(range, count),
            label: plain,
        }
    }

    /// Scenario time from 0 to `end_s`.
    pub(crate) fn time(end_s: f64) -> Self {
        // The last tick of a run is some milliseconds short of the whole second.
        let end_s = (end_s * 10.0).round() / 10.0;
        Self::linear("", (0.0, end_s.max(0.1)), 12)
    }

    /// A logarithmic axis: the range in powers of ten, and every power labelled.
    pub(crate) fn decades(
        name: &'static str,
        (low, high): (i32, i32),
        label: fn(f64) -> String,
    ) -> Self {
        let ticks = (low..=high).map(f64::from).collect();
        Self {
            name,
            range: (f64::from(low), f64::from(high)),
            ticks,
            label,
        }
    }
}

/// Values at 1, 2 or 5 times a power of ten within the range, about `count` of them.
pub(crate) fn round_ticks((low, high): (f64, f64), count: usize) -> Vec<f64> {
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

/// A number without needless zeros.
pub(crate) fn plain(value: f64) -> String {
    let text = format!("{value:.3}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" {
        "0".to_owned()
    } else {
        text.to_owned()
    }
}

/// How a series is drawn.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Style {
    /// A line, broken where a value is not a number.
    Line,
    /// A thin dashed line.
    Dashed,
    /// Dots.
    Dots,
}

/// One series of a chart.
pub(crate) struct Series {
    /// For the legend.
    pub(crate) name: String,
    /// Its colour.
    pub(crate) color: RGBColor,
    /// How it is drawn.
    pub(crate) style: Style,
    /// Its points.
    pub(crate) points: Vec<(f64, f64)>,
}

/// A filled rectangle or polygon.
pub(crate) struct Shape {
    /// Its colour.
    pub(crate) color: RGBColor,
    /// 0 to 1.
    pub(crate) opacity: f64,
    /// Its corners.
    pub(crate) corners: Vec<(f64, f64)>,
}

/// A chart.
pub(crate) struct Chart {
    /// Height in its own units.
    pub(crate) height: u32,
    /// Horizontal axis.
    pub(crate) x: Axis,
    /// Vertical axis.
    pub(crate) y: Axis,
    /// Shapes below the series.
    pub(crate) shapes: Vec<Shape>,
    /// The series.
    pub(crate) series: Vec<Series>,
    /// Vertical marks over the whole height: takeovers.
    pub(crate) marks: Vec<f64>,
    /// Whether grid lines are drawn.
    pub(crate) grid: bool,
}

impl Chart {
    /// A chart without content.
    pub(crate) fn new(height: u32, x: Axis, y: Axis) -> Self {
        let (shapes, series, marks) = (Vec::new(), Vec::new(), Vec::new());
        Self {
            height,
            x,
            y,
            shapes,
            series,
            marks,
            grid: true,
        }
    }

    /// Width of the plotting area over its height.
    pub(crate) fn aspect(height: u32) -> f64 {
        f64::from(WIDTH - LABEL_WIDTH - 30) / f64::from(height - LABEL_HEIGHT - 10)
    }

    /// The chart as an `<svg>` element.
    ///
    /// # Errors
    /// If the drawing library fails, which its SVG backend does not.
    pub(crate) fn to_svg(&self) -> anyhow::Result<String> {
        let mut svg = String::new();
        self.draw(&mut svg)
            .map_err(|error| anyhow!("drawing a chart: {error}"))?;
        Ok(svg)
    }

    fn draw(&self, svg: &mut String) -> Result<(), Box<dyn std::error::Error>> {
        let area = SVGBackend::with_string(svg, (WIDTH, self.height)).into_drawing_area();
        let coord = |axis: &Axis| Ticked {
            range: axis.range.0..axis.range.1,
            ticks: axis.ticks.clone(),
        };
        let mut context = ChartBuilder::on(&area)
            .margin_top(10)
            .margin_right(30)
            .set_label_area_size(LabelAreaPosition::Left, LABEL_WIDTH)
            .set_label_area_size(LabelAreaPosition::Bottom, LABEL_HEIGHT)
            .build_cartesian_2d(coord(&self.x), coord(&self.y))?;
        let text = ("sans-serif", 15).into_font().color(&color::MUTED);
        let mut mesh = context.configure_mesh();
        mesh.light_line_style(TRANSPARENT)
            .axis_style(color::PALE)
            .label_style(text.clone())
            .axis_desc_style(text)
            .x_labels(self.x.ticks.len().max(1))
            .y_labels(self.y.ticks.len().max(1))
            .y_desc(self.y.name)
            .x_desc(self.x.name);
        mesh.bold_line_style(if self.grid {
            color::GRID.to_rgba()
        } else {
            TRANSPARENT
        });
        mesh.x_label_formatter(&|value| (self.x.label)(*value))
            .y_label_formatter(&|value| (self.y.label)(*value))
            .draw()?;
        for shape in &self.shapes {
            let fill = shape.color.mix(shape.opacity).filled();
            context.draw_series([Polygon::new(shape.corners.clone(), fill)])?;
        }
        for series in &self.series {
            draw_series(&mut context, series)?;
        }
        for mark in &self.marks {
            let line = vec![(*mark, self.y.range.0), (*mark, self.y.range.1)];
            let style = color::BAD.stroke_width(1);
            context.draw_series(DashedLineSeries::new(line, 4, 4, style))?;
        }
        drop(context);
        area.present()?;
        Ok(())
    }
}

type Plane = Cartesian2d<Ticked, Ticked>;

/// A linear coordinate that is labelled where the axis says.
#[derive(Clone)]
struct Ticked {
    range: std::ops::Range<f64>,
    ticks: Vec<f64>,
}

impl Ranged for Ticked {
    type FormatOption = DefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, (from, to): (i32, i32)) -> i32 {
        let part = (value - self.range.start) / (self.range.end - self.range.start);
        from + (part * f64::from(to - from)).round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, _: Hint) -> Vec<f64> {
        self.ticks.clone()
    }

    fn range(&self) -> std::ops::Range<f64> {
        self.range.clone()
    }
}

fn draw_series(
    context: &mut ChartContext<'_, SVGBackend<'_>, Plane>,
    series: &Series,
) -> Result<(), Box<dyn std::error::Error>> {
    let pieces = series.points.split(|point| !point.1.is_finite());
    match series.style {
        Style::Line => {
            let style = series.color.stroke_width(2);
            for piece in pieces.filter(|piece| piece.len() > 1) {
                context.draw_series(LineSeries::new(piece.iter().copied(), style))?;
            }
        }
        Style::Dashed => {
            let style = series.color.stroke_width(1);
            for piece in pieces.filter(|piece| piece.len() > 1) {
                context.draw_series(DashedLineSeries::new(piece.iter().copied(), 6, 4, style))?;
            }
        }
        Style::Dots => {
            let fill = series.color.filled();
            let dots = pieces.flatten().map(|point| Circle::new(*point, 2, fill));
            context.draw_series(dots)?;
        }
    }
    Ok(())
}

/// At most about `limit` points that keep the extremes of every part, so that a peak is never lost.
pub(crate) fn thin(points: &[(f64, f64)], limit: usize) -> Vec<(f64, f64)> {
    if points.len() <= limit {
        return points.to_vec();
    }
    let part = (2 * points.len()).div_ceil(limit);
    points
        .chunks(part)
        .flat_map(|chunk| {
            let by_value = |a: &&(f64, f64), b: &&(f64, f64)| a.1.total_cmp(&b.1);
            let mut ends: Vec<(f64, f64)> = chunk
                .iter()
                .min_by(by_value)
                .into_iter()
                .chain(chunk.iter().max_by(by_value))
                .copied()
                .collect();
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
        assert!(
            round_ticks((-0.13, 0.12), 5)
                .iter()
                .all(|tick| (-0.13..=0.12).contains(tick))
        );
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
    fn numbers_are_written_without_needless_zeros() {
        assert_eq!([plain(5.0), plain(-0.0), plain(0.25)], ["5", "0", "0.25"]);
    }

    #[test]
    fn a_value_that_is_not_a_number_breaks_the_line_and_nothing_else() {
        let mut chart = Chart::new(200, Axis::time(3.0), Axis::linear("m", (0.0, 1.0), 5));
        let points = vec![
            (0.0, 0.0),
            (1.0, 0.5),
            (1.5, f64::NAN),
            (2.0, 0.5),
            (3.0, 1.0),
        ];
        let name = "x".to_owned();
        chart.series.push(Series {
            name,
            color: color::A,
            style: Style::Line,
            points,
        });
        let svg = chart.to_svg().unwrap();
        assert!(!svg.contains("NaN"));
        assert_eq!(svg.matches("stroke=\"#2563EB\"").count(), 2);
    }
}
