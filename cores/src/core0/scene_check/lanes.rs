//! The scene's lane against the lane that core 0 filters from the camera's frames it hears.

use super::{Difference, MovedLine, REMEMBERED, carried};
use crate::driving::odometry::motion;
use crate::driving::perception::LaneFilter;
use crate::driving::types::{CameraLine, Ego, Lanes, Scene};
use heapless::Deque;
use tandem_board::{Duration, Instant};
use tandem_bus::CameraLanes;

/// The lines are compared at these shares of the camera's range.
const PLACES: [f32; 3] = [0.0, 0.25, 0.5];
/// Differences at these places that are always tolerated, m: 4 standard deviations of the camera's
/// lanes (`MEASUREMENT` of the lanes' filter), which are 0.025, 0.041 and 0.085 m.
const TOLERANCES: [f32; 3] = [0.1, 0.16, 0.34];
/// Limit of the accumulated excess over the tolerance, in tolerances, …
const LIMIT: f32 = 2.0;
/// … and the most that one scene adds: it takes at least three scenes.
const MOST: f32 = 0.8;
/// An older line is not compared.
pub(super) const OLDEST: Duration = Duration::from_ms(120);

/// The excess in both directions: the cumulative sum test, as in the agreement's comparison.
#[derive(Clone, Copy, Default)]
struct Excess {
    up: f32,
    down: f32,
}

impl Excess {
    /// Adds a difference in tolerances; returns the greater sum.
    fn add(&mut self, share: f32) -> f32 {
        let add = |sum: f32, by: f32| {
            let by = if by.is_finite() { by } else { f32::MAX };
            (sum + (by - 1.0).clamp(-1.0, MOST)).clamp(0.0, LIMIT)
        };
        self.up = add(self.up, share);
        self.down = add(self.down, -share);
        self.up.max(self.down)
    }
}

/// The last line on which two sources agreed, moved along with the vehicle.
#[derive(Clone, Copy)]
struct Agreed {
    since: Instant,
    moved: MovedLine,
}

impl Agreed {
    const fn new(at: Instant, ego: Ego, c: [f32; 4]) -> Self {
        Self {
            since: at,
            moved: MovedLine {
                line: CameraLine { at, c },
                ego,
            },
        }
    }

    /// Returns the line at this time if it is not older than `oldest`.
    fn moved(&mut self, at: Instant, ego: &Ego, oldest: Duration) -> Option<[f32; 4]> {
        self.moved.to(at, ego);
        (at.since(self.since) <= oldest).then_some(self.moved.line.c)
    }
}

/// Compares a line with another one of the same lane, scene by scene.
#[derive(Default)]
pub(super) struct Comparison {
    excess: [Excess; PLACES.len()],
    agreed: Option<Agreed>,
}

/// Lines of the camera that are remembered: 200 ms.
const LINES: usize = 4;
/// Two cores receive a frame at times that are less apart than this.
const SAME_FRAME: Duration = Duration::from_ms(5);
/// The most that one line counts as evidence, in tolerances.
const FAR: f32 = 10.0;
/// A line on which both agreed tells for this long which one goes on from it: the error of its
/// fourth coefficient grows with the cube of the way.
const TELLS: Duration = Duration::from_ms(1_000);
/// So many new lines in succession must differ: 150 ms.
const DIFFERENT: u8 = 3;

/// Compares the camera's line in each scene with the lines that core 0 has received. They are of
/// the same frames, so they are equal to the last bit.
struct LineCheck {
    /// Oldest first.
    heard: Deque<CameraLine, LINES>,
    /// The line of the last scene.
    last: CameraLine,
    /// The last line that both cores received.
    agreed: Option<Agreed>,
    different: u8,
    /// How much farther core 0's lines are from `agreed`, and from their filter, than the scene's.
    evidence: f32,
}

pub(super) struct LaneCheck {
    lines: LineCheck,
    filter: LaneFilter,
    /// Time of the camera's newest line, up to which the filter is predicted.
    time: Option<Instant>,
    comparison: Comparison,
}

/// Returns a line's offset at `x`, m.
pub(super) fn offset(c: &[f32; 4], x: f32) -> f32 {
    c[0] + x * (c[1] + x * (c[2] + x * c[3]))
}

/// Returns the places of the comparison, m, with their tolerances.
fn places(range: f32) -> impl Iterator<Item = (f32, f32)> {
    let range = range.clamp(8.0, 80.0);
    PLACES
        .map(|place| place * range)
        .into_iter()
        .zip(TOLERANCES)
}

/// Returns how far two lines are apart near the vehicle, in tolerances. A line that is no number is
/// farthest.
pub(super) fn apart(c: &[f32; 4], other: &[f32; 4], range: f32) -> f32 {
    let near = places(range).take(2);
    let shares = near.map(|(x, tolerance)| (offset(c, x) - offset(other, x)).abs() / tolerance);
    shares.fold(0.0, |most, share| match share.is_finite() {
        true => most.max(share),
        false => f32::MAX,
    })
}

impl LaneCheck {
    pub(super) fn new() -> Self {
        Self {
            lines: LineCheck {
                heard: Deque::new(),
                last: CameraLine::default(),
                agreed: None,
                different: 0,
                evidence: 0.0,
            },
            filter: LaneFilter::new(),
            time: None,
            comparison: Comparison::default(),
        }
    }

    /// Returns whether the last new line of a scene was one of those that were heard.
    pub(super) const fn is_same(&self) -> bool {
        self.lines.different == 0
    }

    /// Takes the camera's line as it was received.
    pub(super) fn on_line(&mut self, line: CameraLine) {
        self.lines.on_line(line);
    }

    /// Takes the camera's line for the filter. `ego`: the vehicle's motion.
    pub(super) fn on_camera(&mut self, at: Instant, camera: &CameraLanes, ego: &Ego) {
        let before = self.time.replace(at);
        let seconds = at.since(before.unwrap_or(at)).as_secs_f32();
        self.filter.expire(at);
        self.filter.predict(seconds, &motion(ego, ego, seconds));
        self.filter.update(at, camera);
    }

    /// Returns core 0's line in the vehicle's frame at this time, earlier or later than the
    /// camera's newest.
    pub(super) fn line(&self, at: Instant, ego: &Ego) -> Option<[f32; 4]> {
        self.view(at, ego).map(|(line, _)| line)
    }

    /// Returns this line, and how far the camera sees it, m.
    pub(super) fn view(&self, at: Instant, ego: &Ego) -> Option<([f32; 4], f32)> {
        let time = self.time.filter(|time| at.since(*time) <= OLDEST)?;
        let lanes = self.filter.lanes(time)?;
        Some((carried(&lanes.c, time, at, ego), lanes.view_range))
    }

    /// Returns core 0's lanes in the vehicle's frame at this time.
    pub(super) fn lanes(&self, at: Instant, ego: &Ego) -> Option<Lanes> {
        let time = self.time.filter(|time| at.since(*time) <= OLDEST)?;
        let lanes = self.filter.lanes(time)?;
        let c = carried(&lanes.c, time, at, ego);
        Some(Lanes { c, ..lanes })
    }

    /// Compares a scene's lines: the camera's newest, and the filtered one. Returns the largest
    /// difference of the filtered line as a share of its tolerance, and a difference once it has
    /// lasted.
    pub(super) fn check(&mut self, scene: &Scene) -> (f32, Option<Difference>) {
        let own = |at| {
            let time = self.time?;
            Some(carried(&self.filter.lanes(time)?.c, time, at, &scene.ego))
        };
        let unequal = self.lines.check(scene, own);
        let (share, different) = self.check_filtered(scene);
        (share, unequal.or(different))
    }

    fn check_filtered(&mut self, scene: &Scene) -> (f32, Option<Difference>) {
        let (Some(lanes), Some(own)) = (&scene.lanes, self.line(scene.at, &scene.ego)) else {
            return (0.0, None);
        };
        self.comparison.check(scene, lanes, &own)
    }
}

impl LineCheck {
    fn on_line(&mut self, line: CameraLine) {
        if self.heard.is_full() {
            let _oldest = self.heard.pop_front();
        }
        let _fits = self.heard.push_back(line);
    }

    /// Compares the camera's line in a scene, if it is a new one. `own`: core 0's filtered line at
    /// a time. Returns the difference once it has lasted.
    fn check(
        &mut self,
        scene: &Scene,
        own: impl Fn(Instant) -> Option<[f32; 4]>,
    ) -> Option<Difference> {
        let line = scene.camera;
        let before = core::mem::replace(&mut self.last, line);
        // The same line again: core 1 does not hear the camera. That is found elsewhere.
        if line.at <= before.at {
            return None;
        }
        let newest = *self.heard.back()?;
        let lanes = scene.lanes.as_ref();
        let filtered = || lanes.map(|it| carried(&it.c, scene.at, line.at, &scene.ego));
        let bits = |line: &CameraLine| line.c.map(f32::to_bits);
        if self.heard.iter().any(|heard| bits(heard) == bits(&line)) {
            // A value that is zero has no sign: nothing new of a difference that has lasted.
            if self.different >= DIFFERENT {
                return None;
            }
            // The filtered line has less noise than the camera's.
            let filtered = filtered();
            let agreed = Agreed::new(line.at, scene.ego, filtered.unwrap_or(line.c));
            (self.agreed, self.different, self.evidence) = (Some(agreed), 0, 0.0);
            return None;
        }
        // Core 0 has not read this frame yet.
        if newest.at + SAME_FRAME < line.at {
            return None;
        }
        let agreed = self
            .agreed
            .as_mut()
            .and_then(|it| it.moved(line.at, &scene.ego, TELLS));
        let range = lanes.map_or(0.0, |it| it.view_range);
        let far = |line: &CameraLine, other: &[f32; 4]| apart(&line.c, other, range).min(FAR);
        if let Some(agreed) = &agreed {
            self.evidence += far(&newest, agreed) - far(&line, agreed);
        }
        // A wrong line does not move as the vehicle does, so its filter follows it with a lag.
        if let (Some(own), Some(filtered)) = (own(newest.at), filtered()) {
            self.evidence += far(&newest, &own) - far(&line, &filtered);
        }
        self.different = self.different.saturating_add(1);
        if self.different < DIFFERENT {
            return None;
        }
        let other = (self.evidence != 0.0).then_some(self.evidence > 0.0);
        Some(Difference {
            what: 0,
            other,
            amount: line.c[0] - newest.c[0],
        })
    }
}

impl Comparison {
    /// Compares a scene's `lanes` with another line at its time. Returns the largest difference as
    /// a share of its tolerance, and the difference once it has lasted.
    pub(super) fn check(
        &mut self,
        scene: &Scene,
        lanes: &Lanes,
        other: &[f32; 4],
    ) -> (f32, Option<Difference>) {
        let (mut sum, mut share, mut amount) = (0.0_f32, 0.0_f32, 0.0);
        for (excess, (x, tolerance)) in self.excess.iter_mut().zip(places(lanes.view_range)) {
            let aside = offset(&lanes.c, x) - offset(other, x);
            share = share.max(aside.abs() / tolerance);
            let used = excess.add(aside / tolerance);
            if used > sum {
                (sum, amount) = (used, aside);
            }
        }
        let moved = |it: &mut Agreed| it.moved(scene.at, &scene.ego, REMEMBERED);
        let agreed = self.agreed.as_mut().and_then(moved);
        if sum == 0.0 {
            self.agreed = Some(Agreed::new(scene.at, scene.ego, lanes.c));
        }
        if sum < LIMIT {
            return (share, None);
        }
        let other = agreed.map(|agreed| {
            let far = |c: &[f32; 4]| apart(c, &agreed, lanes.view_range);
            far(other) > far(&lanes.c)
        });
        let found = Difference {
            what: 0,
            other,
            amount,
        };
        (share, Some(found))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    extern crate std;
    use crate::driving::perception::Perception;

    const LINE: [f32; 4] = [0.2, 0.0, 0.0, 0.0];
    /// The wrong line moves aside by this in each scene, m, though the vehicle drives straight, and
    /// its filter follows by this share.
    const MOVES: f32 = 0.03;
    const FOLLOWS: f32 = 0.3;

    /// Returns which line is said to be wrong, for each of 60 scenes: the lines of scene and core 0
    /// were never equal, so only their filters tell. `scene_is_wrong`: else core 0's.
    fn said(scene_is_wrong: bool) -> std::vec::Vec<Option<bool>> {
        let mut check = LaneCheck::new().lines;
        let mut scene = Perception::new().scene().clone();
        scene.ego.speed = 30.0;
        let (mut wrong, mut filtered) = (LINE, LINE);
        let mut said = std::vec![];
        for cycle in 1..60_u64 {
            wrong[0] += MOVES;
            filtered[0] += FOLLOWS * (wrong[0] - filtered[0]);
            let (of_scene, of_core) = match scene_is_wrong {
                true => ((wrong, filtered), (LINE, LINE)),
                false => ((LINE, LINE), (wrong, filtered)),
            };
            let at = Instant::ORIGIN + Duration::from_ms(cycle * 50);
            check.on_line(CameraLine { at, c: of_core.0 });
            scene.at = at;
            scene.camera = CameraLine { at, c: of_scene.0 };
            scene.lanes = Some(Lanes {
                c: of_scene.1,
                ..Lanes::alone(3.5, 80.0)
            });
            let found = check.check(&scene, |_| Some(of_core.1));
            said.push(found.and_then(|found| found.other));
        }
        said
    }

    /// T-RED-9: of two lines that never agreed, the one that does not move as the vehicle does is
    /// wrong: it is ahead of its own filter.
    #[test]
    fn a_line_ahead_of_its_filter_is_wrong() {
        for scene_is_wrong in [true, false] {
            let said = said(scene_is_wrong);
            // Three scenes must differ.
            assert_eq!(said[..2], [None, None]);
            let wrong = Some(!scene_is_wrong);
            assert!(said[2..].iter().all(|it| *it == wrong), "{said:?}");
        }
    }
}
