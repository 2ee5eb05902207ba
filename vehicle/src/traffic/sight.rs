//! What a driver makes of the others: who is ahead, who is beside, who wants to come in.

use super::{Leader, Participant, Vehicle};
use crate::geometry::{Frame, wrap_angle};
use crate::road::{Frenet, LaneId, Road};

/// A driver sees no vehicle farther ahead, m.
const SIGHT: f64 = 200.0;
/// Smallest side distance that a driver keeps, m.
const SIDE: f64 = 0.2;
/// So far before the end of a lane those beside it make room, m.
const COURTESY_FROM: f64 = 250.0;
/// Who is slower does not want to come in, m/s.
const MERGING_SPEED: f64 = 3.0;

/// Another one in the coordinates of the lane of who looks.
pub(super) struct Seen {
    place: Frenet,
    /// Speed across the lane, m/s, left positive.
    drift: f64,
    /// As a leader; `gap` is negative beside each other.
    leader: Leader,
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

    /// `None` for who is behind, far, or far aside.
    pub(super) fn see(&self, other: &Participant) -> Option<Seen> {
        let vehicle = self.vehicle;
        let reach = (vehicle.participant.footprint.length + other.footprint.length) / 2.0;
        let apart = self.frame.to_local(other.footprint.pose.position);
        if apart.x < -reach || apart.x > SIGHT || apart.y.abs() > 12.0 + 0.3 * apart.x.abs() {
            return None;
        }
        let lane = self.road.lane(vehicle.lane);
        let place = lane.project_near(other.footprint.pose.position, vehicle.place.s + apart.x);
        let angle = wrap_angle(other.footprint.pose.yaw - lane.at(place.s).heading);
        Some(Seen {
            place,
            drift: other.speed * angle.sin(),
            leader: Leader {
                gap: place.s - vehicle.place.s - reach,
                speed: (other.speed * angle.cos()).max(0.0),
                acceleration: other.acceleration,
            },
        })
    }

    /// `other` as a leader, if it is ahead and in the way now or within a second.
    pub(super) fn ahead(&self, other: &Participant) -> Option<Leader> {
        ahead(self.vehicle, other, &self.see(other)?)
    }

    /// The lanes beside that end: who is there has to come in.
    pub(super) fn ending_beside(&self) -> impl Iterator<Item = LaneId> + use<'a> {
        let road = self.road;
        let section = road.lane(self.vehicle.lane).at(self.vehicle.place.s);
        let beside = [section.left, section.right].into_iter().flatten();
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
    let width = road.lane(lane).at(place.s).width;
    let in_lane = place.d.abs() < width / 2.0 && road.lane(lane).exists_at(place.s);
    let soon = road.distance_to_end(lane, place.s) < COURTESY_FROM;
    (in_lane && soon).then_some(seen.leader)
}
