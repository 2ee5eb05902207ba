//! The other road users: they replay their recording, then drive autonomously.
//!
//! A recording does not react: it was made around another ego, and it is short. So each vehicle
//! changes permanently from replay to driving by itself when
//!
//! - its recording ends;
//! - it would have to brake with more than 1.5 m/s² for the ego or for a vehicle that already
//!   drives by itself, if one of these is ahead; or it is about to come too close to one;
//! - by changing lanes, it would hit one of these from the side within a second. It then stays in
//!   its lane, like a driver who checks before changing.
//!
//! Then it keeps its lane and follows by the Intelligent Driver Model, beginning with the speed,
//! heading and time gap of that moment. It reacts to the ego and all others, slows down for curves,
//! stops at the end of a lane, and lets in vehicles that must leave a lane that ends.
//!
//! With [`Traffic::as_recorded`] no vehicle leaves its recording, and each disappears at its end.

mod idm;
pub(crate) mod recording;
mod sight;

use std::sync::Arc;

pub use idm::{IdmParameters, Leader};

use crate::commonroad::{Class, Obstacle};
use crate::geometry::{Footprint, LocalFrame, Pose, Vec2, wrap_angle};
use crate::road::{Foot, Frenet, LaneId, Road, Rough};
use recording::Track;
use sight::{Viewer, Views};

/// A replayed vehicle that would have to brake harder than this leaves its recording, m/s².
const REPLAY_BRAKES: f64 = 1.5;
/// A replayed lane change is checked from this time before its start until its end, s.
const LOOK_AHEAD_S: f64 = 1.0;
const LOOK_AHEADS_S: [f64; 4] = [0.25, 0.5, 0.75, LOOK_AHEAD_S];
/// Room around a replayed vehicle in that check, along and across it, m.
const ROOM: (f64, f64) = (1.0, 0.2);
/// Comfortable lateral acceleration in curves, m/s².
const CURVE_ACCELERATION: f64 = 2.5;
/// Natural frequency of the return to the lane's centre, rad/s; critically damped.
const LATERAL_RATE: f64 = 0.8;
/// Largest jerk of a vehicle that drives by itself: for acceleration, and for braking, m/s³.
const JERK: (f64, f64) = (4.0, 40.0);
/// Largest curvature (1/m) and yaw rate (rad/s) of a vehicle that drives by itself.
const TURN: (f64, f64) = (0.2, 0.5);
/// Time in which a driver returns to the usual time gap, s.
const GAP_RELAXATION_S: f64 = 10.0;
/// Least desired speed of cars and trucks within the speed limit, m/s: a recording may show them
/// only in a jam.
const DESIRED_SPEED_MIN: f64 = 13.9;
/// Hardest braking of a driver to let another vehicle in, m/s².
const COURTESY: f64 = 1.5;

/// Another vehicle, or the ego, as seen by vehicles that have left their recording.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Participant {
    /// The area that it covers.
    pub footprint: Footprint,
    /// m/s along its heading.
    pub speed: f64,
    /// m/s² along its heading.
    pub acceleration: f64,
}

/// How a vehicle moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Movement {
    /// Absent: its recording has not begun, or would begin inside another vehicle.
    Absent,
    /// It follows its recording.
    Replay,
    /// It drives by itself.
    Driving,
    /// It no longer moves: an object, or a pedestrian at the end of the recording.
    Standing,
}

/// One other road user.
#[derive(Clone, Debug)]
pub struct RoadUser {
    /// Its id in the scenario.
    pub id: i64,
    /// Kind.
    pub class: Class,
    /// Place, size and speed.
    pub participant: Participant,
    /// How it moves.
    pub mode: Movement,
    /// The lane that it is in.
    pub lane: LaneId,
    /// Its place in that lane.
    pub place: Frenet,
    /// Its pose as a frame.
    pub(crate) frame: LocalFrame,
    /// Change of `place.d`, m/s.
    lateral_speed: f64,
    /// The offset from the lane's centre that the driver aims at, m.
    aim: f64,
    driver: IdmParameters,
    /// Its time gap when it left its recording, s, and the time of that moment, s.
    begun: (f64, f64),
    /// The hardest braking for the ego so far, m/s², positive; 0 below 1.5 m/s².
    pub(crate) braked_for_ego: f64,
}

impl RoadUser {
    /// Returns whether it is present.
    #[must_use]
    pub fn is_present(&self) -> bool {
        self.mode != Movement::Absent
    }

    fn set_pose(&mut self, pose: Pose) {
        let turns = self.participant.footprint.pose.yaw.to_bits() != pose.yaw.to_bits();
        self.participant.footprint.pose = pose;
        self.frame = if turns {
            pose.frame()
        } else {
            self.frame.moved(pose.position)
        };
    }

    /// Returns the values on which its views depend.
    const fn motion(&self) -> (Pose, f64) {
        (self.participant.footprint.pose, self.participant.speed)
    }
}

/// A vehicle that the recording does not contain: the ego, or one that has left its recording.
#[derive(Debug)]
struct Deviating {
    /// Its index among all vehicles, see [`Traffic::participant`].
    index: usize,
    participant: Participant,
    forward: Vec2,
    velocity: Vec2,
    /// The distance that it can reach within the look-ahead time, including its body, m.
    farthest: f64,
}

impl Deviating {
    fn new(index: usize, participant: Participant, frame: &LocalFrame) -> Self {
        Self {
            index,
            participant,
            forward: frame.forward(),
            velocity: frame.forward() * participant.speed,
            farthest: farthest(participant.speed.abs(), &participant.footprint),
        }
    }

    /// Returns its predicted place after `dt`, at constant velocity.
    fn predicted(&self, dt: f64) -> Footprint {
        let Footprint { pose, .. } = self.participant.footprint;
        let position = pose.position + self.velocity * dt;
        Footprint {
            pose: Pose { position, ..pose },
            ..self.participant.footprint
        }
    }
}

/// Where a replayed vehicle will be.
struct Ahead {
    /// Time from now to scenario time `t`, s.
    dt: f64,
    t: f64,
    /// The vehicle is at most `by` from this point, m.
    near: Vec2,
    by: f64,
    /// The pose and the unit vector of its heading, once computed.
    pose: Option<(Pose, Vec2)>,
}

impl Ahead {
    fn new(track: &Track, now: f64, dt: f64) -> Self {
        let t = now + dt;
        let (near, by) = track.around(t);
        Self {
            dt,
            t,
            near,
            by,
            pose: None,
        }
    }

    fn pose(&mut self, track: &Track) -> (Pose, Vec2) {
        *self.pose.get_or_insert_with(|| {
            let pose = track.motion(self.t).pose;
            (pose, Vec2::from_angle(pose.yaw))
        })
    }
}

/// All other road users.
#[derive(Debug)]
pub struct Traffic {
    road: Arc<Road>,
    recordings: Arc<[Obstacle]>,
    tracks: Vec<Track>,
    vehicles: Vec<RoadUser>,
    /// In the order of the vehicles, the ego last. Renewed in each step.
    deviating: Vec<Deviating>,
    /// Views of each vehicle, and of the ego at the end. Discarded when it moves.
    views: Vec<Views>,
    /// No vehicle leaves its recording.
    as_recorded: bool,
}

impl Traffic {
    /// The traffic at time 0.
    #[must_use]
    pub fn new(road: Arc<Road>, recordings: Arc<[Obstacle]>, ego: &Participant) -> Self {
        Self::of(road, recordings, ego, false)
    }

    /// The same traffic at time 0, in which no vehicle leaves its recording.
    pub(crate) fn as_recorded(&self, ego: &Participant) -> Self {
        let (road, recordings) = (Arc::clone(&self.road), Arc::clone(&self.recordings));
        Self::of(road, recordings, ego, true)
    }

    fn of(
        road: Arc<Road>,
        recordings: Arc<[Obstacle]>,
        ego: &Participant,
        as_recorded: bool,
    ) -> Self {
        let tracks: Vec<Track> = recordings.iter().map(|it| Track::new(&it.states)).collect();
        let vehicles: Vec<RoadUser> = recordings
            .iter()
            .zip(&tracks)
            .map(|(recording, track)| vehicle(&road, recording, track))
            .collect();
        let mut views = vec![Views::default(); vehicles.len() + 1];
        for (views, vehicle) in views.iter_mut().zip(&vehicles) {
            views.renew(vehicle.frame.forward());
        }
        let mut traffic = Self {
            deviating: Vec::with_capacity(vehicles.len() + 1),
            views,
            road,
            recordings,
            tracks,
            vehicles,
            as_recorded,
        };
        traffic.step(0.0, 0.0, ego);
        traffic
    }

    /// Returns all road users, also absent ones, in the order of the scenario.
    #[must_use]
    pub fn vehicles(&self) -> &[RoadUser] {
        &self.vehicles
    }

    /// Moves all vehicles to time `t`, which is `dt` after the last call (s).
    pub fn step(&mut self, t: f64, dt: f64, ego: &Participant) {
        self.deviating.clear();
        let driving = self.vehicles.iter().enumerate();
        let driving = driving.filter(|(_, v)| v.mode == Movement::Driving);
        let driving = driving.map(|(index, v)| Deviating::new(index, v.participant, &v.frame));
        let frame = ego.footprint.pose.frame();
        self.views[self.vehicles.len()].renew(frame.forward());
        let last = Deviating::new(self.vehicles.len(), *ego, &frame);
        self.deviating.extend(driving.chain([last]));
        for index in 0..self.vehicles.len() {
            self.leave_recording_if_needed(index, t, ego);
        }
        // All decide on the present state, then all move: the order of the vehicles has no effect.
        for index in 0..self.vehicles.len() {
            if self.vehicles[index].mode == Movement::Driving {
                let (wanted, may_return, is_for_ego) = self.decision(index, t, ego);
                let vehicle = &mut self.vehicles[index];
                vehicle.aim = if may_return { 0.0 } else { vehicle.place.d };
                let change = wanted - vehicle.participant.acceleration;
                vehicle.participant.acceleration += change.clamp(-JERK.1 * dt, JERK.0 * dt);
                let braking = -vehicle.participant.acceleration;
                if is_for_ego && braking > REPLAY_BRAKES && vehicle.participant.speed > 0.0 {
                    vehicle.braked_for_ego = vehicle.braked_for_ego.max(braking);
                }
            }
        }
        let all = self.vehicles.iter_mut().zip(&mut self.views);
        for ((vehicle, views), track) in all.zip(&self.tracks) {
            match vehicle.mode {
                Movement::Absent | Movement::Standing => {}
                Movement::Replay => replay(vehicle, views, track, &self.road, t),
                Movement::Driving => {
                    let before = vehicle.motion();
                    drive(vehicle, &self.road, dt);
                    if vehicle.motion() != before {
                        views.renew(vehicle.frame.forward());
                    }
                }
            }
        }
    }

    /// Projects a vehicle: [`RoadLane::project_near`](crate::road::RoadLane::project_near).
    pub(crate) fn foot(&mut self, index: usize, lane: LaneId, near: f64) -> Foot {
        let pose = self.vehicles[index].participant.footprint.pose;
        self.views[index].foot(&self.road, lane, pose.position, near)
    }

    /// Returns bounds of the result of `foot`.
    pub(crate) fn rough(&mut self, index: usize, lane: LaneId, near: f64) -> Option<Rough> {
        let pose = self.vehicles[index].participant.footprint.pose;
        self.views[index].rough(&self.road, lane, pose.position, near)
    }

    fn leave_recording_if_needed(&mut self, index: usize, t: f64, ego: &Participant) {
        let (_, end) = self.tracks[index].span();
        let mode = self.vehicles[index].mode;
        match mode {
            Movement::Absent => self.appear_if_due(index, t),
            Movement::Replay if t > end && self.as_recorded => {
                self.vehicles[index].mode = Movement::Absent;
            }
            Movement::Replay if t > end => match self.vehicles[index].class {
                Class::Pedestrian | Class::Static => self.stand(index),
                _ => self.drive_on(index, t, ego),
            },
            Movement::Replay if !self.as_recorded && self.endangers(index, t) => {
                self.drive_on(index, t, ego)
            }
            _ => {}
        }
    }

    /// Makes a vehicle present when its recording begins; objects are always present.
    fn appear_if_due(&mut self, index: usize, t: f64) {
        let recording = &self.recordings[index];
        let (begin, end) = self.tracks[index].span();
        let over = t > end && recording.states.len() > 1;
        if !recording.is_static && (t < begin || over) {
            return;
        }
        let views = &mut self.views[index];
        let track = &self.tracks[index];
        replay(&mut self.vehicles[index], views, track, &self.road, t);
        let own = self.vehicles[index].participant;
        let claimed = own.footprint.grown(2.0 * own.speed.max(2.0), 0.5);
        let is_free =
            |other: &Deviating| self.as_recorded || !claimed.overlaps(&other.participant.footprint);
        if recording.is_static {
            self.stand(index);
        } else if t <= 0.0 || self.deviating.iter().all(is_free) {
            self.vehicles[index].mode = Movement::Replay;
        }
    }

    fn stand(&mut self, index: usize) {
        let vehicle = &mut self.vehicles[index];
        vehicle.mode = Movement::Standing;
        (vehicle.participant.speed, vehicle.participant.acceleration) = (0.0, 0.0);
        self.views[index].renew(vehicle.frame.forward());
    }

    /// Returns whether a replayed vehicle would need others to get out of its way.
    fn endangers(&mut self, index: usize, t: f64) -> bool {
        let vehicle = &self.vehicles[index];
        let speed = vehicle.participant.speed;
        let viewer = Viewer::new(&self.road, vehicle);
        let views = &mut self.views;
        let mut leader = Leader::NONE;
        for other in &self.deviating {
            viewer.nearer(&mut leader, &other.participant, &mut views[other.index]);
        }
        let closing = speed - leader.speed;
        let room = (leader.gap - 2.0).max(0.1);
        if closing > 0.0 && closing * closing / (2.0 * room) > REPLAY_BRAKES {
            return true;
        }
        if closing > -0.5 && leader.gap < 0.3 * speed {
            return true;
        }
        let track = &self.tracks[index];
        let own = vehicle.participant.footprint.grown(ROOM.0, ROOM.1);
        let own_farthest = farthest(track.speed_max(), &own);
        // Whether the two can touch within the look-ahead time; true if this is uncertain.
        let may_meet = |other: &&Deviating| {
            let apart = other.participant.footprint.pose.position - own.pose.position;
            let farthest = own_farthest + other.farthest;
            apart.dot(apart) < farthest * farthest
        };
        let mut ahead = None;
        let mut others = self.deviating.iter().filter(may_meet);
        others.any(|other| {
            let ahead =
                ahead.get_or_insert_with(|| LOOK_AHEADS_S.map(|dt| Ahead::new(track, t, dt)));
            self.would_hit_from_the_side(index, ahead, other)
        })
    }

    fn would_hit_from_the_side(
        &self,
        index: usize,
        ahead: &mut [Ahead],
        other: &Deviating,
    ) -> bool {
        let vehicle = &self.vehicles[index];
        let reach = reach(&vehicle.participant.footprint, &other.participant.footprint);
        let track = &self.tracks[index];
        let overlaps = ahead.iter_mut().any(|it| {
            let predicted = other.predicted(it.dt);
            let farthest = it.by + reach;
            let apart = predicted.pose.position - it.near;
            if apart.dot(apart) > farthest * farthest {
                return false;
            }
            let (pose, forward) = it.pose(track);
            let own = vehicle.participant.footprint.grown(ROOM.0, ROOM.1);
            Footprint { pose, ..own }.overlaps_along(forward, &predicted, other.forward)
        });
        overlaps && {
            let place = self
                .road
                .lane(vehicle.lane)
                .project_near(other.participant.footprint.pose.position, vehicle.place.s);
            let in_own_lane = place.d.abs() < (vehicle.participant.footprint.width + 1.0) / 2.0;
            !in_own_lane
        }
    }

    /// Changes the vehicle from replay to driving by itself.
    fn drive_on(&mut self, index: usize, t: f64, ego: &Participant) {
        let leader = self.leader(index, ego);
        let vehicle = &mut self.vehicles[index];
        // Some recordings roll backwards at a standstill.
        vehicle.participant.speed = vehicle.participant.speed.max(0.0);
        let (yaw, speed) = (
            vehicle.participant.footprint.pose.yaw,
            vehicle.participant.speed,
        );
        let lane = self.road.lane(vehicle.lane);
        let heading = lane.line.at(vehicle.place.s).heading;
        vehicle.lateral_speed = speed * wrap_angle(yaw - heading).sin();
        vehicle.mode = Movement::Driving;
        let gap = (leader.gap - vehicle.driver.standstill_gap) / speed.max(1.0);
        vehicle.begun = (gap.clamp(0.4, vehicle.driver.time_gap), t);
        self.views[index].renew(vehicle.frame.forward());
        let place = self.deviating.partition_point(|it| it.index < index);
        let own = Deviating::new(index, vehicle.participant, &vehicle.frame);
        self.deviating.insert(place, own);
    }

    /// Returns the acceleration that the driver wants, whether the lane's middle is free, and
    /// whether that acceleration is for the ego.
    fn decision(&mut self, index: usize, t: f64, ego: &Participant) -> (f64, bool, bool) {
        let vehicle = &self.vehicles[index];
        let speed = vehicle.participant.speed;
        let lane = self.road.lane(vehicle.lane);
        let bend = [0.0, 1.0, 2.0, 3.0]
            .map(|seconds| lane.curvature_at(vehicle.place.s + seconds * speed).abs())
            .into_iter()
            .fold(1e-6, f64::max);
        let relaxed = ((t - vehicle.begun.1) / GAP_RELAXATION_S).min(1.0);
        let habitual = vehicle.driver.time_gap;
        let driver = IdmParameters {
            time_gap: vehicle.begun.0 + (habitual - vehicle.begun.0) * relaxed,
            desired_speed: vehicle
                .driver
                .desired_speed
                .min((CURVE_ACCELERATION / bend).sqrt()),
            ..vehicle.driver
        };
        let viewer = Viewer::new(&self.road, vehicle);
        let mut leader = self.end_of_lane(vehicle);
        let mut courtesy = f64::INFINITY;
        let mut may_return = true;
        let mut is_for_ego = false;
        let ending = viewer.ending_beside();
        let passes = ending == [None; 2];
        others(&self.vehicles, &mut self.views, index, ego).for_each(|(other, views)| {
            let Some(seen) = viewer.see(other, views, passes) else {
                return;
            };
            if let Some(ahead) = sight::ahead(vehicle, other, &seen)
                && ahead.gap < leader.gap
            {
                leader = ahead;
                is_for_ego = std::ptr::eq(other, ego);
            }
            let merging = { ending.iter().flatten() }
                .find_map(|lane| sight::merging(&self.road, vehicle, *lane, other, &seen));
            if let Some(merging) = merging {
                courtesy = courtesy.min(driver.follow(speed, &merging).max(-COURTESY));
            }
            may_return &= !sight::blocks_return(vehicle, other, &seen);
        });
        let in_the_middle = vehicle.place.d.abs() < 0.2;
        let wanted = driver.follow(speed, &leader).min(courtesy);
        (wanted, in_the_middle || may_return, is_for_ego)
    }

    fn leader(&mut self, index: usize, ego: &Participant) -> Leader {
        let vehicle = &self.vehicles[index];
        let viewer = Viewer::new(&self.road, vehicle);
        let end = self.end_of_lane(vehicle);
        let mut leader = end;
        others(&self.vehicles, &mut self.views, index, ego)
            .for_each(|(other, views)| viewer.nearer(&mut leader, other, views));
        leader
    }

    /// Returns the end of the lane as a standing leader.
    fn end_of_lane(&self, vehicle: &RoadUser) -> Leader {
        let end = self.road.distance_to_end(vehicle.lane, vehicle.place.s);
        Leader::standing(end - vehicle.participant.footprint.length / 2.0)
    }
}

/// Returns the largest distance of a part of the vehicle from its present place within the
/// look-ahead time plus 10 %, m.
fn farthest(speed_max: f64, footprint: &Footprint) -> f64 {
    speed_max * (LOOK_AHEAD_S * 1.1) + (footprint.length + footprint.width) / 2.0
}

/// A replayed vehicle with room around it and another one overlap only if their centres are nearer
/// than this, m.
fn reach(replayed: &Footprint, other: &Footprint) -> f64 {
    let sides = |it: &Footprint| it.length + it.width;
    (sides(replayed) + ROOM.0 + ROOM.1 + sides(other)) / 2.0
}

/// Returns all others that are present, and the ego, with the views of each.
fn others<'a>(
    vehicles: &'a [RoadUser],
    views: &'a mut [Views],
    index: usize,
    ego: &'a Participant,
) -> impl Iterator<Item = (&'a Participant, &'a mut Views)> {
    let all = vehicles.iter().map(Some).chain([None]).zip(views);
    all.enumerate()
        .filter(move |(i, (other, _))| {
            *i != index && other.is_none_or(|vehicle| vehicle.is_present())
        })
        .map(move |(_, (other, views))| (other.map_or(ego, |it| &it.participant), views))
}

fn vehicle(road: &Road, recording: &Obstacle, track: &Track) -> RoadUser {
    let motion = track.motion(f64::NEG_INFINITY);
    let (lane, place) = road.locate(motion.pose.position, motion.pose.yaw);
    let fastest = recording
        .states
        .iter()
        .filter_map(|state| state.speed)
        .fold(0.0, f64::max);
    let usual = match recording.class {
        Class::Car | Class::Truck => DESIRED_SPEED_MIN,
        _ => 1.0,
    };
    let desired_speed = fastest.max(usual.min(road.lane(lane).at(place.s).speed_limit));
    let driver = if recording.length > 8.0 {
        IdmParameters::TRUCK
    } else {
        IdmParameters::CAR
    };
    RoadUser {
        id: recording.id,
        class: recording.class,
        participant: Participant {
            footprint: Footprint {
                pose: motion.pose,
                length: recording.length,
                width: recording.width,
            },
            speed: if recording.is_static {
                0.0
            } else {
                motion.speed
            },
            acceleration: 0.0,
        },
        mode: Movement::Absent,
        lane,
        place,
        frame: motion.pose.frame(),
        lateral_speed: 0.0,
        aim: 0.0,
        driver: IdmParameters {
            desired_speed,
            ..driver
        },
        begun: (driver.time_gap, 0.0),
        braked_for_ego: 0.0,
    }
}

/// Moves a vehicle to its recorded place at time `t`.
fn replay(vehicle: &mut RoadUser, views: &mut Views, track: &Track, road: &Road, t: f64) {
    let before = vehicle.motion();
    let motion = track.motion(t);
    vehicle.set_pose(motion.pose);
    vehicle.participant.speed = motion.speed;
    vehicle.participant.acceleration = motion.acceleration;
    if vehicle.motion() != before {
        views.renew(vehicle.frame.forward());
    }
    let width = road.lane(vehicle.lane).width_at(vehicle.place.s);
    let (position, near) = (motion.pose.position, vehicle.place.s);
    vehicle.place = views.foot(road, vehicle.lane, position, near).place;
    if vehicle.place.d.abs() > width / 2.0 {
        (vehicle.lane, vehicle.place) = road.locate(motion.pose.position, motion.pose.yaw);
    }
}

/// Moves a vehicle that drives by itself.
fn drive(vehicle: &mut RoadUser, road: &Road, dt: f64) {
    let lane = road.lane(vehicle.lane);
    let curvature = lane.curvature_at(vehicle.place.s);
    let before = vehicle.participant.speed;
    let speed = (before + vehicle.participant.acceleration * dt).max(0.0);
    if speed == 0.0 {
        vehicle.participant.acceleration = vehicle.participant.acceleration.max(0.0);
    }
    let pull = -LATERAL_RATE * LATERAL_RATE * (vehicle.place.d - vehicle.aim)
        - 2.0 * LATERAL_RATE * vehicle.lateral_speed;
    let mean = (before + speed) / 2.0;
    vehicle.lateral_speed = (vehicle.lateral_speed + pull * dt).clamp(-0.2 * mean, 0.2 * mean);
    let along = (mean * mean - vehicle.lateral_speed * vehicle.lateral_speed)
        .max(0.0)
        .sqrt();
    vehicle.place.s += along * dt / (1.0 - curvature * vehicle.place.d).max(0.5);
    vehicle.place.d += vehicle.lateral_speed * dt;
    let line = lane.line.at(vehicle.place.s);
    let yaw = line.heading + vehicle.lateral_speed.atan2(along);
    let before = vehicle.participant.footprint.pose.yaw;
    // No vehicle turns on the spot: curvature is limited, and so is the yaw rate.
    let turn = (TURN.0 * mean).min(TURN.1) * dt;
    let yaw = before + wrap_angle(yaw - before).clamp(-turn, turn);
    let position = line.beside(vehicle.place.d);
    vehicle.set_pose(Pose {
        position,
        yaw: wrap_angle(yaw),
    });
    vehicle.participant.speed = speed;
}

#[cfg(test)]
mod tests;
