//! The topics between the controller and the SoC: names, types, quality of service. D-2 to D-4

use crate::{CanFrame, LateralControl, LongitudinalControl, ParkingBrake, PowerControl, TopicType};
use crate::{Durability, Endpoint, GuidPrefix, Qos, Reliability};

/// What the controller offers. A reader that joins late gets the last three frames. D-4
pub const UP: Qos = Qos {
    reliability: Reliability::Reliable,
    durability: Durability::TransientLocal,
    depth: 3,
};
/// What the controller asks for: commands from before it joined must not act. D-4
pub const DOWN: Qos = Qos {
    durability: Durability::Volatile,
    ..UP
};

const fn endpoint<T: TopicType>(topic: &'static str, qos: Qos) -> Endpoint {
    Endpoint {
        topic,
        type_name: T::TYPE_NAME,
        qos,
    }
}

/// What both systems write: each CAN frame that core 0 hears. D-2
pub static OUTPUTS: [Endpoint; 1] = [endpoint::<CanFrame>("vehicle/can", UP)];
/// What both systems read, in the order of [`SocTopic`]. D-3
pub static INPUTS: [Endpoint; 4] = [
    endpoint::<PowerControl>("soc/power", DOWN),
    endpoint::<LateralControl>("soc/lateral", DOWN),
    endpoint::<LongitudinalControl>("soc/longitudinal", DOWN),
    endpoint::<ParkingBrake>("soc/parking_brake", DOWN),
];

/// A topic of the downward direction; as a number, its place in [`INPUTS`]. D-3
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SocTopic {
    /// `PowerControl`
    Power = 0,
    /// `LateralControl`
    Lateral = 1,
    /// `LongitudinalControl`
    Longitudinal = 2,
    /// `ParkingBrake`
    ParkingBrake = 3,
}

impl SocTopic {
    /// Every topic, in the order of [`INPUTS`].
    pub const ALL: [Self; 4] = [
        Self::Power,
        Self::Lateral,
        Self::Longitudinal,
        Self::ParkingBrake,
    ];

    /// Period with which the SoC publishes it, ms.
    #[must_use]
    pub const fn period_ms(self) -> u32 {
        match self {
            Self::ParkingBrake => 100,
            Self::Power | Self::Lateral | Self::Longitudinal => 20,
        }
    }
}

/// Begins the names of the controller's participants.
const CONTROLLER: [u8; 6] = *b"tandem";

/// Returns the name of a system's participant: `system` is 0 for A and 1 for B, `start` differs
/// from start to start.
#[must_use]
pub const fn controller_prefix(system: u8, start: [u8; 5]) -> GuidPrefix {
    let [a, b, c, d, e, f] = CONTROLLER;
    let [v, w, x, y, z] = start;
    GuidPrefix([a, b, c, d, e, f, system, v, w, x, y, z])
}

/// Returns the system whose participant has this name: 0 is A, 1 is B; `None` for others.
#[must_use]
pub fn system_of(prefix: GuidPrefix) -> Option<u8> {
    let rest = prefix.0.strip_prefix(&CONTROLLER)?;
    rest.first().copied().filter(|system| *system < 2)
}
