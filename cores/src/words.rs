//! Scene and trajectory as words of the LMU, and back.
//!
//! Values in shared memory are not trusted: decoding checks every count, tag and number, and
//! refuses the whole value if one is impossible. Numbers cross as IEEE 754 bits.

use crate::driving::knowledge::{Knowledge, KnownLine, KnownObject, KnownPlan, PLAN_POINTS};
use crate::driving::perception::GlobalClock;
use crate::driving::types::{
    CameraLine, ClassCode, Command, ControlStep, Ego, Lanes, MAX_OBJECTS, Maneuver, Memory, Object,
    RouteCode, Scene, StepFunction, TRAJECTORY_SAMPLES, Trajectory, TrajectoryPoint,
};
use heapless::Vec;
use tandem_board::Instant;
pub use tandem_shm::{Corrupt, Payload};
use tandem_timesync::{Arbitrary, CONVERSION_WORDS, Conversion};

/// Largest magnitude that a physical quantity may have: far above all real values, and small enough
/// that no product of three overflows.
const LIMIT: f32 = 1e6;

/// A part of a payload: the words that represent a value of this type.
trait Part<V = Self> {
    const WORDS: usize;
    fn put(value: &V, put: &mut impl FnMut(u32));
    fn take(take: &mut impl FnMut() -> u32) -> Result<V, Corrupt>;
}

/// A distance or speed that may be infinite ("none in sight").
struct Unbounded;

/// Parts of one word.
macro_rules! words {
    ($($part:ty as $value:ty: $put:expr, $take:expr;)+) => {$(
        impl Part<$value> for $part {
            const WORDS: usize = 1;
            #[inline]
            fn put(value: &$value, put: &mut impl FnMut(u32)) {
                put($put(*value));
            }
            #[inline]
            fn take(take: &mut impl FnMut() -> u32) -> Result<$value, Corrupt> {
                $take(take()).ok_or(Corrupt)
            }
        }
    )+};
}

words! {
    u32 as u32: u32::from, Some;
    bool as bool: u32::from, |word| (word <= 1).then_some(word == 1);
    Memory as Memory: Memory::bits, Memory::from_bits;
    f32 as f32: f32::to_bits, |word| Some(f32::from_bits(word)).filter(|it| it.abs() <= LIMIT);
    StepFunction as StepFunction: |function| function as u32, |word: u32| {
        StepFunction::ALL.get(word as usize).copied()
    };
    Unbounded as f32: f32::to_bits, |word| {
        Some(f32::from_bits(word)).filter(|it| *it == f32::INFINITY || it.abs() <= LIMIT)
    };
}

impl Part for Instant {
    const WORDS: usize = 2;

    fn put(at: &Self, put: &mut impl FnMut(u32)) {
        at.to_words().into_iter().for_each(put);
    }

    fn take(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        let low = take();
        Ok(Self::from_words([low, take()]))
    }
}

/// Whether there is a value, and its words; they are 0 without one.
impl<T: Part> Part for Option<T> {
    const WORDS: usize = 1 + T::WORDS;

    fn put(value: &Self, put: &mut impl FnMut(u32)) {
        put(u32::from(value.is_some()));
        match value {
            Some(value) => T::put(value, put),
            None => (0..T::WORDS).for_each(|_| put(0)),
        }
    }

    fn take(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        let some = bool::take(take)?;
        let value = T::take(take)?;
        Ok(some.then_some(value))
    }
}

impl<T: Part + Copy + Default, const N: usize> Part for [T; N] {
    const WORDS: usize = N * T::WORDS;

    fn put(values: &Self, put: &mut impl FnMut(u32)) {
        values.iter().for_each(|value| T::put(value, put));
    }

    fn take(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        let mut values = [T::default(); N];
        for value in &mut values {
            *value = T::take(take)?;
        }
        Ok(values)
    }
}

/// How many values there are, and their words; the rest is 0.
impl<T: Part, const N: usize> Part for Vec<T, N> {
    const WORDS: usize = 1 + N * T::WORDS;

    fn put(values: &Self, put: &mut impl FnMut(u32)) {
        put(values.len() as u32);
        values.iter().for_each(|value| T::put(value, put));
        (values.len() * T::WORDS..N * T::WORDS).for_each(|_| put(0));
    }

    fn take(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        let count = take() as usize;
        if count > N {
            return Err(Corrupt);
        }
        (0..count).map(|_| T::take(take)).collect()
    }
}

/// The words of structs, field by field in this order. A value that fails the check after `if` is
/// refused.
macro_rules! structs {
    ($($name:ident { $($field:tt: $part:ty),+ } $(if $check:ident)?;)+) => {$(
        impl Part for $name {
            const WORDS: usize = 0 $(+ <$part as Part<_>>::WORDS)+;

            fn put(value: &Self, put: &mut impl FnMut(u32)) {
                $(<$part as Part<_>>::put(&value.$field, put);)+
            }

            fn take(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
                let value = Self { $($field: <$part as Part<_>>::take(take)?),+ };
                $(if !value.$check() {
                    return Err(Corrupt);
                })?
                Ok(value)
            }
        }
    )+};
}

structs! {
    Ego { speed: f32, yaw_rate: f32, acceleration: f32, steering_angle: f32, slip_angle: f32 };
    Lanes {
        c: [f32; 4], view_range: f32, width: f32, left: Option<f32>, right: Option<f32>,
        own_end: Unbounded, left_end: Unbounded, right_end: Unbounded, speed_limit: Unbounded,
        ends_domain: bool
    };
    CameraLine { at: Instant, c: [f32; 4] };
    TrajectoryPoint { x: f32, y: f32, heading: f32, curvature: f32, speed: f32, acceleration: f32 };
    Command { steering_angle: f32, acceleration: f32 };
    ControlStep {
        function: StepFunction, cycle: u32, age_s: f32, pose: [f32; 3], ego: Ego, last: Command,
        command: Command
    };
    KnownLine { c: [f32; 4], view_range: f32 };
    KnownPlan { memory: Memory, points: [TrajectoryPoint; PLAN_POINTS] };
    KnownObject { 0: [u32; 4] };
    Knowledge {
        at: Instant, ego: Ego, line: Option<KnownLine>, plan: Option<KnownPlan>,
        objects: Vec<KnownObject, MAX_OBJECTS>
    } if is_plausible;
}

impl Part for Object {
    const WORDS: usize = 10;

    fn put(object: &Self, put: &mut impl FnMut(u32)) {
        put(object.id);
        put(object.class as u32
            | (object.lane as u8 as u32) << 8
            | u32::from(object.cuts_in) << 16
            | u32::from(object.approaching) << 24);
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
        } = *object;
        <[f32; 8]>::put(&[x, y, vx, vy, ax, length, width, ay], put);
    }

    fn take(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        let (id, tags) = (take(), take());
        let [class, lane, cuts_in, approaching] = tags.to_le_bytes();
        let class = *ClassCode::ALL.get(usize::from(class)).ok_or(Corrupt)?;
        let cuts_in = bool::take(&mut || cuts_in.into())?;
        let [x, y, vx, vy, ax, length, width, ay] = <[f32; 8]>::take(take)?;
        Ok(Self {
            id,
            class,
            x,
            y,
            vx,
            vy,
            ax,
            ay,
            length,
            width,
            lane: lane as i8,
            cuts_in,
            approaching,
        })
    }
}

impl Part for Scene {
    const WORDS: usize = 2
        + 2
        + <Option<Instant>>::WORDS
        + 1
        + Ego::WORDS
        + 1
        + Lanes::WORDS
        + CameraLine::WORDS
        + 2
        + 2
        + <Vec<Object, MAX_OBJECTS>>::WORDS;

    fn put(scene: &Self, put: &mut impl FnMut(u32)) {
        [scene.at, scene.measured]
            .iter()
            .for_each(|at| Instant::put(at, put));
        put(scene.cycle);
        Option::put(&scene.moment, put);
        Ego::put(&scene.ego, put);
        put(u32::from(scene.lanes.is_some()) | u32::from(scene.missing) << 8);
        match &scene.lanes {
            Some(lanes) => Lanes::put(lanes, put),
            None => (0..Lanes::WORDS).for_each(|_| put(0)),
        }
        CameraLine::put(&scene.camera, put);
        Option::put(&scene.set_speed, put);
        put(scene.route as u32 | u32::from(scene.near_gap) << 8);
        put(scene.lane_offset.to_bits());
        Vec::put(&scene.objects, put);
    }

    fn take(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        let (at, measured, cycle) = (Instant::take(take)?, Instant::take(take)?, take());
        let moment = <Option<Instant> as Part>::take(take)?;
        let ego = Ego::take(take)?;
        let seen_and_missing = take();
        let seen = bool::take(&mut || seen_and_missing & 0xFF)?;
        let missing = u8::try_from(seen_and_missing >> 8).map_err(|_| Corrupt)?;
        let lanes = Lanes::take(take)?;
        let camera = CameraLine::take(take)?;
        let set_speed = <Option<f32> as Part>::take(take)?;
        let route_and_gap = take();
        let route = (route_and_gap & 0xFF) as usize;
        Ok(Self {
            at,
            moment,
            measured,
            cycle,
            missing,
            ego,
            lanes: seen.then_some(lanes),
            camera,
            set_speed,
            route: *RouteCode::ALL.get(route).ok_or(Corrupt)?,
            near_gap: bool::take(&mut || route_and_gap >> 8)?,
            lane_offset: f32::from_bits(take()),
            objects: Vec::take(take)?,
        })
    }
}

impl Part for Trajectory {
    const WORDS: usize = 2 + 2 + 1 + 1 + TRAJECTORY_SAMPLES * TrajectoryPoint::WORDS;

    fn put(trajectory: &Self, put: &mut impl FnMut(u32)) {
        [trajectory.at, trajectory.measured]
            .iter()
            .for_each(|at| Instant::put(at, put));
        put(trajectory.cycle);
        put(trajectory.maneuver as u32 | trajectory.memory.bits() << 2);
        <[_; TRAJECTORY_SAMPLES]>::put(&trajectory.points, put);
    }

    fn take(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        let (at, measured, cycle) = (Instant::take(take)?, Instant::take(take)?, take());
        let decided = take();
        Ok(Self {
            at,
            measured,
            cycle,
            maneuver: match decided & 3 {
                0 => Maneuver::Follow,
                1 => Maneuver::ChangeLeft,
                2 => Maneuver::ChangeRight,
                _ => Maneuver::Brake,
            },
            memory: Memory::from_bits(decided >> 2).ok_or(Corrupt)?,
            points: <[_; TRAJECTORY_SAMPLES]>::take(take)?,
        })
    }
}

/// Makes these types payloads, for regions of the LMU.
macro_rules! payloads {
    ($($name:ident)+) => {$(
        impl Payload for $name {
            const WORDS: usize = <Self as Part>::WORDS;

            fn store(&self, put: &mut impl FnMut(u32)) {
                <Self as Part>::put(self, put);
            }

            fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
                <Self as Part>::take(take)
            }
        }
    )+};
}

payloads! { Scene Trajectory Knowledge ControlStep }

/// How a system's clock becomes the vehicle's time; `None` while there is none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VehicleTime(pub Option<Conversion<Arbitrary>>);

impl VehicleTime {
    /// Returns the time at `now` for the lists of sensors; `None` if its error is too large.
    #[must_use]
    pub fn clock(&self, now: Instant) -> Option<GlobalClock> {
        let conversion = self.0?;
        let us = conversion.at(now).as_ns() / 1_000;
        GlobalClock::new(now, us, conversion.error_at(now))
    }
}

impl Payload for VehicleTime {
    const WORDS: usize = CONVERSION_WORDS;

    fn store(&self, put: &mut impl FnMut(u32)) {
        let words = self.0.map_or([0; CONVERSION_WORDS], |it| it.to_words());
        words.into_iter().for_each(put);
    }

    fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        let words = core::array::from_fn(|_| take());
        let conversion = Conversion::from_words(words);
        let is_some = words != [0; CONVERSION_WORDS];
        (conversion.is_some() == is_some)
            .then_some(Self(conversion))
            .ok_or(Corrupt)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    impl Object {
        /// A truck that cuts in from the right, with a different value in each field.
        pub(crate) const fn truck() -> Self {
            Self {
                id: 7,
                class: ClassCode::Truck,
                x: 31.5,
                y: -3.4,
                vx: 22.0,
                vy: 0.3,
                ax: -1.0,
                ay: 0.5,
                length: 12.0,
                width: 2.5,
                lane: -1,
                cuts_in: true,
                approaching: 5,
            }
        }
    }

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
            moment: Some(Instant::from_ns(0x7_2345_6789)),
            measured: Instant::from_ns(0x1_2300_0000),
            cycle: 99,
            missing: 0,
            ego: Ego {
                speed: 25.0,
                ..Ego::default()
            },
            lanes: Some(lanes),
            camera: CameraLine {
                at: Instant::from_ns(0x1_2300_0001),
                c: [0.1, -0.2, 1e-4, 0.0],
            },
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

    /// T-SHM-4: any bytes of another core are refused or decoded.
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
