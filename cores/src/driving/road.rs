//! The ego lane's centre line as a curve: extension beyond the view, curvature, and the Frenet
//! frame.

use super::knowledge::KnownLine;
use super::math::{abs, atan, bound, clamp, cos, max, min, sin, sqrt};
use super::odometry::EgoPose;
use super::types::Lanes;

/// No road of the operational design domain has a larger curvature than this, 1/m, which is a tenth
/// above 1/20; larger values of a noisy polynomial are limited to it.
const MAX_BEND: f32 = 0.055;
/// The same for the second derivative within the view, 1/m: the curvature of a line that turns away
/// by 50° is a quarter of it.
const MAX_SECOND: f32 = 0.22;
/// Width of a lane if it is not known, m.
pub(crate) const DEFAULT_LANE_WIDTH_M: f32 = 3.5;

/// A centre line `y(x)` that continues with constant second derivative on both sides of the view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CentreLine {
    c: [f32; 4],
    end: f32,
}

impl CentreLine {
    /// The centre line of the ego lane.
    #[must_use]
    pub fn new(lanes: &Lanes) -> Self {
        Self {
            c: lanes.c,
            end: clamp(lanes.view_range, 5.0, 250.0),
        }
    }

    /// The centre line that another system sent.
    pub(crate) fn received(line: &KnownLine) -> Self {
        Self {
            c: line.c,
            end: clamp(line.view_range, 5.0, 250.0),
        }
    }

    /// The line of a vehicle that keeps its present curvature: used when no lane is seen.
    #[must_use]
    pub fn of_curvature(curvature: f32) -> Self {
        Self {
            c: [0.0, 0.0, 0.5 * bound(curvature, MAX_BEND), 0.0],
            end: 60.0,
        }
    }

    /// Offset y in m at x in m.
    #[must_use]
    pub fn y(&self, x: f32) -> f32 {
        let [c0, c1, c2, c3] = self.c;
        if x < 0.0 {
            return c0 + x * (c1 + x * bound(c2, 0.5 * MAX_BEND));
        }
        let inside = min(x, self.end);
        let y = c0 + inside * (c1 + inside * (c2 + inside * c3));
        if x <= self.end {
            return y;
        }
        let beyond = x - inside;
        y + beyond * (self.slope(inside) + 0.5 * beyond * self.bend(inside))
    }

    /// Returns the first derivative of y at x.
    #[must_use]
    pub fn slope(&self, x: f32) -> f32 {
        let [_, c1, c2, c3] = self.c;
        if x < 0.0 {
            return c1 + 2.0 * x * bound(c2, 0.5 * MAX_BEND);
        }
        let inside = min(x, self.end);
        let slope = c1 + inside * (2.0 * c2 + 3.0 * inside * c3);
        if x <= self.end {
            return slope;
        }
        slope + (x - inside) * self.bend(inside)
    }

    /// Returns the second derivative of y at x, 1/m.
    #[must_use]
    pub fn bend(&self, x: f32) -> f32 {
        let inside = clamp(x, 0.0, self.end);
        let most = if x == inside { MAX_SECOND } else { MAX_BEND };
        bound(2.0 * self.c[2] + 6.0 * inside * self.c[3], most)
    }

    /// Returns the curvature in 1/m at x.
    #[must_use]
    pub fn curvature(&self, x: f32) -> f32 {
        bound(curved(self.slope(x), self.bend(x)), MAX_BEND)
    }

    /// Returns the direction in rad at x.
    #[must_use]
    pub fn heading(&self, x: f32) -> f32 {
        atan(self.slope(x))
    }

    /// Returns the foot of the perpendicular from a point, as its x, and the signed distance (left
    /// positive).
    #[must_use]
    pub fn project(&self, x: f32, y: f32) -> (f32, f32) {
        let mut foot = x;
        for _ in 0..4 {
            let slope = self.slope(foot);
            let aside = self.y(foot) - y;
            let residual = foot - x + aside * slope;
            let gradient = 1.0 + slope * slope + aside * self.bend(foot);
            let before = foot;
            foot -= residual / max(gradient, 0.2);
            if foot == before {
                break;
            }
        }
        let heading = self.heading(foot);
        let offset = (y - self.y(foot)) * cos(heading) - (x - foot) * sin(heading);
        (foot, offset)
    }
}

/// Returns a line's coefficients in the frame of a vehicle that has moved by `step`: the Taylor
/// shift of the polynomial.
pub(crate) fn shifted(&[c0, c1, c2, c3]: &[f32; 4], step: &EgoPose) -> [f32; 4] {
    let d = step.x;
    let slope = c1 + d * (2.0 * c2 + 3.0 * d * c3);
    [
        c0 + d * (c1 + d * (c2 + d * c3)) - step.y,
        slope - step.heading * (1.0 + slope * slope),
        c2 + 3.0 * d * c3,
        c3,
    ]
}

/// Returns the curvature of a line with this first and second derivative, 1/m.
fn curved(slope: f32, bend: f32) -> f32 {
    let stretch = 1.0 + slope * slope;
    bend / (stretch * sqrt(stretch))
}

/// Nodes of the arc length's table.
const NODES: usize = 96;
/// Distance between nodes along x, m.
const NODE_STEP_M: f32 = 4.0;
/// In a sharp bend the line is less certain, so the lateral acceleration is lower: by this times
/// the curvature, m.
const SHARP_M: f32 = 8.0;
/// Distance between two places at which the line's bend is taken, m.
const BEND_STEP_M: f32 = 4.0;
/// No view is longer, m.
const VIEW_MOST_M: f32 = 260.0;
/// x of the first node, m.
const FIRST_NODE_M: f32 = -100.0;

/// One point of the Frenet frame's reference.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Reference {
    pub(crate) x: f32,
    pub(crate) y: f32,
    pub(crate) heading: f32,
    pub(crate) sine: f32,
    pub(crate) cosine: f32,
    pub(crate) curvature: f32,
    /// Change of curvature along the arc, 1/m².
    pub(crate) sharpness: f32,
}

/// A centre line with its arc length: s is 0 abeam of the vehicle frame's origin at x = 0.
#[derive(Clone, Debug)]
pub(crate) struct FrenetFrame {
    line: CentreLine,
    arc: [f32; NODES],
}

impl FrenetFrame {
    pub(crate) fn new(line: CentreLine) -> Self {
        let mut arc = [0.0; NODES];
        let stretch = |x: f32| {
            let slope = line.slope(x);
            sqrt(1.0 + slope * slope)
        };
        let mut before = stretch(FIRST_NODE_M);
        for node in 1..NODES {
            let x = FIRST_NODE_M + node as f32 * NODE_STEP_M;
            let here = stretch(x);
            // Simpson's rule over one step.
            let between = stretch(x - 0.5 * NODE_STEP_M);
            arc[node] = arc[node - 1] + NODE_STEP_M * (before + 4.0 * between + here) / 6.0;
            before = here;
        }
        let origin = arc[(-FIRST_NODE_M / NODE_STEP_M) as usize];
        for node in &mut arc {
            *node -= origin;
        }
        Self { line, arc }
    }

    fn s_of(&self, x: f32) -> f32 {
        let place = (x - FIRST_NODE_M) / NODE_STEP_M;
        let node = clamp(place, 0.0, (NODES - 2) as f32) as usize;
        self.arc[node] + (place - node as f32) * (self.arc[node + 1] - self.arc[node])
    }

    fn x_of(&self, s: f32) -> f32 {
        let node = self
            .arc
            .partition_point(|&arc| arc <= s)
            .clamp(1, NODES - 1)
            - 1;
        let share = (s - self.arc[node]) / max(self.arc[node + 1] - self.arc[node], 1e-3);
        FIRST_NODE_M + (node as f32 + share) * NODE_STEP_M
    }

    /// Arc length and signed distance (left positive) of a point of the vehicle frame.
    pub(crate) fn project(&self, x: f32, y: f32) -> (f32, f32) {
        let (foot, offset) = self.line.project(x, y);
        (self.s_of(foot), offset)
    }

    /// Returns the reference at arc length `s`.
    pub(crate) fn reference(&self, s: f32) -> Reference {
        let x = self.x_of(s);
        let slope = self.line.slope(x);
        let heading = atan(slope);
        let cosine = cos(heading);
        let curvature = bound(curved(slope, self.line.bend(x)), MAX_BEND);
        let ahead = self.line.curvature(x + 1.0);
        Reference {
            x,
            y: self.line.y(x),
            heading,
            sine: sin(heading),
            cosine,
            curvature,
            sharpness: (ahead - curvature) * cosine,
        }
    }

    /// Returns the speed, m/s, from which `braking`, m/s², leads to a lateral acceleration of at
    /// most `lateral`, m/s², in each bend within the view, and the speed in the bend that limits it
    /// most; by samples every 4 m from arc length `from` on, of which the first `near` metres are
    /// driven before the vehicle brakes.
    pub(crate) fn bend_speed(
        &self,
        from: f32,
        near: f32,
        lateral: f32,
        braking: f32,
    ) -> (f32, f32) {
        let (mut square, mut least) = (f32::INFINITY, f32::INFINITY);
        let (mut ahead, mut x) = (0.0, self.x_of(from));
        // A steep line has more arc length than its view has metres.
        while x <= self.line.end && ahead <= VIEW_MOST_M {
            let bend = max(abs(self.line.curvature(x)), 1e-5);
            let in_it = lateral * (1.0 - SHARP_M * bend) / bend;
            let before = in_it + 2.0 * braking * max(ahead - near, 0.0);
            if before < square {
                (square, least) = (before, in_it);
            }
            ahead += BEND_STEP_M;
            x = self.x_of(from + ahead);
        }
        (sqrt(square), sqrt(least))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bent() -> CentreLine {
        CentreLine {
            c: [0.5, 0.02, 0.001, -2e-6],
            end: 100.0,
        }
    }

    #[test]
    fn smooth_at_both_ends_of_the_view() {
        let line = bent();
        for x in [0.0, 100.0] {
            assert!((line.y(x - 0.01) - line.y(x + 0.01)).abs() < 5e-3);
            assert!((line.slope(x - 0.01) - line.slope(x + 0.01)).abs() < 1e-3);
        }
    }

    #[test]
    fn projection_is_perpendicular() {
        let line = bent();
        for (x, y) in [(0.0, 0.0), (40.0, 6.0), (90.0, -2.0), (-20.0, 3.0)] {
            let (foot, offset) = line.project(x, y);
            let heading = line.heading(foot);
            let back = (
                foot - offset * sin(heading),
                line.y(foot) + offset * cos(heading),
            );
            assert!(
                (back.0 - x).abs() < 1e-2 && (back.1 - y).abs() < 1e-2,
                "{x} {y}: {back:?}"
            );
        }
    }

    #[test]
    fn arc_length_of_a_circle() {
        let frame = FrenetFrame::new(CentreLine {
            c: [0.0, 0.0, 0.005, 0.0],
            end: 100.0,
        });
        // A parabola of curvature 0.01 at its vertex is near to the circle for short distances.
        let (s, d) = frame.project(20.0, 0.005 * 400.0);
        assert!(d.abs() < 1e-3);
        assert!((s - 20.13).abs() < 0.02, "{s}");
        let reference = frame.reference(s);
        assert!((reference.x - 20.0).abs() < 0.02);
        assert!(
            (reference.curvature - 0.0094).abs() < 2e-4,
            "{}",
            reference.curvature
        );
        let speed = |near| frame.bend_speed(0.0, near, 2.0, 1.5).0;
        assert!((speed(0.0) - 13.6).abs() < 0.1, "{}", speed(0.0));
        let straight_before = FrenetFrame::new(CentreLine {
            c: [0.0, 0.0, -0.004, 1e-4],
            end: 80.0,
        });
        let speed = |near| straight_before.bend_speed(0.0, near, 2.0, 1.5).0;
        assert!(
            speed(0.0) > speed(20.0) + 1.0,
            "{} {}",
            speed(0.0),
            speed(20.0)
        );
    }

    #[test]
    fn wild_polynomials_stay_finite() {
        let lanes = Lanes {
            c: [3.0, 1.5, 0.03, -3e-4],
            ..Lanes::alone(3.5, 255.0)
        };
        let frame = FrenetFrame::new(CentreLine::new(&lanes));
        for x in [-300.0, 0.0, 10.0, 400.0] {
            let (s, d) = frame.project(x, 1.0);
            assert!(s.is_finite() && d.is_finite());
            assert!(frame.reference(s).y.is_finite());
        }
    }
}
