//! The road from above at one moment: lanes, the vehicle's own path, and the vehicles.

use tandem_page::chart::{Axis, Chart, Polygon, Style};
use tandem_page::svg::Color;
use tandem_record::RunLog;
use tandem_record::log::{Lane, Other, Sample};

use super::sections::series;

/// Height of the chart in its own units.
const HEIGHT: f64 = 230.0;
/// Distance of the view ahead, m. The distance behind follows from the width.
const AHEAD_M: f64 = 85.0;
/// Half the height of the view, m.
const ASIDE_M: f64 = 13.0;
/// Length and width of the ego vehicle in the drawing, m.
const OWN: (f64, f64) = (4.6, 1.9);

/// A view with the ego vehicle at the origin, heading along x.
struct View {
    x: f64,
    y: f64,
    cos: f64,
    sin: f64,
    heading: f64,
    back_m: f64,
}

impl View {
    fn of(sample: &Sample) -> Self {
        let (sin, cos) = sample.heading.sin_cos();
        let back_m = 2.0 * ASIDE_M * Chart::aspect(HEIGHT) - AHEAD_M;
        Self {
            x: sample.x,
            y: sample.y,
            cos,
            sin,
            heading: sample.heading,
            back_m,
        }
    }

    fn local(&self, [x, y]: [f64; 2]) -> (f64, f64) {
        let (dx, dy) = (x - self.x, y - self.y);
        (dx * self.cos + dy * self.sin, dy * self.cos - dx * self.sin)
    }

    fn shows(&self, (x, y): (f64, f64)) -> bool {
        (-self.back_m..=AHEAD_M).contains(&x) && (-ASIDE_M..=ASIDE_M).contains(&y)
    }

    /// Returns the visible part of a polyline, split at points that are not a number.
    fn polyline(&self, points: impl Iterator<Item = [f64; 2]>) -> Vec<(f64, f64)> {
        let mut local: Vec<(f64, f64)> = Vec::new();
        for point in points.map(|point| self.local(point)) {
            let Some(&last) = local.last() else {
                local.push(point);
                continue;
            };
            // Use fine steps, so that a line that leaves the view is cut at its edge.
            let steps = ((point.0 - last.0).hypot(point.1 - last.1) / 0.5)
                .ceil()
                .clamp(1.0, 400.0);
            for step in 1..=steps as u32 {
                let part = f64::from(step) / steps;
                local.push((
                    last.0 + (point.0 - last.0) * part,
                    last.1 + (point.1 - last.1) * part,
                ));
            }
        }
        local
            .into_iter()
            .map(|p| if self.shows(p) { p } else { (p.0, f64::NAN) })
            .collect()
    }

    /// Returns the corners of a vehicle, if all of it is visible.
    fn rectangle(&self, vehicle: &Other) -> Option<Vec<(f64, f64)>> {
        let (cx, cy) = self.local([vehicle.x, vehicle.y]);
        let (sin, cos) = (vehicle.heading - self.heading).sin_cos();
        let (half_l, half_w) = (vehicle.length / 2.0, vehicle.width / 2.0);
        let corners: Vec<(f64, f64)> = [
            (half_l, half_w),
            (-half_l, half_w),
            (-half_l, -half_w),
            (half_l, -half_w),
        ]
        .into_iter()
        .map(|(l, w)| (cx + l * cos - w * sin, cy + l * sin + w * cos))
        .collect();
        corners
            .iter()
            .all(|corner| self.shows(*corner))
            .then_some(corners)
    }

    /// Returns the visible part of a lane's surface.
    fn surface(&self, lane: &Lane) -> Vec<Vec<(f64, f64)>> {
        lane.left
            .windows(2)
            .zip(lane.right.windows(2))
            .map(|(left, right)| vec![left[0], left[1], right[1], right[0]])
            .map(|quad| {
                quad.into_iter()
                    .map(|point| self.local(point))
                    .collect::<Vec<_>>()
            })
            .filter(|quad| quad.iter().any(|corner| self.shows(*corner)))
            .map(|quad| quad.into_iter().map(|(x, y)| self.clamp(x, y)).collect())
            .collect()
    }

    fn clamp(&self, x: f64, y: f64) -> (f64, f64) {
        (x.clamp(-self.back_m, AHEAD_M), y.clamp(-ASIDE_M, ASIDE_M))
    }
}

/// Draws the road at the sample with vehicles that is nearest to `at_ns`; `None` without samples.
pub(super) fn top_view(log: &RunLog, at_ns: u64) -> Option<(f64, Chart)> {
    // Without traffic no sample has other vehicles. Then any sample may be used.
    let with_others = log.samples.iter().any(|sample| !sample.others.is_empty());
    let sample = log
        .samples
        .iter()
        .filter(|sample| !with_others || !sample.others.is_empty())
        .min_by_key(|sample| sample.at_ns.abs_diff(at_ns))?;
    let view = View::of(sample);
    let x = Axis::linear("m ahead of the own vehicle", (-view.back_m, AHEAD_M), 10);
    let y = Axis::linear("m, left +", (-ASIDE_M, ASIDE_M), 5);
    let mut chart = Chart::new(HEIGHT, x, y);
    chart.grid = false;
    let before = log.road.iter().rfind(|road| road.at_ns <= sample.at_ns);
    let lanes = before
        .or(log.road.first())
        .map_or(&[][..], |road| &road.lanes);
    for lane in lanes {
        for corners in view.surface(lane) {
            chart.shapes.push(Polygon {
                name: "",
                color: Color::ROAD,
                corners,
            });
        }
    }
    let mut line = |color, style, points| {
        chart.series.push(series("", color, style, points));
    };
    for lane in lanes {
        for border in [&lane.left, &lane.right] {
            line(
                Color::OTHER,
                Style::Dashed(1.0, "6 4"),
                view.polyline(border.iter().copied()),
            );
        }
    }
    let path = log
        .samples
        .iter()
        .step_by(10)
        .map(|sample| [sample.x, sample.y]);
    line(Color::A, Style::Line(2.0), view.polyline(path));
    let own = Other {
        x: sample.x,
        y: sample.y,
        heading: sample.heading,
        length: OWN.0,
        width: OWN.1,
    };
    let others = { sample.others.iter() }.map(|other| (other, Color::MUTED, "another vehicle"));
    for (vehicle, color, name) in others.chain([(&own, Color::A, "the own vehicle")]) {
        if let Some(corners) = view.rectangle(vehicle) {
            chart.shapes.push(Polygon {
                name,
                color,
                corners,
            });
        }
    }
    Some((log.seconds(sample.at_ns), chart))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_view_turns_with_the_own_vehicle() {
        let heading = std::f64::consts::FRAC_PI_2;
        let view = View::of(&Sample {
            x: 5.0,
            y: 5.0,
            heading,
            ..Sample::default()
        });
        let (ahead, aside) = view.local([4.0, 15.0]);
        assert!((ahead - 10.0).abs() < 1e-9 && (aside - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_run_without_samples_has_no_view() {
        assert!(top_view(&RunLog::default(), 0).is_none());
    }
}
