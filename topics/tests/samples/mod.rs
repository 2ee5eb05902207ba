//! Generates samples of any type with any values that the IDL allows.
#![allow(dead_code, reason = "each test uses a part")]

use std::fmt::Write as _;

use proptest::prelude::*;
use tandem_shm::{Corrupt, Payload};
use tandem_topics::{
    BrakeRequest, CanFrame, CdrError, Gear, LateralControl, LongitudinalControl, ParkingBrake,
    PowerControl, TopicType,
};

/// A sample of any type.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Any {
    CanFrame(CanFrame),
    PowerControl(PowerControl),
    LateralControl(LateralControl),
    LongitudinalControl(LongitudinalControl),
    ParkingBrake(ParkingBrake),
}

fn through_words<T: Payload>(sample: &T) -> Result<T, Corrupt> {
    let mut words = Vec::new();
    sample.store(&mut |word| words.push(word));
    assert_eq!(words.len(), T::WORDS);
    let mut words = words.into_iter();
    T::load(&mut || words.next().unwrap())
}

/// Every type.
pub(crate) const TYPES: [&str; 5] = [
    CanFrame::TYPE_NAME,
    PowerControl::TYPE_NAME,
    LateralControl::TYPE_NAME,
    LongitudinalControl::TYPE_NAME,
    ParkingBrake::TYPE_NAME,
];

impl Any {
    pub(crate) fn type_name(&self) -> &'static str {
        match self {
            Self::CanFrame(_) => CanFrame::TYPE_NAME,
            Self::PowerControl(_) => PowerControl::TYPE_NAME,
            Self::LateralControl(_) => LateralControl::TYPE_NAME,
            Self::LongitudinalControl(_) => LongitudinalControl::TYPE_NAME,
            Self::ParkingBrake(_) => ParkingBrake::TYPE_NAME,
        }
    }

    pub(crate) fn encode(&self) -> Result<Vec<u8>, CdrError> {
        match self {
            Self::CanFrame(sample) => sample.encode().map(Vec::from),
            Self::PowerControl(sample) => sample.encode().map(Vec::from),
            Self::LateralControl(sample) => sample.encode().map(Vec::from),
            Self::LongitudinalControl(sample) => sample.encode().map(Vec::from),
            Self::ParkingBrake(sample) => sample.encode().map(Vec::from),
        }
    }

    pub(crate) fn decode(type_name: &str, payload: &[u8]) -> Result<Self, CdrError> {
        match type_name {
            CanFrame::TYPE_NAME => CanFrame::decode(payload).map(Self::CanFrame),
            PowerControl::TYPE_NAME => PowerControl::decode(payload).map(Self::PowerControl),
            LateralControl::TYPE_NAME => LateralControl::decode(payload).map(Self::LateralControl),
            LongitudinalControl::TYPE_NAME => {
                LongitudinalControl::decode(payload).map(Self::LongitudinalControl)
            }
            ParkingBrake::TYPE_NAME => ParkingBrake::decode(payload).map(Self::ParkingBrake),
            other => panic!("the type {other} is not known"),
        }
    }

    /// Returns what is read from the words that the sample has in the LMU.
    pub(crate) fn through_words(&self) -> Result<Self, Corrupt> {
        match self {
            Self::CanFrame(sample) => through_words(sample).map(Self::CanFrame),
            Self::PowerControl(sample) => through_words(sample).map(Self::PowerControl),
            Self::LateralControl(sample) => through_words(sample).map(Self::LateralControl),
            Self::LongitudinalControl(sample) => {
                through_words(sample).map(Self::LongitudinalControl)
            }
            Self::ParkingBrake(sample) => through_words(sample).map(Self::ParkingBrake),
        }
    }

    /// Protects the sample; the type without protection stays unchanged.
    pub(crate) fn protect(&mut self, counter: u8) -> Result<(), CdrError> {
        match self {
            Self::CanFrame(_) => Ok(()),
            Self::PowerControl(sample) => sample.protect(counter),
            Self::LateralControl(sample) => sample.protect(counter),
            Self::LongitudinalControl(sample) => sample.protect(counter),
            Self::ParkingBrake(sample) => sample.protect(counter),
        }
    }

    /// Returns whether the CRC is right; the type without protection has none.
    pub(crate) fn is_protected(&self) -> bool {
        let check = match self {
            Self::CanFrame(_) => return false,
            Self::PowerControl(sample) => sample.check(&mut PowerControl::checker()),
            Self::LateralControl(sample) => sample.check(&mut LateralControl::checker()),
            Self::LongitudinalControl(sample) => sample.check(&mut LongitudinalControl::checker()),
            Self::ParkingBrake(sample) => sample.check(&mut ParkingBrake::checker()),
        };
        check.is_accepted()
    }

    /// Returns the values as words `name=value`: integers, booleans and enums as decimal numbers,
    /// floats by their bits and octets in hex.
    pub(crate) fn words(&self) -> String {
        let bits = |value: f32| format!("{:08x}", value.to_bits());
        match self {
            Self::CanFrame(one) => {
                let (id, period, length) = (one.id, one.period_ms, one.length);
                let data = hex(&one.data);
                format!("id={id} period_ms={period} length={length} data={data}")
            }
            Self::PowerControl(one) => format!(
                "crc={} counter={} target_speed={} acceleration={} distance={} target_gear={}",
                one.crc,
                one.counter,
                bits(one.target_speed),
                bits(one.acceleration),
                bits(one.distance),
                one.target_gear as u32
            ),
            Self::LateralControl(one) => format!(
                "crc={} counter={} enable={} road_wheel_angle={}",
                one.crc,
                one.counter,
                u8::from(one.enable),
                bits(one.road_wheel_angle)
            ),
            Self::LongitudinalControl(one) => format!(
                "crc={} counter={} enable={} brake_torque={} speed={}",
                one.crc,
                one.counter,
                u8::from(one.enable),
                bits(one.brake_torque),
                bits(one.speed)
            ),
            Self::ParkingBrake(one) => format!(
                "crc={} counter={} request={}",
                one.crc, one.counter, one.request as u32
            ),
        }
    }
}

pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut out, byte| {
        write!(out, "{byte:02x}").unwrap();
        out
    })
}

pub(crate) fn bytes(hex: &str) -> Vec<u8> {
    let hex: String = hex.split_whitespace().collect();
    let byte = |at: usize| u8::from_str_radix(&hex[at..at + 2], 16).unwrap();
    (0..hex.len()).step_by(2).map(byte).collect()
}

/// Generates a float of a range; the limits and both zeroes more often than others.
fn float(min: f32, max: f32) -> impl Strategy<Value = f32> {
    prop_oneof![Just(min), Just(max), Just(0.0), Just(-0.0), min..=max]
}

/// Generates a sample of any type.
pub(crate) fn any_sample() -> impl Strategy<Value = Any> {
    let head = || any::<(u16, u8)>();
    let can_frame = (any::<(u32, u16)>(), 0_u8..=64, any::<[[u8; 32]; 2]>()).prop_map(
        |((id, period_ms), length, data)| {
            let mut frame = CanFrame {
                id,
                period_ms,
                length,
                ..CanFrame::default()
            };
            frame.data.copy_from_slice(data.as_flattened());
            Any::CanFrame(frame)
        },
    );
    let motion = (
        float(0.0, 327.67),
        float(-32.768, 32.767),
        float(0.0, 6553.5),
    );
    let power = (head(), motion, prop::sample::select(&Gear::ALL[..])).prop_map(
        |((crc, counter), (target_speed, acceleration, distance), target_gear)| {
            Any::PowerControl(PowerControl {
                crc,
                counter,
                target_speed,
                acceleration,
                distance,
                target_gear,
            })
        },
    );
    let lateral = (head(), any::<bool>(), float(-0.65536, 0.65534)).prop_map(
        |((crc, counter), enable, road_wheel_angle)| {
            Any::LateralControl(LateralControl {
                crc,
                counter,
                enable,
                road_wheel_angle,
            })
        },
    );
    let brake = (float(0.0, 20_000.0), float(0.0, 327.67));
    let longitudinal = (head(), any::<bool>(), brake).prop_map(
        |((crc, counter), enable, (brake_torque, speed))| {
            Any::LongitudinalControl(LongitudinalControl {
                crc,
                counter,
                enable,
                brake_torque,
                speed,
            })
        },
    );
    let parking = (head(), prop::sample::select(&BrakeRequest::ALL[..])).prop_map(
        |((crc, counter), request)| {
            Any::ParkingBrake(ParkingBrake {
                crc,
                counter,
                request,
            })
        },
    );
    prop_oneof![can_frame, power, lateral, longitudinal, parking]
}
