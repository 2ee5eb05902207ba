//! Where and in which state a sequence of wrong values begins.

use serde::{Deserialize, Serialize};
use tandem_board::{Duration, SystemId};

/// The road of a closed loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DriveRoad {
    /// A jam behind another vehicle. After three seconds it brakes to a stop. Straight for 600 m.
    StopAndGo,
    /// Light traffic on three lanes; straight for 500 m, then bends of 1,200 to 2,000 m radius.
    FreeLane,
}

impl DriveRoad {
    /// All roads.
    pub const ALL: [Self; 2] = [Self::StopAndGo, Self::FreeLane];

    /// Returns the name of the embedded scenario.
    #[must_use]
    pub const fn scenario(self) -> &'static str {
        match self {
            Self::StopAndGo => "stop-and-go",
            Self::FreeLane => "free-lane",
        }
    }
}

/// The setting in which the faults of a sequence begin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DriveSetting {
    /// The road.
    pub road: DriveRoad,
    /// The system that drives. The numbered sequences call it A.
    pub driver: SystemId,
    /// The other system has lost its power before.
    pub is_alone: bool,
    /// How long the vehicle has driven.
    pub driven: Duration,
}

impl DriveSetting {
    /// The places: a straight road, one that begins to bend, and a jam.
    pub const PLACES: [(&'static str, DriveRoad, Duration); 3] = [
        ("straight", DriveRoad::FreeLane, Duration::from_ms(4_000)),
        ("bend", DriveRoad::FreeLane, Duration::from_ms(10_000)),
        ("jam", DriveRoad::StopAndGo, Duration::from_ms(12_000)),
    ];

    /// Returns the name of its place.
    #[must_use]
    pub fn place(&self) -> &'static str {
        let is_same = |it: &&(&str, DriveRoad, Duration)| (it.1, it.2) == (self.road, self.driven);
        Self::PLACES.iter().find(is_same).map_or("", |it| it.0)
    }
}
