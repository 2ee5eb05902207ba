//! A driver's view of the others: which one is ahead, which is beside, and which must merge.

use super::{Leader, Participant, RoadUser};
use crate::geometry::{Vec2, wrap_angle};
use crate::road::{Foot, Frenet, LaneId, Road, Rough};

/// A driver sees no vehicle farther ahead than this, m.
const SIGHT: f64 = 200.0;
/// Smallest side distance that a driver keeps, m.
const SIDE: f64 = 0.2;
/// Within this distance of the end of a lane, vehicles beside it make room, m.
const COURTESY_FROM: f64 = 250.0;
/// A vehicle slower than this does not merge, m/s.
const MERGING_SPEED: f64 = 3.0;

/// Another vehicle in the coordinates of the observer's lane.
pub(super) struct Seen {
    place: Frenet,
    /// Speed across the lane, m/s, left positive.
    drift: f64,
    /// The vehicle as a leader; `gap` is negative if both are side by side.
    leader: Leader,
}

/// One vehicle in the coordinates of a lane.
#[derive(Clone, Copy, Debug)]
struct View {
    lane: LaneId,
    /// The sample of the lane from which the place is computed, and the range of start samples
    /// known to lead to it. The place depends on no other value of the query.
    sample: usize,
    from: (usize, usize),
    rough: Option<Rough>,
    /// The place, once computed, and the speeds across the lane, left positive, and along it, m/s.
    foot: Option<Foot>,
    speeds: Option<(f64, f64)>,
}

impl View {
    fn foot(&mut self, road: &Road, position: Vec2) -> &Foot {
        let (lane, sample) = (road.lane(self.lane), self.sample);
        { &mut self.foot }.get_or_insert_with(|| lane.line.foot(position, sample))
    }
}

/// The coordinates of one vehicle in the lanes around it, kept until it moves. A few are enough
/// because its observers are in few lanes.
#[derive(Clone, Debug, Default)]
pub(super) struct Views {
    /// Unit vector of the vehicle's heading.
    forward: Vec2,
    known: Vec<View>,
    next: usize,
}

impl Views {
    /// Number of views kept; new ones replace the oldest.
    const LANES: usize = 8;

    /// Discards the views after the vehicle has moved; `forward` is its new heading.
    pub(super) fn renew(&mut self, forward: Vec2) {
        self.forward = forward;
        self.known.clear();
        self.next = 0;
    }

    /// Returns the place in a lane of the vehicle at `position`, see [`RoadLane::project_near`].
    ///
    /// [`RoadLane::project_near`]: crate::road::RoadLane::project_near
    pub(super) fn foot(&mut self, road: &Road, id: LaneId, position: Vec2, near: f64) -> Foot {
        *self.find(road, id, position, near).foot(road, position)
    }

    /// Returns bounds of this place.
    pub(super) fn rough(
        &mut self,
        road: &Road,
        id: LaneId,
        position: Vec2,
        near: f64,
    ) -> Option<Rough> {
        self.find(road, id, position, near).rough
    }

    /// Returns its place, and its speeds across the lane and along it.
    fn view(
        &mut self,
        road: &Road,
        id: LaneId,
        other: &Participant,
        near: f64,
    ) -> (Frenet, (f64, f64)) {
        let pose = other.footprint.pose;
        let view = self.find(road, id, pose.position, near);
        let Foot { place, point } = *view.foot(road, pose.position);
        let speeds = view.speeds.get_or_insert_with(|| {
            let (sin, cos) = wrap_angle(pose.yaw - point.heading).sin_cos();
            (other.speed * sin, (other.speed * cos).max(0.0))
        });
        (place, *speeds)
    }

    #[inline]
    fn find(&mut self, road: &Road, id: LaneId, position: Vec2, near: f64) -> &mut View {
        let start = road.lane(id).line.sample_at(near);
        let leads = |view: &View| view.lane == id && view.from.0 <= start && start <= view.from.1;
        match self.known.iter().position(leads) {
            Some(known) => &mut self.known[known],
            None => self.find_from(road, id, position, start),
        }
    }

    #[inline(never)]
    fn find_from(&mut self, road: &Road, id: LaneId, position: Vec2, start: usize) -> &mut View {
        let lane = road.lane(id);
        let sample = lane.line.sample_near(position, start);
        let is_it = |view: &View| view.lane == id && view.sample == sample;
        if let Some(known) = self.known.iter().position(is_it) {
            let known = &mut self.known[known];
            known.from = (known.from.0.min(start), known.from.1.max(start));
            return known;
        }
        let view = View {
            lane: id,
            sample,
            from: (sample.min(start), sample.max(start)),
            rough: lane.line.rough(position, sample),
            foot: None,
            speeds: None,
        };
        let mut place = self.known.len();
        if place < Self::LANES {
            self.known.push(view);
        } else {
            place = self.next;
            self.known[place] = view;
            self.next = (place + 1) % Self::LANES;
        }
        &mut self.known[place]
    }
}

/// The observing vehicle.
pub(super) struct Viewer<'a> {
    road: &'a Road,
    vehicle: &'a RoadUser,
}

impl<'a> Viewer<'a> {
    pub(super) const fn new(road: &'a Road, vehicle: &'a RoadUser) -> Self {
        Self { road, vehicle }
    }

    /// Returns the view of `other`; `None` if it is behind, far ahead or far aside. With `passes`,
    /// also `None` if neither [`ahead`] nor [`blocks_return`] would report it. `views`: of `other`.
    #[inline]
    pub(super) fn see(&self, other: &Participant, views: &mut Views, passes: bool) -> Option<Seen> {
        let vehicle = self.vehicle;
        let reach = (vehicle.participant.footprint.length + other.footprint.length) / 2.0;
        let apart = vehicle.frame.to_local(other.footprint.pose.position);
        if apart.x < -reach || apart.x > SIGHT || apart.y.abs() > 12.0 + 0.3 * apart.x.abs() {
            return None;
        }
        if passes && self.passes(other, views, apart.x) {
            return None;
        }
        Some(self.look(other, views, apart.x, reach))
    }

    /// Returns whether both certainly pass each other, now and within a second, and `other` does
    /// not block the middle of the lane.
    #[inline]
    fn passes(&self, other: &Participant, views: &mut Views, ahead: f64) -> bool {
        let Frenet { s, d } = self.vehicle.place;
        let position = other.footprint.pose.position;
        let forward = views.forward;
        let rough = views.rough(self.road, self.vehicle.lane, position, s + ahead);
        rough.is_some_and(|rough| {
            let drift = other.speed.abs() * (rough.along.cross(forward).abs() + rough.turn);
            let moves = drift + self.vehicle.lateral_speed.abs();
            let clearance = clearance(self.vehicle, other) + rough.by + moves;
            (rough.d - d).abs() > clearance && rough.d.abs() > d.abs() + clearance
        })
    }

    /// Returns the view of a vehicle that is `ahead` m ahead and not far aside.
    #[inline(never)]
    fn look(&self, other: &Participant, views: &mut Views, ahead: f64, reach: f64) -> Seen {
        let own = self.vehicle.place.s;
        let (place, (drift, along)) = views.view(self.road, self.vehicle.lane, other, own + ahead);
        Seen {
            place,
            drift,
            leader: Leader {
                gap: place.s - own - reach,
                speed: along,
                acceleration: other.acceleration,
            },
        }
    }

    /// Makes `other` the leader if it is ahead, nearer, and in the way now or within a second.
    #[inline]
    pub(super) fn nearer(&self, leader: &mut Leader, other: &Participant, views: &mut Views) {
        if let Some(seen) = self.see(other, views, true)
            && let Some(ahead) = ahead(self.vehicle, other, &seen)
            && ahead.gap < leader.gap
        {
            *leader = ahead;
        }
    }

    /// Returns the lanes beside the viewer's that end: a vehicle there must merge.
    pub(super) fn ending_beside(&self) -> [Option<LaneId>; 2] {
        let beside = self
            .road
            .lane(self.vehicle.lane)
            .beside(self.vehicle.place.s);
        beside.map(|lane| lane.filter(|lane| self.road.lane(*lane).end.is_some()))
    }
}

/// Returns the lateral distance of the centres at which two vehicles just pass each other, m.
fn clearance(vehicle: &RoadUser, other: &Participant) -> f64 {
    (vehicle.participant.footprint.width + other.footprint.width) / 2.0 + SIDE
}

/// Returns `other` as a leader, if it is ahead and in the way now or within a second.
pub(super) fn ahead(vehicle: &RoadUser, other: &Participant, seen: &Seen) -> Option<Leader> {
    let clearance = clearance(vehicle, other);
    let apart = seen.place.d - vehicle.place.d;
    let soon = apart + seen.drift - vehicle.lateral_speed;
    // A vehicle that crosses from one side to the other within the second is in the way as well.
    let in_the_way = apart.abs().min(soon.abs()) < clearance || apart * soon < 0.0;
    (in_the_way && seen.place.s > vehicle.place.s).then_some(seen.leader)
}

/// Whether `other` blocks the return to the lane's middle: if so, the driver stays beside it.
pub(super) fn blocks_return(vehicle: &RoadUser, other: &Participant, seen: &Seen) -> bool {
    let clearance = clearance(vehicle, other);
    let between = seen.place.d > vehicle.place.d.min(0.0) - clearance
        && seen.place.d < vehicle.place.d.max(0.0) + clearance;
    let near = seen.leader.gap < 2.0 + vehicle.participant.speed;
    let on_that_side = (seen.place.d - vehicle.place.d) * vehicle.place.d < 0.0;
    between && near && on_that_side
}

/// Returns `other` as a leader, if it is ahead in this adjacent lane, which ends soon: it has to
/// merge, and German law requires drivers to let it in (StVO § 7 (4)).
pub(super) fn merging(
    road: &Road,
    vehicle: &RoadUser,
    lane: LaneId,
    other: &Participant,
    seen: &Seen,
) -> Option<Leader> {
    if other.speed <= MERGING_SPEED || seen.place.s <= vehicle.place.s {
        return None;
    }
    let place = road.lane(lane).project(other.footprint.pose.position);
    let width = road.lane(lane).width_at(place.s);
    let in_lane = place.d.abs() < width / 2.0 && road.lane(lane).exists_at(place.s);
    let soon = road.distance_to_end(lane, place.s) < COURTESY_FROM;
    (in_lane && soon).then_some(seen.leader)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Scenario;
    use crate::geometry::{Footprint, Pose};

    /// A view does not depend on earlier queries.
    #[test]
    fn a_view_that_is_kept_is_the_view_from_there() {
        let scenario = Scenario::load("lane-drop").unwrap();
        let road = scenario.road();
        let lanes = road.lanes().len();
        for (station, d) in [(300.0, 0.3), (1_150.0, -2.0), (1_400.0, 9.0)] {
            let yaw = road.lane(LaneId(0)).at(station).heading + 0.2;
            let other = Participant {
                footprint: Footprint {
                    pose: Pose {
                        position: road.lane(LaneId(0)).point(Frenet { s: station, d }),
                        yaw,
                    },
                    length: 4.0,
                    width: 2.0,
                },
                speed: 20.0,
                acceleration: 0.0,
            };
            let mut views = Views::default();
            for ask in 0..200_usize {
                let id = LaneId(ask * 7 % lanes);
                let near = station + (ask * 37 % 120) as f64 - 60.0;
                let view = views.view(road, id, &other, near);
                let fresh = Views::default().view(road, id, &other, near);
                assert_eq!(view, fresh, "{ask}");
                let position = other.footprint.pose.position;
                assert_eq!(view.0, road.lane(id).project_near(position, near));
            }
        }
    }
}
