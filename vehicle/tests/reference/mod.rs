//! A reference driver with perfect knowledge: proves that a scenario can be driven at all.

use tandem_bus::{Control, FrameTransmitter, Message, ModeCode, RoleCode};
use tandem_vehicle::geometry::Vec2;
use tandem_vehicle::traffic::{IdmParameters, Leader};
use tandem_vehicle::{LaneId, World, WorldSnapshot};

/// Distance between the axles, m.
const WHEELBASE: f64 = 2.579;

/// How the driver drives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Manner {
    /// Drives correctly.
    Normal,
    /// Brakes to a standstill after 5 s and stays there.
    StopsInLane,
    /// Drives at 60 percent of the speed that the others expect.
    Dawdles,
    /// Changes lanes into every gap.
    ChangesLanes,
    /// Sends one frame and then nothing: the vehicle acts on its own.
    Absent,
}

/// Follows the leader by the Intelligent Driver Model and the lane by pure pursuit (Coulter 1992).
pub(crate) struct ReferenceDriver {
    manner: Manner,
    transmitter: FrameTransmitter,
    lane: Option<LaneId>,
    /// When the lane was chosen, s.
    chosen_s: f64,
}

impl ReferenceDriver {
    pub(crate) fn new(manner: Manner) -> Self {
        Self {
            manner,
            transmitter: FrameTransmitter::new(),
            lane: None,
            chosen_s: 0.0,
        }
    }

    /// Returns the control frame for the present state of the world.
    pub(crate) fn control(&mut self, world: &World) -> tandem_bus::Encoded {
        let now = world.snapshot();
        let target = self.choose_lane(world);
        let silent = self.manner == Manner::Absent && now.running;
        let control = Control {
            role: if silent {
                RoleCode::Standby
            } else {
                RoleCode::Master
            },
            mode: ModeCode::L3,
            term: 2,
            steering_angle: steering(world, now, target) as f32,
            acceleration: self.acceleration(world, target) as f32,
            ..Control::default()
        };
        self.transmitter
            .encode(&Message::Control { system: 0, control })
    }

    fn acceleration(&self, world: &World, target: LaneId) -> f64 {
        let now = world.snapshot();
        let desired_speed = match self.manner {
            Manner::Dawdles => 0.6 * world.set_speed(),
            _ => world.set_speed(),
        };
        let wanted = acceleration(world, now, target, desired_speed);
        let stops = self.manner == Manner::StopsInLane && now.time_s > 5.0;
        if stops { wanted.min(-2.5) } else { wanted }
    }

    /// Leaves a lane that ends as soon as there is a gap beside it.
    fn choose_lane(&mut self, world: &World) -> LaneId {
        let now = world.snapshot();
        let target = *self.lane.get_or_insert(now.lane);
        let road = world.road();
        let station = |lane| road.lane(lane).project(now.pose.position).s;
        let restless = self.manner == Manner::ChangesLanes && now.time_s > self.chosen_s + 7.0;
        if !restless && road.distance_to_end(target, station(target)) > 600.0 {
            return target;
        }
        let section = road.lane(target).at(station(target));
        let beside = [section.left, section.right].into_iter().flatten();
        let goes_on = |lane: &LaneId| road.distance_to_end(*lane, station(*lane)) > 1_000.0;
        let free = |lane: &LaneId| {
            let (ahead, behind) = neighbours(world, now, *lane);
            let room =
                |gap: f64, closing: f64| gap > 6.0 + 2.0 * closing.max(0.0) + 0.3 * now.speed;
            room(ahead.gap, now.speed - ahead.speed) && room(behind.gap, behind.speed - now.speed)
        };
        if let Some(lane) = beside.filter(goes_on).find(free) {
            (self.lane, self.chosen_s) = (Some(lane), now.time_s);
        }
        self.lane.unwrap_or(target)
    }
}

/// Returns the nearest vehicles ahead and behind in a lane.
fn neighbours(world: &World, now: &WorldSnapshot, lane: LaneId) -> (Leader, Leader) {
    let line = world.road().lane(lane);
    let own = line.project(now.pose.position);
    let (mut ahead, mut behind) = (Leader::NONE, Leader::NONE);
    for other in &now.vehicles {
        if (other.pose.position - now.pose.position).norm() > 250.0 {
            continue;
        }
        let place = line.project(other.pose.position);
        let drift = other.speed * (other.pose.yaw - line.at(place.s).heading).sin();
        let reach = 1.2 + other.width / 2.0;
        let in_the_way = place.d.abs() < reach || (place.d + 0.8 * drift).abs() < reach;
        if !in_the_way {
            continue;
        }
        let gap = (place.s - own.s).abs() - (other.length + 4.508) / 2.0;
        let side = if place.s > own.s {
            &mut ahead
        } else {
            &mut behind
        };
        if gap < side.gap {
            let (speed, acceleration) = (other.speed, other.acceleration);
            *side = Leader {
                gap,
                speed,
                acceleration,
            };
        }
    }
    (ahead, behind)
}

fn acceleration(world: &World, now: &WorldSnapshot, target: LaneId, desired_speed: f64) -> f64 {
    let driver = IdmParameters {
        desired_speed,
        time_gap: 1.3,
        ..IdmParameters::CAR
    };
    let mut wanted = f64::INFINITY;
    for lane in [target, now.lane] {
        let (ahead, _) = neighbours(world, now, lane);
        wanted = wanted.min(driver.follow(now.speed, &ahead));
    }
    let line = world.road().lane(now.lane);
    let station = line.project(now.pose.position).s;
    let end = world.road().distance_to_end(now.lane, station) - 10.0;
    if target == now.lane && end.is_finite() {
        wanted = wanted.min(driver.follow(now.speed, &Leader::standing(end.max(0.1))));
        // Fall in behind the one ahead in the next lane, gently.
        let section = line.at(station);
        for lane in [section.left, section.right]
            .into_iter()
            .flatten()
            .filter(|_| end < 600.0)
        {
            let (ahead, _) = neighbours(world, now, lane);
            wanted = wanted.min(driver.follow(now.speed, &ahead).max(-1.0));
        }
    }
    wanted
}

fn steering(world: &World, now: &WorldSnapshot, target: LaneId) -> f64 {
    let line = world.road().lane(target);
    let place = line.project(now.pose.position);
    let ahead = 8.0 + 1.0 * now.speed;
    // Approach a lane to the side gradually.
    let aim = line.at(place.s + ahead);
    let side = place.d.clamp(-1.75, 1.75) - place.d;
    let aim = aim.centre - Vec2::from_angle(aim.heading).left() * side;
    let aim = now.pose.to_local(aim);
    (2.0 * WHEELBASE * aim.y / aim.dot(aim)).atan()
}
