//! The other road users: they replay their recording, and then drive on.
//!
//! A recording does not react: it was made around another ego, and it is short. So each vehicle
//! changes from replay to driving by itself, for good, when
//!
//! - its recording ends;
//! - it would have to brake with more than 1.5 m/s² for the ego, or for a vehicle that drives
//!   by itself already, ahead of it; or it is about to come too close;
//! - it would hit one of these from the side within a second by changing lanes: it stays in
//!   the lane that it is in, as a driver who looks first.
//!
//! By itself it keeps its lane and follows by the Intelligent Driver Model, beginning with the
//! speed, heading and time gap that it has at that moment. It knows the ego and all others, slows
//! down for curves, stops at the end of a lane, and lets in who has to leave a lane that ends.

mod idm;
pub(crate) mod recording;
mod sight;

use std::sync::Arc;

pub use idm::{Driver, Leader};

use crate::commonroad::{Class, Obstacle};
use crate::geometry::{Footprint, Pose, Vec2, wrap_angle};
use crate::road::{Frenet, LaneId, Road};
use sight::Viewer;

/// A replayed vehicle gives up its recording rather than rely on others' braking, m/s².
const REPLAY_BRAKES: f64 = 1.5;
/// How far a replayed lane change is checked in advance, s.
const LOOK_AHEAD_S: f64 = 1.0;
/// Comfortable lateral acceleration in curves, m/s².
const CURVE_ACCELERATION: f64 = 2.5;
/// Natural frequency of the return to the lane's centre, rad/s; critically damped.
const LATERAL_RATE: f64 = 0.8;
/// Largest jerk of a vehicle that drives by itself: pressing the pedal, and braking, m/s³.
const JERK: (f64, f64) = (4.0, 40.0);
/// Largest curvature (1/m) and yaw rate (rad/s) of a vehicle that drives by itself.
const TURN: (f64, f64) = (0.2, 0.5);
/// Time in which a driver returns to the own habitual time gap, s.
const GAP_RELAXATION_S: f64 = 10.0;
/// Cars and trucks want to go this fast if the speed limit allows, m/s: a recording may show them
/// in a jam only.
const DESIRED_SPEED_MIN: f64 = 13.9;
/// Hardest braking of a driver to let another vehicle in, m/s².
const COURTESY: f64 = 1.5;

/// What another vehicle, or the ego, is to those who drive by themselves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Participant {
    /// What it covers.
    pub footprint: Footprint,
    /// m/s along its heading.
    pub speed: f64,
    /// m/s² along its heading.
    pub acceleration: f64,
}

impl Participant {
    fn velocity(&self) -> Vec2 {
        Vec2::from_angle(self.footprint.pose.yaw) * self.speed
    }

    /// Where it will be, going straight on.
    fn predicted(&self, dt: f64) -> Footprint {
        let Footprint { pose, .. } = self.footprint;
        let position = pose.position + self.velocity() * dt;
        Footprint {
            pose: Pose { position, ..pose },
            ..self.footprint
        }
    }
}

/// How a vehicle moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Not in the picture: its recording has not begun, or it would begin inside another vehicle.
    Absent,
    /// By its recording.
    Replay,
    /// By itself.
    Driving,
    /// Not at all any more: a thing, or a person at the end of the recording.
    Standing,
}

/// One other road user.
#[derive(Clone, Debug)]
pub struct Vehicle {
    /// Its id in the scenario.
    pub id: i64,
    /// Kind.
    pub class: Class,
    /// Where, how large, how fast.
    pub participant: Participant,
    /// How it moves.
    pub mode: Mode,
    /// The lane that it is in.
    pub lane: LaneId,
    /// Its place in that lane.
    pub place: Frenet,
    /// Change of `place.d`, m/s.
    lateral_speed: f64,
    /// The offset from the lane's centre that the driver goes to, m.
    aim: f64,
    driver: Driver,
    /// Time gap that it began with when it left its recording, s, and when that was.
    begun: (f64, f64),
}

impl Vehicle {
    /// Whether it is in the picture.
    #[must_use]
    pub fn is_present(&self) -> bool {
        self.mode != Mode::Absent
    }
}

/// All other road users.
#[derive(Debug)]
pub struct Traffic {
    road: Arc<Road>,
    recordings: Arc<[Obstacle]>,
    vehicles: Vec<Vehicle>,
}

impl Traffic {
    /// The traffic at time 0.
    #[must_use]
    pub fn new(road: Arc<Road>, recordings: Arc<[Obstacle]>, ego: &Participant) -> Self {
        let vehicles = recordings
            .iter()
            .map(|recording| vehicle(&road, recording))
            .collect();
        let mut traffic = Self {
            road,
            recordings,
            vehicles,
        };
        traffic.step(0.0, 0.0, ego);
        traffic
    }

    /// All of them, also those not present, in the order of the scenario.
    #[must_use]
    pub fn vehicles(&self) -> &[Vehicle] {
        &self.vehicles
    }

    /// Moves all vehicles to time `t`, which is `dt` after the last call (s).
    pub fn step(&mut self, t: f64, dt: f64, ego: &Participant) {
        for index in 0..self.vehicles.len() {
            self.leave_recording_if_needed(index, t, ego);
        }
        // All decide on what they see now, then all move: the order of the vehicles does not
        // matter.
        for index in 0..self.vehicles.len() {
            if self.vehicles[index].mode == Mode::Driving {
                let (wanted, may_return) = self.decision(index, t, ego);
                let vehicle = &mut self.vehicles[index];
                vehicle.aim = if may_return { 0.0 } else { vehicle.place.d };
                let change = wanted - vehicle.participant.acceleration;
                vehicle.participant.acceleration += change.clamp(-JERK.1 * dt, JERK.0 * dt);
            }
        }
        for (vehicle, recording) in self.vehicles.iter_mut().zip(self.recordings.iter()) {
            match vehicle.mode {
                Mode::Absent | Mode::Standing => {}
                Mode::Replay => replay(vehicle, recording, &self.road, t),
                Mode::Driving => drive(vehicle, &self.road, dt),
            }
        }
    }

    fn leave_recording_if_needed(&mut self, index: usize, t: f64, ego: &Participant) {
        let states = &self.recordings[index].states;
        let (_, end) = recording::span(states);
        match self.vehicles[index].mode {
            Mode::Absent => self.appear_if_due(index, t, ego),
            Mode::Replay if t > end => match self.vehicles[index].class {
                Class::Pedestrian | Class::Static => self.stand(index),
                _ => self.drive_on(index, t, ego),
            },
            Mode::Replay if self.endangers(index, t, ego) => self.drive_on(index, t, ego),
            _ => {}
        }
    }

    /// Puts a vehicle into the picture when its recording begins; things are always there.
    fn appear_if_due(&mut self, index: usize, t: f64, ego: &Participant) {
        let recording = &self.recordings[index];
        let (begin, end) = recording::span(&recording.states);
        let over = t > end && recording.states.len() > 1;
        if !recording.is_static && (t < begin || over) {
            return;
        }
        replay(&mut self.vehicles[index], recording, &self.road, t);
        let own = self.vehicles[index].participant;
        let claimed = own.footprint.grown(2.0 * own.speed.max(2.0), 0.5);
        let is_free = |other: Participant| !claimed.overlaps(&other.footprint);
        if recording.is_static {
            self.stand(index);
        } else if t <= 0.0 || self.deviating(index, ego).all(is_free) {
            self.vehicles[index].mode = Mode::Replay;
        }
    }

    fn stand(&mut self, index: usize) {
        let vehicle = &mut self.vehicles[index];
        vehicle.mode = Mode::Standing;
        (vehicle.participant.speed, vehicle.participant.acceleration) = (0.0, 0.0);
    }

    /// The ego and all who drive by themselves: those whom a recording does not know.
    fn deviating(&self, index: usize, ego: &Participant) -> impl Iterator<Item = Participant> {
        let others = self.vehicles.iter().enumerate();
        let others = others.filter(move |(i, v)| *i != index && v.mode == Mode::Driving);
        others.map(|(_, v)| v.participant).chain([*ego])
    }

    /// Whether a replayed vehicle would need others to get out of its way.
    fn endangers(&self, index: usize, t: f64, ego: &Participant) -> bool {
        let vehicle = &self.vehicles[index];
        let speed = vehicle.participant.speed;
        let viewer = Viewer::new(&self.road, vehicle);
        let leader = self
            .deviating(index, ego)
            .filter_map(|other| viewer.ahead(&other))
            .fold(Leader::NONE, nearer);
        let closing = speed - leader.speed;
        let room = (leader.gap - 2.0).max(0.1);
        if closing > 0.0 && closing * closing / (2.0 * room) > REPLAY_BRAKES {
            return true;
        }
        if closing > -0.5 && leader.gap < 0.3 * speed {
            return true;
        }
        self.would_hit_from_the_side(index, t, ego)
    }

    fn would_hit_from_the_side(&self, index: usize, t: f64, ego: &Participant) -> bool {
        let vehicle = &self.vehicles[index];
        let states = &self.recordings[index].states;
        [0.25, 0.5, 0.75, 1.0]
            .iter()
            .map(|share| share * LOOK_AHEAD_S)
            .any(|dt| {
                let pose = recording::motion(states, t + dt).pose;
                let own = Footprint {
                    pose,
                    ..vehicle.participant.footprint
                }
                .grown(1.0, 0.2);
                self.deviating(index, ego).any(|other| {
                    if !own.overlaps(&other.predicted(dt)) {
                        return false;
                    }
                    let place = self
                        .road
                        .lane(vehicle.lane)
                        .project_near(other.footprint.pose.position, vehicle.place.s);
                    let in_own_lane =
                        place.d.abs() < (vehicle.participant.footprint.width + 1.0) / 2.0;
                    !in_own_lane
                })
            })
    }

    /// From now on the vehicle drives by itself.
    fn drive_on(&mut self, index: usize, t: f64, ego: &Participant) {
        let leader = self.leader(index, ego);
        let vehicle = &mut self.vehicles[index];
        // Some recordings roll backwards at a standstill.
        vehicle.participant.speed = vehicle.participant.speed.max(0.0);
        let (yaw, speed) = (
            vehicle.participant.footprint.pose.yaw,
            vehicle.participant.speed,
        );
        let heading = self.road.lane(vehicle.lane).at(vehicle.place.s).heading;
        vehicle.lateral_speed = speed * wrap_angle(yaw - heading).sin();
        vehicle.mode = Mode::Driving;
        let gap = (leader.gap - vehicle.driver.standstill_gap) / speed.max(1.0);
        vehicle.begun = (gap.clamp(0.4, vehicle.driver.time_gap), t);
    }

    /// The acceleration that the driver wants, and whether the lane's middle is free to go to.
    fn decision(&self, index: usize, t: f64, ego: &Participant) -> (f64, bool) {
        let vehicle = &self.vehicles[index];
        let speed = vehicle.participant.speed;
        let lane = self.road.lane(vehicle.lane);
        let bend = [0.0, 1.0, 2.0, 3.0]
            .map(|seconds| lane.at(vehicle.place.s + seconds * speed).curvature.abs())
            .into_iter()
            .fold(1e-6, f64::max);
        let relaxed = ((t - vehicle.begun.1) / GAP_RELAXATION_S).min(1.0);
        let habitual = vehicle.driver.time_gap;
        let driver = Driver {
            time_gap: vehicle.begun.0 + (habitual - vehicle.begun.0) * relaxed,
            desired_speed: vehicle
                .driver
                .desired_speed
                .min((CURVE_ACCELERATION / bend).sqrt()),
            ..vehicle.driver
        };
        let viewer = Viewer::new(&self.road, vehicle);
        let ending: Vec<LaneId> = viewer.ending_beside().collect();
        let mut leader = self.end_of_lane(vehicle);
        let mut courtesy = f64::INFINITY;
        let mut may_return = true;
        for other in self.others(index, ego) {
            let Some(seen) = viewer.see(&other) else {
                continue;
            };
            if let Some(ahead) = sight::ahead(vehicle, &other, &seen) {
                leader = nearer(leader, ahead);
            }
            let merging = ending
                .iter()
                .find_map(|lane| sight::merging(&self.road, vehicle, *lane, &other, &seen));
            if let Some(merging) = merging {
                courtesy = courtesy.min(driver.follow(speed, &merging).max(-COURTESY));
            }
            may_return &= !sight::blocks_return(vehicle, &other, &seen);
        }
        let in_the_middle = vehicle.place.d.abs() < 0.2;
        let wanted = driver.follow(speed, &leader).min(courtesy);
        (wanted, in_the_middle || may_return)
    }

    /// All others that are present, and the ego.
    fn others(&self, index: usize, ego: &Participant) -> impl Iterator<Item = Participant> {
        let others = self.vehicles.iter().enumerate();
        let others = others.filter(move |(i, v)| *i != index && v.is_present());
        others.map(|(_, v)| v.participant).chain([*ego])
    }

    fn leader(&self, index: usize, ego: &Participant) -> Leader {
        let vehicle = &self.vehicles[index];
        let viewer = Viewer::new(&self.road, vehicle);
        self.others(index, ego)
            .filter_map(|other| viewer.ahead(&other))
            .fold(self.end_of_lane(vehicle), nearer)
    }

    /// The end of the lane as a leader that stands.
    fn end_of_lane(&self, vehicle: &Vehicle) -> Leader {
        let end = self.road.distance_to_end(vehicle.lane, vehicle.place.s);
        Leader::standing(end - vehicle.participant.footprint.length / 2.0)
    }
}

fn nearer(a: Leader, b: Leader) -> Leader {
    if b.gap < a.gap { b } else { a }
}

fn vehicle(road: &Road, recording: &Obstacle) -> Vehicle {
    let motion = recording::motion(&recording.states, f64::NEG_INFINITY);
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
        Driver::TRUCK
    } else {
        Driver::CAR
    };
    Vehicle {
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
        mode: Mode::Absent,
        lane,
        place,
        lateral_speed: 0.0,
        aim: 0.0,
        driver: Driver {
            desired_speed,
            ..driver
        },
        begun: (driver.time_gap, 0.0),
    }
}

/// Puts a vehicle where its recording has it at time `t`.
fn replay(vehicle: &mut Vehicle, recording: &Obstacle, road: &Road, t: f64) {
    let motion = recording::motion(&recording.states, t);
    vehicle.participant.footprint.pose = motion.pose;
    vehicle.participant.speed = motion.speed;
    vehicle.participant.acceleration = motion.acceleration;
    let section = road.lane(vehicle.lane).at(vehicle.place.s);
    vehicle.place = road
        .lane(vehicle.lane)
        .project_near(motion.pose.position, vehicle.place.s);
    if vehicle.place.d.abs() > section.width / 2.0 {
        (vehicle.lane, vehicle.place) = road.locate(motion.pose.position, motion.pose.yaw);
    }
}

/// Moves a vehicle that drives by itself.
fn drive(vehicle: &mut Vehicle, road: &Road, dt: f64) {
    let lane = road.lane(vehicle.lane);
    let section = lane.at(vehicle.place.s);
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
    vehicle.place.s += along * dt / (1.0 - section.curvature * vehicle.place.d).max(0.5);
    vehicle.place.d += vehicle.lateral_speed * dt;
    let yaw = lane.at(vehicle.place.s).heading + vehicle.lateral_speed.atan2(along);
    let before = vehicle.participant.footprint.pose.yaw;
    // No vehicle turns on the spot: curvature is limited, and so is the yaw rate.
    let turn = (TURN.0 * mean).min(TURN.1) * dt;
    let yaw = before + wrap_angle(yaw - before).clamp(-turn, turn);
    let position = lane.point(vehicle.place);
    vehicle.participant.footprint.pose = Pose {
        position,
        yaw: wrap_angle(yaw),
    };
    vehicle.participant.speed = speed;
}

#[cfg(test)]
mod tests;
