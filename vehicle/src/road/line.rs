//! A lane's centre line: its points by arc length, and its nearest point to a position.
//!
//! Values that every query needs are computed once: the vector and the turn to the next sample, and
//! boxes around pieces of the line, so that a search skips distant pieces.

use super::{Frenet, STEP};
use crate::geometry::{Vec2, wrap_angle};

/// Number of samples in a piece; each piece has its own box.
const PIECE: usize = 32;
/// A search over the whole line tests every `COARSE`-th sample, then those between.
const COARSE: usize = 4;
/// Number of Newton steps, which begin at the nearest sample.
const NEWTON_STEPS: usize = 3;
/// Samples on each side for which [`Bend`] holds, and the largest distance from the sample at which
/// it is used, m.
const AROUND: usize = 8;
const AROUND_M: f64 = 14.0;
/// Largest rounding error of a bound, m.
const ROUNDING: f64 = 1e-6;

/// A sample: the line has one every [`STEP`] metres.
#[derive(Clone, Debug)]
struct Sample {
    centre: Vec2,
    heading: f64,
    /// Unit vector with this heading.
    along: Vec2,
    /// Vector to the next sample; zero at the last.
    way: Vec2,
    turn: f64,
    bend: Bend,
}

/// How the line bends within [`AROUND`] samples.
#[derive(Clone, Copy, Debug)]
struct Bend {
    /// Largest angle to the direction at the sample, rad; infinite if its sine is above 0.47.
    angle: f64,
    /// Largest curvature, 1/m.
    curvature: f64,
    /// Per metre of arc length, the line advances by 1 m along its direction, with at most this
    /// error, m.
    stretch: f64,
}

/// A point of the line.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Point {
    pub(crate) centre: Vec2,
    /// Direction of the line, rad.
    pub(crate) heading: f64,
}

impl Point {
    /// Returns the point `d` metres to the left.
    pub(crate) fn beside(self, d: f64) -> Vec2 {
        self.centre + Vec2::from_angle(self.heading).left() * d
    }
}

/// The foot of a perpendicular.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Foot {
    pub(crate) place: Frenet,
    pub(crate) point: Point,
}

/// Bounds of the foot of a perpendicular, computed from the sample at which the search begins.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rough {
    /// The foot's `d` differs from this one by at most `by`, m.
    pub(crate) d: f64,
    pub(crate) by: f64,
    /// Direction of the line at the sample, and its largest change between sample and foot, rad.
    pub(crate) along: Vec2,
    pub(crate) turn: f64,
}

/// A box along the axes.
#[derive(Clone, Copy, Debug)]
struct Bounds {
    low: Vec2,
    high: Vec2,
}

/// The centre line of a lane; beyond its samples it continues straight.
#[derive(Clone, Debug)]
pub(crate) struct Line {
    samples: Vec<Sample>,
    /// Box around all samples, and around each piece with the first sample of the next.
    whole: Bounds,
    pieces: Vec<Bounds>,
    /// The first and the last point, and the directions in which the line continues there.
    rays: [(Vec2, Vec2); 2],
}

impl Bounds {
    fn around(points: impl Iterator<Item = Vec2>) -> Self {
        let nothing = Self {
            low: Vec2::new(f64::INFINITY, f64::INFINITY),
            high: Vec2::new(f64::NEG_INFINITY, f64::NEG_INFINITY),
        };
        points.fold(nothing, |it, point| Self {
            low: Vec2::new(it.low.x.min(point.x), it.low.y.min(point.y)),
            high: Vec2::new(it.high.x.max(point.x), it.high.y.max(point.y)),
        })
    }

    /// Returns the square of the distance to the box, m². It never exceeds that to a point inside
    /// the box, because both are rounded in the same way.
    fn distance_squared(&self, point: Vec2) -> f64 {
        let outside = |low: f64, high: f64, at: f64| (low - at).max(at - high).max(0.0);
        let apart = Vec2::new(
            outside(self.low.x, self.high.x, point.x),
            outside(self.low.y, self.high.y, point.y),
        );
        apart.dot(apart)
    }
}

fn distance_squared(a: Vec2, b: Vec2) -> f64 {
    let apart = a - b;
    apart.dot(apart)
}

impl Bend {
    const STRAIGHT: Self = Self {
        angle: 0.0,
        curvature: 0.0,
        stretch: 0.0,
    };
}

/// Returns the bend around this sample.
fn bend(samples: &[Sample], index: usize) -> Bend {
    let along = samples[index].along;
    // An angle of up to 0.5 rad is no larger than 1.05 times its sine.
    let angle = |other: Vec2, length: f64| {
        let sine = along.cross(other).abs() / length;
        let is_small = along.dot(other) > 0.0 && sine < 0.47;
        if is_small { 1.05 * sine } else { f64::INFINITY }
    };
    let around = &samples[index.saturating_sub(AROUND)..(index + AROUND + 1).min(samples.len())];
    around.iter().fold(Bend::STRAIGHT, |it, sample| {
        let length = sample.way.norm();
        if length == 0.0 {
            // The last sample.
            let angle = it.angle.max(angle(sample.along, 1.0));
            return Bend { angle, ..it };
        }
        let angle = angle(sample.along, 1.0).max(angle(sample.way, length));
        // The directions of the line and of the vector differ by at most twice the angle.
        let share = length / STEP;
        Bend {
            angle: it.angle.max(angle),
            curvature: it.curvature.max(sample.turn.abs() / STEP),
            stretch: it
                .stretch
                .max((share - 1.0).abs() + 2.0 * share * angle * angle),
        }
    })
}

impl Line {
    /// The line through these points, with their headings; at least one.
    pub(super) fn new(centres: &[Vec2], headings: &[f64]) -> Self {
        let last = centres.len() - 1;
        let mut samples: Vec<Sample> = (0..=last)
            .map(|index| {
                let next = (index + 1).min(last);
                Sample {
                    centre: centres[index],
                    heading: headings[index],
                    along: Vec2::from_angle(wrap_angle(headings[index])),
                    way: centres[next] - centres[index],
                    turn: wrap_angle(headings[next] - headings[index]),
                    bend: Bend::STRAIGHT,
                }
            })
            .collect();
        for index in 0..=last {
            samples[index].bend = bend(&samples, index);
        }
        let pieces = (0..samples.len()).step_by(PIECE).map(|first| {
            let end = (first + PIECE + 1).min(samples.len());
            Bounds::around(centres[first..end].iter().copied())
        });
        let mut line = Self {
            whole: Bounds::around(centres.iter().copied()),
            pieces: pieces.collect(),
            rays: Default::default(),
            samples,
        };
        let [begin, end] = [0.0, last as f64 * STEP].map(|s| line.at(s));
        line.rays = [
            (begin.centre, -Vec2::from_angle(begin.heading)),
            (end.centre, Vec2::from_angle(end.heading)),
        ];
        line
    }

    fn last(&self) -> usize {
        self.samples.len() - 1
    }

    /// Returns the index of the sample before `s`, the fraction of the step from there to the next
    /// one, and the distance beyond all samples, m.
    #[inline]
    pub(super) fn around(&self, s: f64) -> (usize, f64, f64) {
        // There are fewer samples than metres of road, so 32 bits suffice. They convert fast.
        let last = self.last() as u32;
        let place = (s / STEP).clamp(0.0, f64::from(last));
        let index = (place as u32).min(last.saturating_sub(1));
        (index as usize, place - f64::from(index), s - place * STEP)
    }

    /// Returns the line at arc length `s`.
    pub(crate) fn at(&self, s: f64) -> Point {
        let (index, t, beyond) = self.around(s);
        let from = &self.samples[index];
        let heading = from.heading + from.turn * t;
        let inside = from.centre + from.way * t;
        let centre = if beyond == 0.0 {
            inside
        } else {
            inside + Vec2::from_angle(heading) * beyond
        };
        Point {
            centre,
            heading: wrap_angle(heading),
        }
    }

    /// Returns the line at arc length `s`, and the unit vector with its heading.
    #[inline]
    fn along(&self, s: f64) -> (Point, Vec2) {
        let (at, from) = (self.at(s), &self.samples[self.around(s).0]);
        // Where the line is straight, its heading is that of the sample to the last bit.
        let along = if at.heading.to_bits() == from.heading.to_bits() {
            from.along
        } else {
            Vec2::from_angle(at.heading)
        };
        (at, along)
    }

    /// Returns the sample that is nearest to arc length `s`.
    pub(crate) fn sample_at(&self, s: f64) -> usize {
        let place = (s / STEP).clamp(0.0, f64::from(self.last() as u32));
        let before = place as u32;
        // Like `round`, which is a function call on many machines.
        before as usize + usize::from(place - f64::from(before) >= 0.5)
    }

    /// Walks from sample `start` to ever nearer samples and returns the last. A walk that starts at
    /// any of the samples passed ends at the same one.
    pub(crate) fn sample_near(&self, point: Vec2, start: usize) -> usize {
        let distance = |index: usize| distance_squared(point, self.samples[index].centre);
        let (mut index, mut least) = (start, distance(start));
        let mut walk = |next: fn(usize) -> usize, end: usize| {
            while index != end && distance(next(index)) < least {
                index = next(index);
                least = distance(index);
            }
            index
        };
        let up = walk(|index| index + 1, self.last());
        if up > start {
            up
        } else {
            walk(|index| index - 1, 0)
        }
    }

    /// Returns the sample that is nearest to `point` on the whole line, found from a coarse search.
    pub(super) fn sample(&self, point: Vec2) -> usize {
        let mut nearest = (f64::INFINITY, 0);
        let search = |piece: usize, nearest: &mut (f64, usize)| {
            let first = piece * PIECE;
            let end = (first + PIECE).min(self.samples.len());
            for index in (first..end).step_by(COARSE) {
                let distance = distance_squared(point, self.samples[index].centre);
                if distance < nearest.0 {
                    *nearest = (distance, index);
                }
            }
        };
        // Begin with the piece of the nearest box: most other boxes are farther than its samples.
        let by_box = |piece: &usize| self.pieces[*piece].distance_squared(point);
        let first = (0..self.pieces.len()).min_by(|a, b| by_box(a).total_cmp(&by_box(b)));
        search(first.unwrap_or(0), &mut nearest);
        let bound = nearest.0;
        // Among equally near samples, the first one counts.
        nearest = (f64::INFINITY, 0);
        for piece in 0..self.pieces.len() {
            let box_distance = by_box(&piece);
            if box_distance <= bound && box_distance < nearest.0 {
                search(piece, &mut nearest);
            }
        }
        self.sample_near(point, nearest.1)
    }

    /// Returns the foot of the perpendicular from `point`, by Newton steps from this sample.
    pub(crate) fn foot(&self, point: Vec2, sample: usize) -> Foot {
        let mut s = sample as f64 * STEP;
        let (mut at, mut along) = if sample < self.last() {
            let Sample {
                centre,
                heading,
                along,
                ..
            } = self.samples[sample];
            let heading = wrap_angle(heading);
            (Point { centre, heading }, along)
        } else {
            self.along(s)
        };
        for _ in 0..NEWTON_STEPS {
            let next = s + along.dot(point - at.centre);
            // Further steps would give the same point.
            if next == s {
                break;
            }
            s = next;
            (at, along) = self.along(s);
        }
        let d = along.cross(point - at.centre);
        Foot {
            place: Frenet { s, d },
            point: at,
        }
    }

    /// Bounds of the result of [`Line::foot`] from this sample; `None` if the line bends too much.
    ///
    /// A Newton step maps `s` to g(s) = s + along(s) · (point - at(s)). If the slope of g is below
    /// a half within twice the first step, then no step leaves that range (Banach).
    pub(crate) fn rough(&self, point: Vec2, sample: usize) -> Option<Rough> {
        let Sample {
            centre,
            along,
            bend,
            ..
        } = self.samples[sample];
        let apart = point - centre;
        let distance = apart.x.abs() + apart.y.abs();
        let within = 2.0 * along.dot(apart).abs();
        let slope = bend.stretch + bend.curvature * (distance + 2.0 * within);
        (within < AROUND_M && slope < 0.5).then(|| Rough {
            d: along.cross(apart),
            by: bend.angle * (distance + 3.0 * within) + ROUNDING,
            along,
            turn: bend.angle,
        })
    }

    /// Returns whether each point of the line is farther from `point` than `distance`, m. May
    /// return false for a farther line if one of its boxes is nearer.
    pub(super) fn is_farther(&self, point: Vec2, distance: f64) -> bool {
        let limit = distance + ROUNDING;
        let limit_squared = limit * limit;
        let ray_is_farther = |(from, along): &(Vec2, Vec2)| {
            let apart = point - *from;
            along.dot(apart) < 0.0 || along.cross(apart).abs() > limit
        };
        let is_outside = |bounds: &Bounds| bounds.distance_squared(point) > limit_squared;
        (is_outside(&self.whole) || self.pieces.iter().all(is_outside))
            && self.rays.iter().all(ray_is_farther)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a winding line with a bend that returns to its start.
    fn winding() -> Line {
        bending(2.4)
    }

    /// Returns a line that winds to both sides by this angle, rad.
    fn bending(angle: f64) -> Line {
        let mut points = vec![Vec2::default()];
        let heading = |index: usize| (index as f64 * 0.031).sin() * angle + 0.001 * index as f64;
        for index in 0..699 {
            points.push(points[index] + Vec2::from_angle(heading(index)) * STEP);
        }
        let headings: Vec<f64> = (0..700).map(|index| wrap_angle(heading(index))).collect();
        Line::new(&points, &headings)
    }

    /// Returns points on a grid around the line.
    fn places(line: &Line) -> impl Iterator<Item = Vec2> {
        let Bounds { low, high } = line.whole;
        let on = |share: usize, low: f64, high: f64| {
            low - 300.0 + share as f64 / 40.0 * (high - low + 600.0)
        };
        (0..=40).flat_map(move |x| {
            (0..=40).map(move |y| Vec2::new(on(x, low.x, high.x), on(y, low.y, high.y)))
        })
    }

    #[test]
    fn boxes_leave_out_nothing_that_is_near() {
        let line = winding();
        let mut farther = [0; 2];
        for point in places(&line) {
            let coarse = line.samples.iter().step_by(COARSE);
            let distances = coarse
                .map(|it| distance_squared(point, it.centre))
                .enumerate();
            let nearest = distances.min_by(|a, b| a.1.total_cmp(&b.1));
            let (nearest, _) = nearest.unwrap();
            let expected = line.sample_near(point, nearest * COARSE);
            assert_eq!(line.sample(point), expected, "{point:?}");
            // Dense stations on the line and beyond both of its ends.
            let stations = (-2_000..4_000).map(|s| f64::from(s) * 0.5);
            let apart = stations.map(|s| (line.at(s).centre - point).norm());
            let distance = apart.fold(f64::INFINITY, f64::min);
            assert!(!line.is_farther(point, distance), "{point:?}");
            farther[usize::from(line.is_farther(point, distance - 30.0))] += 1;
        }
        assert!(farther[1] > farther[0], "the boxes are of use: {farther:?}");
    }

    /// The bounds hold from each starting sample, even if Newton's steps do not reach the foot.
    #[test]
    fn the_foot_is_within_its_bounds() {
        let line = bending(1.0);
        let mut known = 0;
        for (sample, d) in (0..690).flat_map(|it| (-60..=60).map(move |d| (it, f64::from(d)))) {
            for ahead in [-6.0, -1.0, 0.3, 2.0, 5.0] {
                let point = line.at(sample as f64 * STEP + ahead).beside(d);
                let foot = line.foot(point, sample);
                if let Some(Rough { d, by, along, turn }) = line.rough(point, sample) {
                    assert!((foot.place.d - d).abs() <= by, "{point:?} {sample} {by}");
                    let sine = along.cross(Vec2::from_angle(foot.point.heading));
                    assert!(sine.abs() <= turn, "{point:?} {sample}");
                    known += u32::from(by < 1.0);
                }
            }
        }
        assert!(known > 5_000, "the bounds are of use: {known}");
    }

    /// The stored vector of a straight piece is the one of its heading, to the last bit.
    #[test]
    fn the_direction_along_the_line_is_that_of_its_heading() {
        let straight = |heading: f64| {
            let point = |index: usize| Vec2::from_angle(heading) * (index as f64 * STEP);
            let points: Vec<Vec2> = (0..50).map(point).collect();
            Line::new(&points, &[heading; 50])
        };
        let bits = |it: Vec2| (it.x.to_bits(), it.y.to_bits());
        for line in [winding(), straight(0.0), straight(-0.0), straight(2.1)] {
            for place in -100..16_000 {
                let (at, along) = line.along(f64::from(place) * 0.1);
                assert_eq!(bits(along), bits(Vec2::from_angle(at.heading)), "{place}");
                let again = line.at(f64::from(place) * 0.1);
                assert_eq!(bits(at.centre), bits(again.centre));
            }
        }
    }

    #[test]
    fn all_samples_on_a_walk_lead_to_its_end() {
        let line = winding();
        for point in places(&line) {
            for start in (0..700).step_by(41) {
                let end = line.sample_near(point, start);
                for between in start.min(end)..=start.max(end) {
                    assert_eq!(line.sample_near(point, between), end, "{point:?} {start}");
                }
            }
        }
    }
}
