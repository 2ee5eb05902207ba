//! Digital outputs over time, drawn as an oscilloscope shows them.

use tandem_page::chart::{WIDTH, plain, round_ticks};
use tandem_page::svg::{Anchor, Color, Stroke, Svg};

/// Heights of the title, of one output and of the axis, and the margin on both sides.
const TITLE: f64 = 50.0;
const ROW: f64 = 90.0;
const AXIS: f64 = 70.0;
const SIDE: f64 = 24.0;
/// Height of a high level.
const LEVEL: f64 = 36.0;

/// One output. Its initial level is low.
pub(crate) struct Trace {
    pub(crate) color: Color,
    pub(crate) label: String,
    /// Times of its changes, in the unit of the axis.
    pub(crate) changes: Vec<f64>,
    /// A text above this time.
    pub(crate) note: Option<(f64, String)>,
}

/// Several outputs over one time axis from 0 to `span`.
pub(crate) struct SquareWaves {
    pub(crate) title: String,
    /// Unit and clock of the axis.
    pub(crate) axis: String,
    pub(crate) span: f64,
    pub(crate) traces: Vec<Trace>,
}

/// Returns one SVG file with the pictures one below the other.
pub(crate) fn file(pictures: &[SquareWaves]) -> String {
    let heights = pictures.iter().map(SquareWaves::height);
    let mut svg = Svg::new(WIDTH, heights.sum());
    let mut top = 0.0;
    for picture in pictures {
        picture.draw(&mut svg, top);
        top += picture.height();
    }
    svg.into_file()
}

impl SquareWaves {
    fn height(&self) -> f64 {
        TITLE + ROW * self.traces.len() as f64 + AXIS
    }

    fn draw(&self, svg: &mut Svg, top: f64) {
        let x = |at: f64| SIDE + at / self.span * (WIDTH - 2.0 * SIDE);
        let bottom = top + self.height() - AXIS;
        svg.text((SIDE, top + 28.0), Anchor::Start, Color::INK, &self.title);
        for tick in round_ticks((0.0, self.span), 12) {
            let stroke = Stroke::new(Color::GRID, 1.0);
            svg.line((x(tick), top + TITLE), (x(tick), bottom), stroke);
            let place = (x(tick), bottom + 20.0);
            svg.text(place, Anchor::Middle, Color::MUTED, &plain(tick));
        }
        svg.text(
            (SIDE, bottom + 44.0),
            Anchor::Start,
            Color::MUTED,
            &self.axis,
        );
        for (row, trace) in self.traces.iter().enumerate() {
            let low = top + TITLE + ROW * (row + 1) as f64 - 10.0;
            let mut y = low;
            let mut points = vec![(x(0.0), y)];
            for change in &trace.changes {
                points.push((x(*change), y));
                y = 2.0 * low - LEVEL - y;
                points.push((x(*change), y));
            }
            points.push((x(self.span), y));
            svg.polyline(points.into_iter(), Stroke::new(trace.color, 2.0), "");
            let above = low - LEVEL - 14.0;
            svg.text(
                (SIDE + 4.0, above),
                Anchor::Start,
                trace.color,
                &trace.label,
            );
            if let Some((at, note)) = &trace.note {
                svg.text((x(*at), above), Anchor::Middle, trace.color, note);
            }
        }
    }
}
