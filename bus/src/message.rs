//! One frame of the vehicle bus with its values.

use crate::e2e;
use crate::{
    CameraLanes, Control, DecodeError, DriverRequest, EgoMotion, GateEcho, SensorHeader, SensorId,
    SensorObject, Status,
};

/// A frame of the vehicle bus. `system` is 0 for A and 1 for B; a greater one saturates to 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Message {
    /// Vehicle control by a system.
    Control {
        /// 0 = A, 1 = B
        system: u8,
        /// The values.
        control: Control,
    },
    /// Redundancy state of a system.
    Status {
        /// 0 = A, 1 = B
        system: u8,
        /// The values.
        status: Status,
    },
    /// The term that the vehicle obeys.
    GateEcho(GateEcho),
    /// Motion of the own vehicle.
    EgoMotion(EgoMotion),
    /// What the driver asks for.
    DriverRequest(DriverRequest),
    /// Beginning of an object list.
    SensorHeader(SensorId, SensorHeader),
    /// One object of a list.
    SensorObject(SensorId, SensorObject),
    /// The lanes that the camera sees.
    CameraLanes(CameraLanes),
}

impl Message {
    /// Reads a frame with a standard id. Does not check the end-to-end protection:
    /// [`Receiver`](crate::Receiver) does both.
    ///
    /// # Errors
    /// [`DecodeError`]: the frame is not in the DBC, or a value is not one that the DBC allows.
    pub fn decode(id: u32, data: &[u8]) -> Result<Self, DecodeError> {
        let id = u16::try_from(id).map_err(|_| DecodeError::UnknownId)?;
        if let Some(system) = position(&Control::IDS, id) {
            let control = Control::decode(data)?;
            if Control::SYSTEM.get(data)? != system as i64 {
                return Err(Control::SYSTEM.invalid());
            }
            return Ok(Self::Control {
                system: system as u8,
                control,
            });
        }
        if let Some(system) = position(&Status::IDS, id) {
            return Ok(Self::Status {
                system: system as u8,
                status: Status::decode(data)?,
            });
        }
        if let Some(index) = position(&SensorHeader::IDS, id) {
            return Ok(Self::SensorHeader(
                SensorId::ALL[index],
                SensorHeader::decode(data)?,
            ));
        }
        if let Some(index) = position(&SensorObject::IDS, id) {
            return Ok(Self::SensorObject(
                SensorId::ALL[index],
                SensorObject::decode(data)?,
            ));
        }
        match id {
            GateEcho::ID => GateEcho::decode(data).map(Self::GateEcho),
            EgoMotion::ID => EgoMotion::decode(data).map(Self::EgoMotion),
            DriverRequest::ID => DriverRequest::decode(data).map(Self::DriverRequest),
            CameraLanes::ID => CameraLanes::decode(data).map(Self::CameraLanes),
            _ => Err(DecodeError::UnknownId),
        }
    }

    /// The frame, protected end to end with this counter. [`Transmitter`](crate::Transmitter) keeps
    /// the counters.
    ///
    /// Values out of range saturate, fractions round to nearest, NaN becomes 0.
    #[must_use]
    pub fn encode(&self, counter: u8) -> Encoded {
        let mut encoded = match self {
            Self::Control { system, control } => {
                let system = (*system).min(1);
                Encoded::new(Control::IDS[usize::from(system)], |data| {
                    control.encode(data);
                    Control::SYSTEM.put(data, i64::from(system));
                })
            }
            Self::Status { system, status } => {
                Encoded::new(Status::IDS[usize::from((*system).min(1))], |data| {
                    status.encode(data)
                })
            }
            Self::GateEcho(echo) => Encoded::new(GateEcho::ID, |data| echo.encode(data)),
            Self::EgoMotion(motion) => Encoded::new(EgoMotion::ID, |data| motion.encode(data)),
            Self::DriverRequest(request) => {
                Encoded::new(DriverRequest::ID, |data| request.encode(data))
            }
            Self::SensorHeader(sensor, header) => {
                Encoded::new(sensor.header_id(), |data| header.encode(data))
            }
            Self::SensorObject(sensor, object) => {
                Encoded::new(sensor.object_id(), |data| object.encode(data))
            }
            Self::CameraLanes(lanes) => Encoded::new(CameraLanes::ID, |data| lanes.encode(data)),
        };
        e2e::protect(encoded.id, counter, &mut encoded.bytes[..encoded.len]);
        encoded
    }

    /// Id of the frame.
    #[must_use]
    pub const fn id(&self) -> u16 {
        match self {
            Self::Control { system, .. } => Control::IDS[if *system == 0 { 0 } else { 1 }],
            Self::Status { system, .. } => Status::IDS[if *system == 0 { 0 } else { 1 }],
            Self::GateEcho(_) => GateEcho::ID,
            Self::EgoMotion(_) => EgoMotion::ID,
            Self::DriverRequest(_) => DriverRequest::ID,
            Self::SensorHeader(sensor, _) => sensor.header_id(),
            Self::SensorObject(sensor, _) => sensor.object_id(),
            Self::CameraLanes(_) => CameraLanes::ID,
        }
    }
}

impl CameraLanes {
    /// The value of `own_end`, `left_end` and `right_end` that says "no end in sight", m.
    pub const NO_END: f32 = Self::OWN_END.greatest();
    /// The value of `speed_limit` that says "none", m/s.
    pub const NO_SPEED_LIMIT: f32 = Self::SPEED_LIMIT.greatest();
}

fn position(ids: &[u16], id: u16) -> Option<usize> {
    ids.iter().position(|known| *known == id)
}

/// A frame as it is on the bus: CAN FD with a standard id.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Encoded {
    /// Standard CAN id.
    pub id: u16,
    /// How many of `bytes` belong to the frame.
    pub len: usize,
    /// The data, zeroes from `len` on.
    pub bytes: [u8; 64],
}

impl Encoded {
    fn new<const LEN: usize>(id: u16, encode: impl FnOnce(&mut [u8; LEN])) -> Self {
        let mut data = [0; LEN];
        encode(&mut data);
        let mut bytes = [0; 64];
        bytes[..LEN].copy_from_slice(&data);
        Self {
            id,
            len: LEN,
            bytes,
        }
    }

    /// The data bytes.
    #[must_use]
    pub fn data(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}
