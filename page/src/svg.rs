//! Inline SVG: lines, text, shapes. Colours are variables of the page's style, with different
//! values on a dark page.

use maud::{Markup, PreEscaped};
use std::fmt::Write as _;

/// A place in the picture's own units, relative to its upper left corner.
pub type Place = (f64, f64);

/// A colour, by the name of its variable in `style.css`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Color(&'static str);

#[allow(missing_docs, reason = "the names say it")]
impl Color {
    pub const INK: Self = Self("ink");
    pub const MUTED: Self = Self("muted");
    pub const GRID: Self = Self("line");
    pub const ROAD: Self = Self("road");
    pub const A: Self = Self("a");
    pub const B: Self = Self("b");
    pub const OTHER: Self = Self("other");
    pub const GOOD: Self = Self("green");
    pub const WARN: Self = Self("yellow");
    pub const BAD: Self = Self("red");
    pub const CALM: Self = Self("calm");
    pub const PALE: Self = Self("pale");
    pub const FLOOR: Self = Self("floor");
    pub const TANDEM: Self = Self("tandem");
    pub const ICEORYX2: Self = Self("iceoryx2");
    pub const THREADS: Self = Self("threads");
    pub const SYSTEM: Self = Self("system");

    /// Returns the name of its variable, without the dashes in front.
    #[must_use]
    pub const fn name(self) -> &'static str {
        self.0
    }

    /// Returns the colour as a value in CSS.
    #[must_use]
    pub fn css(self) -> String {
        format!("var(--{})", self.0)
    }
}

/// How a line is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stroke {
    /// Its colour.
    pub color: Color,
    /// Its width.
    pub width: f64,
    /// Lengths of dashes and gaps in SVG's syntax; empty for a solid line.
    pub dashes: &'static str,
}

impl Stroke {
    /// A solid line.
    #[must_use]
    pub const fn new(color: Color, width: f64) -> Self {
        let dashes = "";
        Self {
            color,
            width,
            dashes,
        }
    }

    /// The same line with dashes.
    #[must_use]
    pub const fn dashed(self, dashes: &'static str) -> Self {
        Self { dashes, ..self }
    }

    fn attributes(self) -> String {
        let Self {
            color,
            width,
            dashes,
        } = self;
        let dashes = match dashes {
            "" => String::new(),
            dashes => format!(r#" stroke-dasharray="{dashes}""#),
        };
        let color = color.css();
        format!(r#"fill="none" style="stroke:{color}" stroke-width="{width}"{dashes}"#)
    }
}

/// Which part of a text is at the given place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Anchor {
    /// Its start.
    Start,
    /// Its middle.
    Middle,
    /// Its end.
    End,
}

/// A picture.
#[derive(Debug)]
pub struct Svg {
    size: (f64, f64),
    body: String,
}

impl Svg {
    /// An empty picture of this width and height in its own units; the page scales it.
    #[must_use]
    pub const fn new(width: f64, height: f64) -> Self {
        Self {
            size: (width, height),
            body: String::new(),
        }
    }

    // Writing to a string cannot fail, here and below.
    fn add(&mut self, element: std::fmt::Arguments<'_>) {
        let _ = self.body.write_fmt(element);
    }

    /// A line.
    pub fn line(&mut self, (x1, y1): Place, (x2, y2): Place, stroke: Stroke) {
        self.add(format_args!(
            r#"<path d="M{x1:.1} {y1:.1}L{x2:.1} {y2:.1}" {}/>"#,
            stroke.attributes()
        ));
    }

    /// A line through these points, with a tooltip.
    pub fn polyline(&mut self, points: impl Iterator<Item = Place>, stroke: Stroke, title: &str) {
        let (path, attributes) = (path(points), stroke.attributes());
        self.add(format_args!(
            r#"<path d="{path}" stroke-linejoin="round" {attributes}>{}</path>"#,
            titled(title)
        ));
    }

    /// Round dots.
    pub fn dots(&mut self, places: impl Iterator<Item = Place>, radius: f64, color: Color) {
        let mut path = String::new();
        for (x, y) in places {
            let _ = write!(path, "M{x:.1} {y:.1}h0");
        }
        let attributes = Stroke::new(color, 2.0 * radius).attributes();
        self.add(format_args!(
            r#"<path d="{path}" stroke-linecap="round" {attributes}/>"#
        ));
    }

    /// A filled shape with these corners.
    pub fn shape(&mut self, corners: impl Iterator<Item = Place>, fill: Color) {
        self.titled_shape(corners, fill, "");
    }

    /// A filled shape with these corners, with a tooltip.
    pub fn titled_shape(&mut self, corners: impl Iterator<Item = Place>, fill: Color, title: &str) {
        let (path, fill, title) = (path(corners), fill.css(), titled(title));
        self.add(format_args!(
            r#"<path d="{path}Z" style="fill:{fill}">{title}</path>"#
        ));
    }

    /// A filled rectangle with a tooltip.
    pub fn rect(&mut self, (x, y): Place, (width, height): Place, fill: Color, title: &str) {
        let (fill, title) = (fill.css(), titled(title));
        self.add(format_args!(
            r#"<rect x="{x:.1}" y="{y:.1}" width="{width:.1}" height="{height:.1}" style="fill:{fill}">{title}</rect>"#
        ));
    }

    /// A filled circle with a tooltip; `ring` draws its edge alone.
    pub fn circle(&mut self, (x, y): Place, radius: f64, color: Color, ring: bool, title: &str) {
        let (color, title) = (color.css(), titled(title));
        let paint = if ring {
            format!("fill:var(--card);stroke:{color}")
        } else {
            format!("fill:{color}")
        };
        self.add(format_args!(
            r#"<circle cx="{x:.1}" cy="{y:.1}" r="{radius}" style="{paint}">{title}</circle>"#
        ));
    }

    /// A text.
    pub fn text(&mut self, (x, y): Place, anchor: Anchor, color: Color, text: &str) {
        let anchor = match anchor {
            Anchor::Start => "start",
            Anchor::Middle => "middle",
            Anchor::End => "end",
        };
        let (color, text) = (color.css(), escaped(text));
        self.add(format_args!(
            r#"<text x="{x:.1}" y="{y:.1}" text-anchor="{anchor}" style="fill:{color}">{text}</text>"#
        ));
    }

    /// Returns the picture as a separate file.
    #[must_use]
    pub fn into_file(self) -> String {
        let ((width, height), body, style) = (self.size, self.body, crate::STYLE);
        format!(
            r#"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height:.0}"><style>{style}</style><rect width="{width}" height="{height:.0}" style="fill:var(--card)"/>{body}</svg>"#
        )
    }

    /// Returns the picture as an element; `label` says what it shows.
    #[must_use]
    pub fn finish(self, class: &str, label: &str) -> Markup {
        let ((width, height), body, label) = (self.size, self.body, escaped(label));
        PreEscaped(format!(
            r#"<svg class="{class}" role="img" aria-label="{label}" viewBox="0 0 {width} {height:.0}">{body}</svg>"#
        ))
    }
}

/// Returns the commands of a path through these points.
fn path(points: impl Iterator<Item = Place>) -> String {
    let commands = std::iter::once('M').chain(std::iter::repeat('L'));
    let steps = commands.zip(points);
    steps
        .map(|(command, (x, y))| format!("{command}{x:.1} {y:.1}"))
        .collect()
}

fn titled(title: &str) -> String {
    match title {
        "" => String::new(),
        title => format!("<title>{}</title>", escaped(title)),
    }
}

fn escaped(text: &str) -> String {
    maud::Render::render(text).into_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_drawn_is_well_formed_whatever_the_texts_are() {
        let mut svg = Svg::new(100.0, 50.0);
        let stroke = Stroke::new(Color::A, 1.5).dashed("4 3");
        svg.line((0.0, 0.0), (1.0, 2.0), stroke);
        svg.polyline([(0.0, 0.0), (3.0, 4.0)].into_iter(), stroke, "a < b & c");
        svg.dots([(1.0, 1.0)].into_iter(), 2.0, Color::B);
        svg.shape(
            [(1.0, 1.0), (2.0, 2.0), (3.0, 1.0)].into_iter(),
            Color::ROAD,
        );
        svg.rect((1.0, 1.0), (2.0, 2.0), Color::GOOD, "\"quoted\"");
        svg.circle((1.0, 1.0), 2.0, Color::BAD, true, "");
        svg.text((1.0, 1.0), Anchor::Middle, Color::INK, "<script>");
        let text = svg.finish("chart", "one \"and\" <another>").into_string();
        let picture = roxmltree::Document::parse(&text).unwrap();
        assert_eq!(picture.descendants().filter(|n| n.is_element()).count(), 10);
    }

    #[test]
    fn every_colour_has_a_value_on_light_and_on_dark_pages() {
        let (light, dark) = crate::STYLE
            .split_once("prefers-color-scheme: dark")
            .unwrap();
        for color in [
            Color::INK,
            Color::MUTED,
            Color::GRID,
            Color::ROAD,
            Color::A,
            Color::B,
            Color::OTHER,
            Color::GOOD,
            Color::WARN,
            Color::BAD,
            Color::CALM,
            Color::PALE,
            Color::FLOOR,
            Color::TANDEM,
            Color::ICEORYX2,
            Color::THREADS,
            Color::SYSTEM,
        ] {
            let value = format!("--{}:", color.0);
            assert!(light.contains(&value) && dark.contains(&value), "{value}");
        }
    }
}
