//! Scene and trajectory as words of the LMU, and back.
//!
//! Values in shared memory are not trusted: decoding checks every count, tag and number, and
//! refuses the whole value if one is impossible. Numbers cross as IEEE 754 bits.

use crate::driving::knowledge::{Knowledge, KnownLine, KnownObject, KnownPlan, PLAN_POINTS};
use crate::driving::types::{
    ClassCode, Command, ControlStep, Ego, Lanes, MAX_OBJECTS, Maneuver, Memory, Object, RouteCode,
    Scene, TRAJECTORY_SAMPLES, Trajectory, TrajectoryPoint,
};
use heapless::Vec;
use tandem_board::Instant;
pub use tandem_shm::{Corrupt, Payload};

/// Largest magnitude that a physical quantity may have: far above all that occurs, and small enough
/// that no product of three overflows.
const LIMIT: f32 = 1e6;

fn put_f32s(put: &mut impl FnMut(u32), values: &[f32]) {
    for value in values {
        put(value.to_bits());
    }
}

fn finite(take: &mut impl FnMut() -> u32) -> Result<f32, Corrupt> {
    let value = f32::from_bits(take());
    if value.abs() <= LIMIT {
        Ok(value)
    } else {
        Err(Corrupt)
    }
}

/// A distance or speed that may be infinite ("none in sight").
fn unbounded(take: &mut impl FnMut() -> u32) -> Result<f32, Corrupt> {
    let value = f32::from_bits(take());
    if value == f32::INFINITY || value.abs() <= LIMIT {
        Ok(value)
    } else {
        Err(Corrupt)
    }
}

fn flag(take: &mut impl FnMut() -> u32) -> Result<bool, Corrupt> {
    match take() {
        0 => Ok(false),
        1 => Ok(true),
        _ => Err(Corrupt),
    }
}

fn put_option(put: &mut impl FnMut(u32), value: Option<f32>) {
    put(u32::from(value.is_some()));
    put(value.unwrap_or(0.0).to_bits());
}

fn option(take: &mut impl FnMut() -> u32) -> Result<Option<f32>, Corrupt> {
    let some = flag(take)?;
    let value = finite(take)?;
    Ok(some.then_some(value))
}

fn put_instant(put: &mut impl FnMut(u32), at: Instant) {
    at.to_words().into_iter().for_each(put);
}

fn instant(take: &mut impl FnMut() -> u32) -> Instant {
    let low = take();
    Instant::from_words([low, take()])
}

impl Payload for Ego {
    const WORDS: usize = 5;

    fn store(&self, put: &mut impl FnMut(u32)) {
        let Self {
            speed,
            yaw_rate,
            acceleration,
            steering_angle,
            slip_angle,
        } = *self;
        put_f32s(
            put,
            &[speed, yaw_rate, acceleration, steering_angle, slip_angle],
        );
    }

    fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        Ok(Self {
            speed: finite(take)?,
            yaw_rate: finite(take)?,
            acceleration: finite(take)?,
            steering_angle: finite(take)?,
            slip_angle: finite(take)?,
        })
    }
}

impl Payload for Lanes {
    const WORDS: usize = 15;

    fn store(&self, put: &mut impl FnMut(u32)) {
        put_f32s(put, &self.c);
        put_f32s(put, &[self.view_range, self.width]);
        put_option(put, self.left);
        put_option(put, self.right);
        put_f32s(
            put,
            &[
                self.own_end,
                self.left_end,
                self.right_end,
                self.speed_limit,
            ],
        );
        put(u32::from(self.ends_domain));
    }

    fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        Ok(Self {
            c: [finite(take)?, finite(take)?, finite(take)?, finite(take)?],
            view_range: finite(take)?,
            width: finite(take)?,
            left: option(take)?,
            right: option(take)?,
            own_end: unbounded(take)?,
            left_end: unbounded(take)?,
            right_end: unbounded(take)?,
            speed_limit: unbounded(take)?,
            ends_domain: flag(take)?,
        })
    }
}

impl Payload for Object {
    const WORDS: usize = 10;

    fn store(&self, put: &mut impl FnMut(u32)) {
        put(self.id);
        put(self.class as u32
            | (self.lane as u8 as u32) << 8
            | u32::from(self.cuts_in) << 16
            | u32::from(self.approaching) << 24);
        let Self {
            x,
            y,
            vx,
            vy,
            ax,
            ay,
            length,
            width,
            ..
        } = *self;
        put_f32s(put, &[x, y, vx, vy, ax, length, width, ay]);
    }

    fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        let id = take();
        let tags = take();
        let class = *ClassCode::ALL.get((tags & 0xFF) as usize).ok_or(Corrupt)?;
        let cuts_in = match tags >> 16 & 0xFF {
            0 => false,
            1 => true,
            _ => return Err(Corrupt),
        };
        Ok(Self {
            id,
            class,
            x: finite(take)?,
            y: finite(take)?,
            vx: finite(take)?,
            vy: finite(take)?,
            ax: finite(take)?,
            length: finite(take)?,
            width: finite(take)?,
            lane: (tags >> 8) as u8 as i8,
            cuts_in,
            approaching: (tags >> 24) as u8,
            ay: finite(take)?,
        })
    }
}

impl Payload for Scene {
    const WORDS: usize =
        2 + 2 + 1 + Ego::WORDS + 1 + Lanes::WORDS + 2 + 2 + 1 + MAX_OBJECTS * Object::WORDS;

    fn store(&self, put: &mut impl FnMut(u32)) {
        put_instant(put, self.at);
        put_instant(put, self.measured);
        put(self.cycle);
        self.ego.store(put);
        put(u32::from(self.lanes.is_some()) | u32::from(self.missing) << 8);
        match &self.lanes {
            Some(lanes) => lanes.store(put),
            None => (0..Lanes::WORDS).for_each(|_| put(0)),
        }
        put_option(put, self.set_speed);
        put(self.route as u32 | u32::from(self.near_gap) << 8);
        put(self.lane_offset.to_bits());
        put(self.objects.len() as u32);
        self.objects.iter().for_each(|object| object.store(put));
        (self.objects.len() * Object::WORDS..MAX_OBJECTS * Object::WORDS).for_each(|_| put(0));
    }

    fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        let (at, measured) = (instant(take), instant(take));
        let cycle = take();
        let ego = Ego::load(take)?;
        let seen_and_missing = take();
        let seen = flag(&mut || seen_and_missing & 0xFF)?;
        let missing = u8::try_from(seen_and_missing >> 8).map_err(|_| Corrupt)?;
        let lanes = Lanes::load(take)?;
        let set_speed = option(take)?;
        let route_and_gap = take();
        let route = route_and_gap & 0xFF;
        let route = *RouteCode::ALL.get(route as usize).ok_or(Corrupt)?;
        let near_gap = flag(&mut || route_and_gap >> 8)?;
        let lane_offset = f32::from_bits(take());
        let count = take() as usize;
        if count > MAX_OBJECTS {
            return Err(Corrupt);
        }
        let mut objects = Vec::new();
        for _ in 0..count {
            objects.push(Object::load(take)?).map_err(|_| Corrupt)?;
        }
        Ok(Self {
            at,
            measured,
            cycle,
            missing,
            ego,
            lanes: seen.then_some(lanes),
            set_speed,
            route,
            near_gap,
            lane_offset,
            objects,
        })
    }
}

impl Payload for TrajectoryPoint {
    const WORDS: usize = 6;

    fn store(&self, put: &mut impl FnMut(u32)) {
        let Self {
            x,
            y,
            heading,
            curvature,
            speed,
            acceleration,
        } = *self;
        put_f32s(put, &[x, y, heading, curvature, speed, acceleration]);
    }

    fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        Ok(Self {
            x: finite(take)?,
            y: finite(take)?,
            heading: finite(take)?,
            curvature: finite(take)?,
            speed: finite(take)?,
            acceleration: finite(take)?,
        })
    }
}

impl Payload for Trajectory {
    const WORDS: usize = 2 + 2 + 1 + 1 + TRAJECTORY_SAMPLES * TrajectoryPoint::WORDS;

    fn store(&self, put: &mut impl FnMut(u32)) {
        put_instant(put, self.at);
        put_instant(put, self.measured);
        put(self.cycle);
        put(self.maneuver as u32 | self.memory.bits() << 2);
        self.points.iter().for_each(|point| point.store(put));
    }

    fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        let (at, measured) = (instant(take), instant(take));
        let cycle = take();
        let decided = take();
        let maneuver = match decided & 3 {
            0 => Maneuver::Follow,
            1 => Maneuver::ChangeLeft,
            2 => Maneuver::ChangeRight,
            _ => Maneuver::Brake,
        };
        let mut points = [TrajectoryPoint::default(); TRAJECTORY_SAMPLES];
        for point in &mut points {
            *point = TrajectoryPoint::load(take)?;
        }
        Ok(Self {
            at,
            measured,
            cycle,
            maneuver,
            memory: Memory::from_bits(decided >> 2).ok_or(Corrupt)?,
            points,
        })
    }
}

impl Payload for Knowledge {
    const WORDS: usize = 2
        + Ego::WORDS
        + 6
        + 2
        + PLAN_POINTS * TrajectoryPoint::WORDS
        + 1
        + MAX_OBJECTS * KnownObject::WORDS;

    fn store(&self, put: &mut impl FnMut(u32)) {
        put_instant(put, self.at);
        self.ego.store(put);
        put(u32::from(self.line.is_some()));
        let line = self.line.as_ref();
        put_f32s(put, &line.map_or([0.0; 4], |line| line.c));
        put_f32s(put, &[line.map_or(0.0, |line| line.view_range)]);
        put(u32::from(self.plan.is_some()));
        let plan = self.plan.as_ref();
        put(plan.map_or(0, |plan| plan.memory.bits()));
        let points = plan.map_or([TrajectoryPoint::default(); PLAN_POINTS], |it| it.points);
        points.iter().for_each(|point| point.store(put));
        put(self.objects.len() as u32);
        let words = self.objects.iter().flat_map(|object| object.0);
        words.for_each(&mut *put);
        let missing = MAX_OBJECTS - self.objects.len();
        (0..missing * KnownObject::WORDS).for_each(|_| put(0));
    }

    fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        let at = instant(take);
        let ego = Ego::load(take)?;
        let is_seen = flag(take)?;
        let line = KnownLine {
            c: [finite(take)?, finite(take)?, finite(take)?, finite(take)?],
            view_range: finite(take)?,
        };
        let is_planned = flag(take)?;
        let memory = Memory::from_bits(take()).ok_or(Corrupt)?;
        let mut points = [TrajectoryPoint::default(); PLAN_POINTS];
        for point in &mut points {
            *point = TrajectoryPoint::load(take)?;
        }
        let count = take() as usize;
        if count > MAX_OBJECTS {
            return Err(Corrupt);
        }
        let object = |_| KnownObject([take(), take(), take(), take()]);
        let knowledge = Self {
            at,
            ego,
            line: is_seen.then_some(line),
            plan: is_planned.then_some(KnownPlan { memory, points }),
            objects: (0..count).map(object).collect(),
        };
        knowledge.is_plausible().then_some(knowledge).ok_or(Corrupt)
    }
}

impl Payload for ControlStep {
    const WORDS: usize = 1 + 1 + 3 + Ego::WORDS + 2 + 2;

    fn store(&self, put: &mut impl FnMut(u32)) {
        put(self.cycle);
        put_f32s(put, &[self.age_s]);
        put_f32s(put, &self.pose);
        self.ego.store(put);
        for command in [self.last, self.command] {
            put_f32s(put, &[command.steering_angle, command.acceleration]);
        }
    }

    fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        let command = |take: &mut _| {
            Ok(Command {
                steering_angle: finite(take)?,
                acceleration: finite(take)?,
            })
        };
        Ok(Self {
            cycle: take(),
            age_s: finite(take)?,
            pose: [finite(take)?, finite(take)?, finite(take)?],
            ego: Ego::load(take)?,
            last: command(take)?,
            command: command(take)?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene() -> Scene {
        let lanes = Lanes {
            c: [0.1, 0.01, 1e-4, 0.0],
            left: Some(3.6),
            left_end: 120.0,
            speed_limit: 33.3,
            ends_domain: true,
            ..Lanes::alone(3.5, 100.0)
        };
        Scene {
            at: Instant::from_ns(0x1_2345_6789),
            measured: Instant::from_ns(0x1_2300_0000),
            cycle: 99,
            missing: 0,
            ego: Ego {
                speed: 25.0,
                ..Ego::default()
            },
            lanes: Some(lanes),
            set_speed: Some(30.0),
            route: RouteCode::Right,
            near_gap: true,
            lane_offset: -0.3,
            objects: Vec::from_slice(&[Object::truck(); 3]).unwrap(),
        }
    }

    fn to_words<T: Payload>(value: &T) -> std::vec::Vec<u32> {
        let mut words = std::vec::Vec::new();
        value.store(&mut |word| words.push(word));
        assert_eq!(words.len(), T::WORDS);
        words
    }

    fn from_words<T: Payload>(words: &[u32]) -> Result<T, Corrupt> {
        let mut words = words.iter();
        T::load(&mut || *words.next().unwrap())
    }

    #[test]
    fn what_goes_in_comes_out() {
        assert_eq!(from_words::<Scene>(&to_words(&scene())), Ok(scene()));
        let blind = Scene {
            lanes: None,
            set_speed: None,
            objects: Vec::new(),
            ..scene()
        };
        assert_eq!(from_words::<Scene>(&to_words(&blind)), Ok(blind));
        let trajectory = Trajectory {
            at: Instant::from_ns(5),
            measured: Instant::from_ns(3),
            cycle: 1,
            maneuver: Maneuver::ChangeRight,
            memory: Memory::from_bits(0x2AAA_AAAA).unwrap(),
            points: core::array::from_fn(|i| TrajectoryPoint {
                x: i as f32,
                ..Default::default()
            }),
        };
        assert_eq!(
            from_words::<Trajectory>(&to_words(&trajectory)),
            Ok(trajectory)
        );
    }

    /// T-SHM-4: bytes of another core are refused or decoded, whatever they are.
    #[test]
    fn scribbled_words_are_refused_or_decoded() {
        let good = to_words(&scene());
        for place in 0..good.len() {
            for value in [
                u32::MAX,
                f32::NAN.to_bits(),
                f32::NEG_INFINITY.to_bits(),
                0x8000_0000,
            ] {
                let mut bad = good.clone();
                bad[place] = value;
                if let Ok(scene) = from_words::<Scene>(&bad) {
                    assert!(scene.objects.iter().all(|object| object.x.is_finite()));
                }
            }
        }
        let count = good.len() - MAX_OBJECTS * Object::WORDS - 1;
        let mut bad = good;
        bad[count] = MAX_OBJECTS as u32 + 1;
        assert_eq!(from_words::<Scene>(&bad), Err(Corrupt));
    }
}
