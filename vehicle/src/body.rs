//! Gear and parking brake of the vehicle: how they move, and what they do to the acceleration. D-3

use tandem_bus::{BrakeRequestCode, GearCode, ParkingBrakeCode};

/// Time in which the motor of the parking brake applies or releases it, ms.
pub const BRAKE_MOVES_MS: u16 = 1_000;
/// Deceleration of the applied brake, m/s². It holds the vehicle against less drive than this.
pub const BRAKE_HOLDS: f64 = 3.0;

/// What is asked of gear and parking brake.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct BodyWish {
    pub(crate) gear: GearCode,
    pub(crate) brake: BrakeRequestCode,
}

impl BodyWish {
    /// A driver who drives selects the gear and releases the brake.
    pub(crate) const DRIVE: Self = Self {
        gear: GearCode::Drive,
        brake: BrakeRequestCode::Release,
    };
}

/// The state of gear and parking brake.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Body {
    gear: GearCode,
    /// The motor applies the brake, or has applied it.
    applies: bool,
    /// Way of the motor: 0 is released, [`BRAKE_MOVES_MS`] applied.
    way_ms: u16,
}

impl Body {
    /// Moves for one millisecond. A moving vehicle never locks its drive train: the selector waits.
    pub(crate) fn step(&mut self, wish: BodyWish, speed: f64) {
        match wish.brake {
            BrakeRequestCode::Keep => {}
            BrakeRequestCode::Apply => self.applies = true,
            BrakeRequestCode::Release => self.applies = false,
        }
        self.way_ms = if self.applies {
            (self.way_ms + 1).min(BRAKE_MOVES_MS)
        } else {
            self.way_ms.saturating_sub(1)
        };
        if wish.gear != GearCode::Park || speed <= 0.0 {
            self.gear = wish.gear;
        }
    }

    pub(crate) const fn gear(self) -> GearCode {
        self.gear
    }

    pub(crate) const fn parking_brake(self) -> ParkingBrakeCode {
        match (self.applies, self.way_ms) {
            (true, BRAKE_MOVES_MS) => ParkingBrakeCode::Applied,
            (true, _) => ParkingBrakeCode::Applying,
            (false, 0) => ParkingBrakeCode::Released,
            (false, _) => ParkingBrakeCode::Releasing,
        }
    }

    /// Returns the acceleration that is left of the one that powertrain and service brake give,
    /// m/s². `speed`: not negative, m/s.
    pub(crate) fn limit(self, acceleration: f64, speed: f64) -> f64 {
        let stands = speed <= 0.0;
        if stands && self.gear == GearCode::Park {
            return 0.0;
        }
        let driven = match self.gear {
            GearCode::Drive => acceleration,
            GearCode::Neutral | GearCode::Park => acceleration.min(0.0),
        };
        if self.way_ms == 0 {
            return driven;
        }
        let holds = BRAKE_HOLDS * f64::from(self.way_ms) / f64::from(BRAKE_MOVES_MS);
        if stands {
            (driven - holds).max(0.0)
        } else {
            driven - holds
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ParkingBrakeCode::{Applied, Applying, Released, Releasing};

    /// D-3: the brake moves within its time, and a request that is kept is completed.
    #[test]
    fn the_brake_takes_a_second_to_apply_and_to_release() {
        let mut body = Body::default();
        let wish = |brake| BodyWish {
            gear: GearCode::Drive,
            brake,
        };
        let mut states = vec![(0, body.parking_brake())];
        for ms in 1..=4_000 {
            let brake = match ms {
                100 => BrakeRequestCode::Apply,
                2_000 => BrakeRequestCode::Release,
                _ => BrakeRequestCode::Keep,
            };
            body.step(wish(brake), 0.0);
            if states
                .last()
                .is_some_and(|(_, last)| *last != body.parking_brake())
            {
                states.push((ms, body.parking_brake()));
            }
            let holds = BRAKE_HOLDS * f64::from(body.way_ms) / 1e3;
            let near = |one: f64, other: f64| (one - other).abs() < 1e-9;
            assert!(near(body.limit(5.0, 0.0), 5.0 - holds), "{ms}");
            assert!(near(body.limit(holds, 0.0), 0.0), "{ms}");
            assert!(near(body.limit(-1.0, 2.0), -1.0 - holds), "{ms}");
        }
        let expected = [
            (0, Released),
            (100, Applying),
            (1_099, Applied),
            (2_000, Releasing),
            (2_999, Released),
        ];
        assert_eq!(states, expected);
    }

    /// D-3: only Drive passes torque on. Park waits for standstill, and then locks.
    #[test]
    fn a_gear_passes_on_what_it_can() {
        let mut body = Body::default();
        let mut select = |gear, speed| {
            let brake = BrakeRequestCode::Keep;
            body.step(BodyWish { gear, brake }, speed);
            (body.gear(), body.limit(1.0, speed), body.limit(-1.0, speed))
        };
        assert_eq!(select(GearCode::Park, 2.0), (GearCode::Drive, 1.0, -1.0));
        assert_eq!(
            select(GearCode::Neutral, 2.0),
            (GearCode::Neutral, 0.0, -1.0)
        );
        assert_eq!(select(GearCode::Park, 0.1), (GearCode::Neutral, 0.0, -1.0));
        assert_eq!(select(GearCode::Park, 0.0), (GearCode::Park, 0.0, 0.0));
        assert_eq!(select(GearCode::Drive, 0.0), (GearCode::Drive, 1.0, -1.0));
    }
}
