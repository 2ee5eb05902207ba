//! Wrong values of one signal, frames that a core does not hear, and forged frames.

use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error as _};
use std::collections::{HashMap, VecDeque};
use std::fmt;
use tandem_board::{CoreId, Duration, Forgery, Instant};
use tandem_bus::{FRAMES, FrameInfo, Message};

/// A real number of a fault file, in millionths.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Real(i64);

/// The largest real number of a file. It fits every signal of the bus.
const LARGEST: f64 = 5e9;

impl Real {
    /// Returns this number of thousandths.
    #[must_use]
    pub const fn thousandths(number: i64) -> Self {
        Self(number * 1_000)
    }

    /// Returns the number.
    #[must_use]
    pub fn get(self) -> f64 {
        self.0 as f64 / 1e6
    }
}

impl Serialize for Real {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_f64(self.get())
    }
}

impl<'de> Deserialize<'de> for Real {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Number {
            Whole(i64),
            Real(f64),
        }
        let number = match Number::deserialize(from)? {
            Number::Whole(whole) => whole as f64,
            Number::Real(real) => real,
        };
        if number.abs() <= LARGEST {
            Ok(Self((number * 1e6).round() as i64))
        } else {
            Err(D::Error::custom(format!(
                "{number} is not within {LARGEST:e}"
            )))
        }
    }
}

/// Defines an enum whose variants have names in a file.
macro_rules! named {
    ($(#[$doc:meta])* $name:ident { $($(#[$about:meta])* $variant:ident = $word:literal,)+ }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
        pub enum $name {
            $($(#[$about])* #[serde(rename = $word)] $variant,)+
        }

        impl $name {
            /// All of them, in the order of the documentation.
            pub const ALL: &'static [Self] = &[$(Self::$variant,)+];

            /// Returns its name in a file.
            #[must_use]
            pub const fn name(self) -> &'static str {
                match self { $(Self::$variant => $word,)+ }
            }
        }
    };
}

named! {
    /// A value that a core hears, computes or sends.
    Signal {
        /// The offset of the lane from the vehicle, m, in the camera's frames.
        LaneOffset = "lane-offset",
        /// The heading of the lane, rad.
        LaneHeading = "lane-heading",
        /// Half the curvature of the lane, 1/m.
        LaneCurvature = "lane-curvature",
        /// The place of each object ahead, m, in the sensors' frames.
        ObjectDistance = "object-distance",
        /// The speed of each object along the vehicle's axis, m/s.
        ObjectSpeed = "object-speed",
        /// The vehicle's speed, m/s.
        EgoSpeed = "ego-speed",
        /// Its acceleration along its axis, m/s².
        EgoAcceleration = "ego-acceleration",
        /// Its side slip angle, rad.
        EgoSlip = "ego-slip",
        /// Its yaw rate, rad/s.
        YawRate = "yaw-rate",
        /// Its measured steering angle, rad.
        SteeringAngle = "steering-angle",
        /// The steering angle in the control frames that core 0 sends, rad.
        CommandSteering = "command-steering",
        /// The acceleration in those frames, m/s².
        CommandAcceleration = "command-acceleration",
        /// The place of the trajectory across the road, m, which core 2 publishes.
        Trajectory = "trajectory",
    }
}

named! {
    /// How a value is wrong.
    How {
        /// The amount is added.
        Offset = "offset",
        /// The value is multiplied by the amount.
        Factor = "factor",
        /// The sign is turned.
        Sign = "sign",
        /// The value stays as it was when the fault began.
        Stuck = "stuck",
        /// The amount is added for each second since the fault began.
        Drift = "drift",
        /// The value is no number: all bits of the signal are set.
        Nan = "nan",
        /// The value is as old as the amount says, ms.
        LateMs = "late-ms",
    }
}

impl Signal {
    /// Returns the cores at which this value can be wrong.
    #[must_use]
    pub const fn cores(self) -> &'static [u8] {
        match self {
            Self::CommandSteering | Self::CommandAcceleration => &[0],
            Self::Trajectory => &[2],
            _ => &[0, 1],
        }
    }

    /// Returns whether a core sends this value. Other values are heard.
    #[must_use]
    pub const fn is_sent(self) -> bool {
        matches!(self, Self::CommandSteering | Self::CommandAcceleration)
    }

    /// Returns the signal of the DBC if this frame carries the value.
    fn field(self, frame: &FrameInfo) -> Option<&'static str> {
        let (is_of, field) = match self {
            Self::LaneOffset => (frame.name == "CameraLanes", "C0"),
            Self::LaneHeading => (frame.name == "CameraLanes", "C1"),
            Self::LaneCurvature => (frame.name == "CameraLanes", "C2"),
            Self::ObjectDistance => (frame.name.ends_with("Object"), "X"),
            Self::ObjectSpeed => (frame.name.ends_with("Object"), "VX"),
            Self::EgoSpeed => (frame.name == "EgoMotion", "Speed"),
            Self::EgoAcceleration => (frame.name == "EgoMotion", "LongAcceleration"),
            Self::EgoSlip => (frame.name == "EgoMotion", "SlipAngle"),
            Self::YawRate => (frame.name == "EgoMotion", "YawRate"),
            Self::SteeringAngle => (frame.name == "EgoMotion", "SteeringAngle"),
            Self::CommandSteering => (frame.name.starts_with("Control"), "SteeringAngle"),
            Self::CommandAcceleration => (frame.name.starts_with("Control"), "Acceleration"),
            Self::Trajectory => (false, ""),
        };
        is_of.then_some(field)
    }
}

/// One signal of one core is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct WrongValue {
    /// The signal.
    pub signal: Signal,
    /// The number of the core.
    pub core: u8,
    /// How it is wrong.
    pub how: How,
    /// By how much; 0 for `sign`, `stuck` and `nan`.
    pub amount: Real,
}

impl<'de> Deserialize<'de> for WrongValue {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        struct Given {
            signal: Signal,
            core: u8,
            how: How,
            #[serde(default)]
            amount: Real,
        }
        let Given {
            signal,
            core,
            how,
            amount,
        } = Given::deserialize(from)?;
        let cores = signal.cores();
        if !cores.contains(&core) {
            let name = signal.name();
            return Err(D::Error::custom(format!(
                "`{name}` is not on core {core}, only on {cores:?}"
            )));
        }
        let ms = amount.get();
        if how == How::LateMs && !(1.0..=5_000.0).contains(&ms) {
            return Err(D::Error::custom("`late-ms` is 1 to 5000 ms"));
        }
        Ok(Self {
            signal,
            core,
            how,
            amount,
        })
    }
}

impl WrongValue {
    /// Returns the core.
    #[must_use]
    pub const fn core(self) -> CoreId {
        CoreId::ALL[self.core as usize]
    }
}

impl fmt::Display for WrongValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            signal,
            core,
            how,
            amount,
        } = self;
        write!(
            f,
            "{} of core {core}, {} {}",
            signal.name(),
            how.name(),
            amount.get()
        )
    }
}

/// The name of a frame of the DBC.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameName(u8);

impl FrameName {
    /// Returns the frame with this name.
    #[must_use]
    pub fn of(name: &str) -> Option<Self> {
        let index = FRAMES.iter().position(|frame| frame.name == name)?;
        Some(Self(index as u8))
    }

    /// Returns the properties of the frame.
    #[must_use]
    pub const fn info(self) -> &'static FrameInfo {
        &FRAMES[self.0 as usize]
    }
}

impl Serialize for FrameName {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_str(self.info().name)
    }
}

impl<'de> Deserialize<'de> for FrameName {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        let name = String::deserialize(from)?;
        Self::of(&name).ok_or_else(|| D::Error::custom(format!("there is no frame `{name}`")))
    }
}

/// A core does not hear a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeafTo {
    /// The frame.
    pub frame: FrameName,
    /// The number of the core: 0 or 1.
    #[serde(deserialize_with = "core_with_can")]
    pub core: u8,
}

fn core_with_can<'de, D: Deserializer<'de>>(from: D) -> Result<u8, D::Error> {
    let core = u8::deserialize(from)?;
    match core {
        0 | 1 => Ok(core),
        _ => Err(D::Error::custom("`core` is 0 or 1: core 2 hears no frames")),
    }
}

impl fmt::Display for DeafTo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} of core {}", self.frame.info().name, self.core)
    }
}

/// Another node sends a frame each 10 ms, with a valid CRC and the next counter. Its signals are
/// those of the last such frame on the bus, but for one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Forged {
    /// The frame.
    pub frame: FrameName,
    /// The signal: an index into those of the frame, or `COUNTER`.
    #[serde(serialize_with = "field_name")]
    pub field: (FrameName, u8),
    /// Its value, in the unit of the DBC.
    pub value: Real,
}

/// The field `Counter`, which the protection of a frame contains.
const COUNTER: u8 = u8::MAX;

fn fields(frame: FrameName) -> Vec<&'static str> {
    let info = frame.info();
    let mut names = vec![];
    // Each second frame of a pair has the bit that tells the systems apart.
    for byte in [0, 0x20] {
        let mut data = vec![0; info.len];
        data[3] = byte;
        if let Ok(message) = Message::decode(info.id.into(), &data) {
            message.values(|name, _| names.push(name));
            break;
        }
    }
    names
}

fn field_name<S: Serializer>((frame, field): &(FrameName, u8), to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(name_of(*frame, *field))
}

fn name_of(frame: FrameName, field: u8) -> &'static str {
    let names = fields(frame);
    names.get(usize::from(field)).copied().unwrap_or("Counter")
}

impl<'de> Deserialize<'de> for Forged {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        struct Given {
            frame: FrameName,
            field: String,
            value: Real,
        }
        let Given {
            frame,
            field,
            value,
        } = Given::deserialize(from)?;
        Self::of(frame, &field, value).ok_or_else(|| {
            let (name, fields) = (frame.info().name, fields(frame).join(", "));
            D::Error::custom(format!("`{name}` has no `{field}`, only Counter, {fields}"))
        })
    }
}

impl fmt::Display for Forged {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (frame, field) = self.field;
        let (name, field) = (frame.info().name, name_of(frame, field));
        write!(f, "{name} {field} {}", self.value.get())
    }
}

impl Forged {
    /// Returns the forged frame; `None` if the frame has no signal of this name.
    #[must_use]
    pub fn of(frame: FrameName, field: &str, value: Real) -> Option<Self> {
        let index = fields(frame).iter().position(|name| *name == field);
        let is_counter = field == "Counter" && frame.info().has_e2e;
        let index = index.map(|it| it as u8).or(is_counter.then_some(COUNTER))?;
        Some(Self {
            frame,
            field: (frame, index),
            value,
        })
    }

    /// Returns the forged frame that follows the last such frame on the bus.
    #[must_use]
    pub fn after(self, last: &[u8]) -> Option<Vec<u8>> {
        let Forgery { id, field, value } = self.forgery();
        let mut data = last.to_vec();
        Message::forge(id.into(), &mut data, field, value).ok()?;
        Some(data)
    }

    /// Returns the forgery in numbers.
    #[must_use]
    pub fn forgery(self) -> Forgery {
        Forgery {
            id: self.frame.info().id,
            field: self.field.1,
            value: self.value.get(),
        }
    }
}

/// What a wrong value makes of the values of one core, one after the other.
#[derive(Clone, Debug)]
pub struct Bend {
    wrong: WrongValue,
    /// The first value of each source since the fault, and the time of the fault.
    first: HashMap<u32, f64>,
    began: Option<Instant>,
    past: HashMap<u32, VecDeque<(Instant, f64)>>,
}

impl Bend {
    /// Begins a fault.
    #[must_use]
    pub fn new(wrong: WrongValue) -> Self {
        Self {
            wrong,
            first: HashMap::new(),
            began: None,
            past: HashMap::new(),
        }
    }

    /// Returns what is wrong.
    #[must_use]
    pub const fn what(&self) -> WrongValue {
        self.wrong
    }

    /// Returns what the core gets for this value. `source` tells values of the same signal apart.
    pub fn value(&mut self, now: Instant, source: u32, right: f64) -> f64 {
        let began = *self.began.get_or_insert(now);
        let first = *self.first.entry(source).or_insert(right);
        let amount = self.wrong.amount.get();
        match self.wrong.how {
            How::Offset => right + amount,
            How::Factor => right * amount,
            How::Sign => -right,
            How::Stuck => first,
            How::Drift => right + amount * now.since(began).as_secs_f32() as f64,
            How::Nan => f64::NAN,
            How::LateMs => {
                let past = self.past.entry(source).or_default();
                past.push_back((now, right));
                let age = Duration::from_us((amount * 1e3) as u64);
                while past.get(1).is_some_and(|(at, _)| now.since(*at) >= age) {
                    past.pop_front();
                }
                past.front().map_or(right, |(_, value)| *value)
            }
        }
    }

    /// Alters a frame that carries the signal.
    pub fn frame(&mut self, now: Instant, id: u32, data: &mut [u8]) {
        let frame = FRAMES.iter().find(|frame| u32::from(frame.id) == id);
        let Some(field) = frame.and_then(|frame| self.wrong.signal.field(frame)) else {
            return;
        };
        // Objects of one list have their index in the first five bits.
        let is_object = matches!(
            self.wrong.signal,
            Signal::ObjectDistance | Signal::ObjectSpeed
        );
        let index = if is_object {
            u32::from(data[3] & 0x1F)
        } else {
            0
        };
        let source = id << 8 | index;
        let _valid = Message::alter(id, data, field, |right| self.value(now, source, right));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> Instant {
        Instant::from_ns(ms * 1_000_000)
    }

    #[test]
    fn each_way_of_being_wrong_does_what_it_says() {
        let wrong = |how, thousandths| WrongValue {
            signal: Signal::EgoSpeed,
            core: 0,
            how,
            amount: Real::thousandths(thousandths),
        };
        let rights = [10.0, 11.0, 12.0, 13.0];
        for (how, amount, expected) in [
            (How::Offset, 5_000, [15.0, 16.0, 17.0, 18.0]),
            (How::Factor, 400, [4.0, 4.4, 4.8, 5.2]),
            (How::Sign, 0, [-10.0, -11.0, -12.0, -13.0]),
            (How::Stuck, 0, [10.0; 4]),
            (How::Drift, 1_000, [10.0, 12.0, 14.0, 16.0]),
            (How::LateMs, 2_000_000, [10.0, 10.0, 10.0, 11.0]),
        ] {
            let mut bend = Bend::new(wrong(how, amount));
            for (second, (right, expected)) in rights.into_iter().zip(expected).enumerate() {
                let value = bend.value(at(1_000 * second as u64), 1, right);
                assert!((value - expected).abs() < 1e-6, "{how:?}: {value}");
            }
        }
    }

    #[test]
    fn a_frame_is_altered_and_stays_valid() {
        let motion = tandem_bus::EgoMotion {
            speed: 20.0,
            ..Default::default()
        };
        let frame = Message::EgoMotion(motion).encode(7);
        let mut data = frame.data().to_vec();
        let mut bend = Bend::new(WrongValue {
            signal: Signal::EgoSpeed,
            core: 1,
            how: How::Factor,
            amount: Real::thousandths(400),
        });
        bend.frame(at(0), frame.id.into(), &mut data);
        let Ok(Message::EgoMotion(heard)) = Message::decode(frame.id.into(), &data) else {
            panic!("not valid")
        };
        assert!((heard.speed - 8.0).abs() < 0.01);
        assert_eq!(data[2], 7);
    }

    #[test]
    fn a_forged_frame_follows_the_last_one() {
        let frame = FrameName::of("GateEcho").expect("a frame");
        let last = Message::GateEcho(tandem_bus::GateEcho {
            term: 40,
            term_age: 3.0,
            ..Default::default()
        })
        .encode(255);
        let forged = |field, value| Forged::of(frame, field, Real(value)).expect("a field");
        let data = forged("Term", 0xFFFF_FFFE * 1_000_000)
            .after(last.data())
            .expect("a frame");
        let Ok(Message::GateEcho(echo)) = Message::decode(last.id.into(), &data) else {
            panic!("not valid")
        };
        assert_eq!((echo.term, echo.term_age, data[2]), (0xFFFF_FFFE, 3.0, 0));
        let data = forged("Counter", 9_000_000)
            .after(last.data())
            .expect("a frame");
        assert_eq!(data[2], 9);
        assert_eq!(Forged::of(frame, "Nothing", Real(0)), None);
    }
}
