//! What a driver sees of the others: which one is ahead, beside, or wants to come in.

use super::{Leader, Participant, Vehicle};
use crate::geometry::{Frame, wrap_angle};
use crate::road::{Frenet, LaneId, Road};

/// A driver sees no vehicle farther ahead, m.
const SIGHT: f64 = 200.0;
/// Smallest side distance that a driver keeps, m.
const SIDE: f64 = 0.2;
/// Distance to the end of a lane from which on vehicles beside it make room, m.
const COURTESY_FROM: f64 = 250.0;
/// A vehicle slower than this does not want to come in, m/s.
const MERGING_SPEED: f64 = 3.0;

/// Another vehicle in the coordinates of the observer's lane.
pub(super) struct Seen {
    place: Frenet,
    /// Speed across the lane, m/s, left positive.
    drift: f64,
    /// As a leader; `gap` is negative beside each other.
    leader: Leader,
}

/// One vehicle in the coordinates of a lane.
#[derive(Clone, Copy, Debug)]
struct View {
    lane: LaneId,
    /// The sample of the lane from which the place was found: all that it depends on besides. And
    /// the samples that are known to lead to that one.
    sample: usize,
    from: (usize, usize),
    place: Frenet,
    /// Speeds across the lane, left positive, and along it, m/s.
    drift: f64,
    along: f64,
}

/// How one vehicle is seen from the lanes around it, until it moves: those who look are in few
/// lanes.
#[derive(Clone, Debug, Default)]
pub(super) struct Views {
    known: Vec<View>,
    next: usize,
}

impl Views {
    /// Views that are kept; more replace the oldest ones.
    const LANES: usize = 8;

    /// The vehicle has moved.
    pub(super) fn forget(&mut self) {
        self.known.clear();
        self.next = 0;
    }

    fn view(&mut self, road: &Road, id: LaneId, other: &Participant, near: f64) -> View {
        let pose = other.footprint.pose;
        let lane = road.lane(id);
        let start = lane.sample_at(near);
        let leads = |view: &&View| view.lane == id && view.from.0 <= start && start <= view.from.1;
        if let Some(known) = self.known.iter().find(leads) {
            return *known;
        }
        let sample = lane.sample_near(pose.position, start);
        let is_it = |view: &&mut View| view.lane == id && view.sample == sample;
        if let Some(known) = self.known.iter_mut().find(is_it) {
            known.from = (known.from.0.min(start), known.from.1.max(start));
            return *known;
        }
        let foot = lane.foot(pose.position, sample);
        let (sin, cos) = wrap_angle(pose.yaw - foot.point.heading).sin_cos();
        let view = View {
            lane: id,
            sample,
            from: (sample.min(start), sample.max(start)),
            place: foot.place,
            drift: other.speed * sin,
            along: (other.speed * cos).max(0.0),
        };
        if self.known.len() < Self::LANES {
            self.known.push(view);
        } else {
            self.known[self.next] = view;
            self.next = (self.next + 1) % Self::LANES;
        }
        view
    }
}

/// Who looks, with what is the same for all that is looked at.
pub(super) struct Viewer<'a> {
    road: &'a Road,
    vehicle: &'a Vehicle,
    frame: Frame,
}

impl<'a> Viewer<'a> {
    pub(super) fn new(road: &'a Road, vehicle: &'a Vehicle) -> Self {
        Self {
            road,
            vehicle,
            frame: vehicle.participant.footprint.pose.frame(),
        }
    }

    /// `None` for a vehicle behind, far, or far aside. `views`: those of `other`.
    pub(super) fn see(&self, other: &Participant, views: &mut Views) -> Option<Seen> {
        let vehicle = self.vehicle;
        let reach = (vehicle.participant.footprint.length + other.footprint.length) / 2.0;
        let apart = self.frame.to_local(other.footprint.pose.position);
        if apart.x < -reach || apart.x > SIGHT || apart.y.abs() > 12.0 + 0.3 * apart.x.abs() {
            return None;
        }
        let near = vehicle.place.s + apart.x;
        let view = views.view(self.road, vehicle.lane, other, near);
        Some(Seen {
            place: view.place,
            drift: view.drift,
            leader: Leader {
                gap: view.place.s - vehicle.place.s - reach,
                speed: view.along,
                acceleration: other.acceleration,
            },
        })
    }

    /// `other` if it is ahead, in the way now or within a second, and nearer than `leader`, which
    /// is returned otherwise.
    pub(super) fn nearer(&self, leader: Leader, other: &Participant, views: &mut Views) -> Leader {
        let seen = self.see(other, views);
        let ahead = seen.and_then(|seen| ahead(self.vehicle, other, &seen));
        ahead.filter(|it| it.gap < leader.gap).unwrap_or(leader)
    }

    /// The lanes beside that end: a vehicle there must come in.
    pub(super) fn ending_beside(&self) -> impl Iterator<Item = LaneId> + use<'a> {
        let road = self.road;
        let beside = road.lane(self.vehicle.lane).beside(self.vehicle.place.s);
        let beside = beside.into_iter().flatten();
        beside.filter(move |lane| road.lane(*lane).end.is_some())
    }
}

/// Side distance of the centres at which two just pass each other, m.
fn clearance(vehicle: &Vehicle, other: &Participant) -> f64 {
    (vehicle.participant.footprint.width + other.footprint.width) / 2.0 + SIDE
}

/// `other` as a leader, if it is ahead and in the way now or within a second.
pub(super) fn ahead(vehicle: &Vehicle, other: &Participant, seen: &Seen) -> Option<Leader> {
    let clearance = clearance(vehicle, other);
    let apart = seen.place.d - vehicle.place.d;
    let soon = apart + seen.drift - vehicle.lateral_speed;
    // Who passes from one side to the other within the second is in the way as well.
    let in_the_way = apart.abs().min(soon.abs()) < clearance || apart * soon < 0.0;
    (in_the_way && seen.place.s > vehicle.place.s).then_some(seen.leader)
}

/// Whether `other` stands in the way back to the middle of the lane: a driver waits beside it.
pub(super) fn blocks_return(vehicle: &Vehicle, other: &Participant, seen: &Seen) -> bool {
    let clearance = clearance(vehicle, other);
    let between = seen.place.d > vehicle.place.d.min(0.0) - clearance
        && seen.place.d < vehicle.place.d.max(0.0) + clearance;
    let near = seen.leader.gap < 2.0 + vehicle.participant.speed;
    let on_that_side = (seen.place.d - vehicle.place.d) * vehicle.place.d < 0.0;
    between && near && on_that_side
}

/// `other` as a leader, if it is ahead in this lane beside, which ends, and soon: it has to come
/// in, and to let in one is a duty (in German law, StVO § 7 (4)).
pub(super) fn merging(
    road: &Road,
    vehicle: &Vehicle,
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

    /// Whatever was asked before, a view is that of who asks first.
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
                assert_eq!(view.place, fresh.place, "{ask}");
                assert_eq!((view.drift, view.along), (fresh.drift, fresh.along));
                let position = other.footprint.pose.position;
                assert_eq!(view.place, road.lane(id).project_near(position, near));
            }
        }
    }
}
