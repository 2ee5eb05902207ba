//! Plots that a reader can zoom, with the values under the pointer: a [`Chart`] as data, which the
//! script of the page draws by uPlot. A page without scripts shows a chart as [`Chart::svg`].

use maud::{Markup, PreEscaped, html};
use serde::Serialize;

use crate::chart::{Axis, AxisScale, Chart, Style};

/// The script of a page with plots: uPlot (page/uplot), and what draws the plots by it.
pub const SCRIPT: &[&str] = &[
    include_str!("../uplot/uPlot.iife.min.js"),
    include_str!("plots.js"),
];
/// The style of a page with plots, beside [`crate::STYLE`].
pub const STYLE: &[&str] = &[
    include_str!("../uplot/uPlot.min.css"),
    include_str!("plots.css"),
];
/// The horizontal values have this many digits after the point: a time in s is exact to 1 µs.
const X_DIGITS: i32 = 6;
/// The vertical values have this many steps over the whole axis, a power of ten.
const Y_STEPS: f64 = 1e5;

/// A chart as the script of the page reads it, as JSON.
#[derive(Debug, Serialize)]
pub struct Plot<'a> {
    title: &'a str,
    height: f64,
    x: PlotAxis,
    y: PlotAxis,
    marks: &'a [f64],
    spans: Vec<Span<'a>>,
    series: Vec<PlotSeries<'a>>,
}

#[derive(Debug, Serialize)]
struct PlotAxis {
    name: &'static str,
    range: (f64, f64),
    ticks: Vec<(f64, String)>,
    scale: &'static str,
}

/// A bar of a state.
#[derive(Debug, Serialize)]
struct Span<'a> {
    name: &'a str,
    color: &'static str,
    from: f64,
    to: f64,
    low: f64,
    high: f64,
}

#[derive(Debug, Serialize)]
struct PlotSeries<'a> {
    name: &'a str,
    color: &'static str,
    /// `line`, `dashed` or `dots`.
    style: &'static str,
    width: f64,
    x: Vec<f64>,
    /// Null breaks the line.
    y: Vec<f64>,
}

impl From<&Axis> for PlotAxis {
    fn from(axis: &Axis) -> Self {
        let label = |tick: &f64| (*tick, (axis.label)(*tick));
        Self {
            name: axis.name,
            range: axis.range,
            ticks: axis.ticks.iter().map(label).collect(),
            scale: match axis.scale {
                AxisScale::Linear => "linear",
                AxisScale::Time => "time",
                AxisScale::Decades => "decades",
                AxisScale::Nines => "nines",
            },
        }
    }
}

impl Chart {
    /// Returns the chart as data for the script of the page; `title` says what it shows.
    #[must_use]
    pub fn data<'a>(&'a self, title: &'a str) -> Plot<'a> {
        let x_step = 10_f64.powi(-X_DIGITS);
        let (low, high) = self.y.range;
        let y_step = 10_f64.powf(((high - low) / Y_STEPS).log10().floor());
        let spans = self.shapes.iter().filter_map(|shape| {
            let (xs, ys) = (
                shape.corners.iter().map(|it| it.0),
                shape.corners.iter().map(|it| it.1),
            );
            Some(Span {
                name: shape.name,
                color: shape.color.name(),
                from: xs.clone().reduce(f64::min)?,
                to: xs.reduce(f64::max)?,
                low: ys.clone().reduce(f64::min)?,
                high: ys.reduce(f64::max)?,
            })
        });
        let series = self.series.iter().map(|series| {
            let (style, width) = match series.style {
                Style::Line(width) => ("line", width),
                Style::Dashed(width, _) => ("dashed", width),
                Style::Dots => ("dots", 0.0),
            };
            PlotSeries {
                name: &series.name,
                color: series.color.name(),
                style,
                width,
                x: { series.points.iter() }
                    .map(|point| rounded(point.0, x_step))
                    .collect(),
                y: { series.points.iter() }
                    .map(|point| rounded(point.1, y_step))
                    .collect(),
            }
        });
        Plot {
            title,
            height: self.height,
            x: (&self.x).into(),
            y: (&self.y).into(),
            marks: &self.marks,
            spans: spans.collect(),
            series: series.collect(),
        }
    }

    /// Returns the chart as an element that the script of the page makes a plot of.
    #[must_use]
    pub fn plot(&self, title: &str) -> Markup {
        // No text of a run may end the element.
        let data = serde_json::to_string(&self.data(title)).unwrap_or_default();
        let data = data.replace('<', "\\u003c");
        html! {
            div.plot role="img" aria-label=(title) style=(format!("min-height:{:.0}px", self.height)) {
                script type="application/json" { (PreEscaped(data)) }
            }
        }
    }
}

/// Returns a multiple of a power of ten, without the noise of binary fractions.
fn rounded(value: f64, step: f64) -> f64 {
    let digits = (-step.log10()).round().clamp(0.0, 12.0) as usize;
    format!("{value:.digits$}").parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chart::{Polygon, Series};
    use crate::svg::Color;

    #[test]
    fn a_plot_has_the_values_of_its_chart_and_no_text_ends_its_element() {
        let mut chart = Chart::new(200.0, Axis::time(3.0), Axis::linear("m", (-1.0, 1.0), 4));
        chart.series.push(Series {
            name: "</script><b>".to_owned(),
            title: String::new(),
            color: Color::A,
            style: Style::Line(2.0),
            points: vec![(0.1 + 0.2, 1.0 / 3.0), (1.0, f64::NAN)],
        });
        chart.shapes.push(Polygon {
            name: "master",
            color: Color::GOOD,
            corners: vec![(0.5, 0.1), (1.5, 0.1), (1.5, 0.9), (0.5, 0.9)],
        });
        let html = chart.plot("x").into_string();
        assert_eq!(html.matches("</script>").count(), 1);
        let data = serde_json::to_value(chart.data("x")).unwrap();
        let series = &data["series"][0];
        assert_eq!(series["x"], serde_json::json!([0.3, 1.0]));
        assert_eq!(series["y"], serde_json::json!([0.33333, null]));
        assert_eq!(data["spans"][0]["from"], 0.5);
        assert_eq!(data["spans"][0]["high"], 0.9);
        assert_eq!(data["x"]["scale"], "time");
    }
}
