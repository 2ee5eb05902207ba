//! The parking application of the SoC: drives forward over a given way, stops, and parks. D-3
//!
//! | phase | what it asks for | next phase |
//! |---|---|---|
//! | waiting | the whole way, so that parking may begin | approaching: the function parks |
//! | approaching | the rest of the way, at most [`SPEED`] | holding: it stands at the end |
//! | holding | parking brake and gear P | parked: the vehicle tells that both hold |
//! | parked | the same | |
//! | given up | nothing: all controls are disabled, and the controller stops the vehicle | |
//!
//! Without [`EgoMotion`] for [`BLIND_AFTER`] it asks for speed 0, and for [`GIVES_UP_AFTER`] it
//! gives up. It also gives up if the driver overrides, and if the function parks no more.

use std::fmt;

use tandem_board::{Duration, Instant};
use tandem_bus::{EgoMotion, GearCode, Message, ModeCode, ParkingBrakeCode};
use tandem_topics::{
    BrakeRequest, Gear, LateralControl, LongitudinalControl, ParkingBrake, PowerControl,
};

/// The highest speed that it asks for, m/s.
pub const SPEED: f32 = 2.0;
/// The longest way, m.
pub const WAY_MAX: f32 = 50.0;
/// The acceleration that it asks for, m/s².
const ACCELERATION: f32 = 0.5;
/// It slows down towards the end with this deceleration, m/s².
const DECELERATION: f32 = 0.4;
/// It plans ahead by this time, s: the vehicle follows a falling speed late.
const PREVIEW_S: f32 = 0.4;
/// The vehicle stands if it is slower than this, m/s …
const STANDS: f32 = 0.05;
/// … for this long: the measurement has noise of 0.03 m/s while the vehicle moves.
const STANDS_FOR: Duration = Duration::from_ms(200);
/// The way is over if less than this is left, m.
const ARRIVED: f32 = 0.15;
/// Braking torque that holds the vehicle at its place, Nm.
const HOLDS_NM: f32 = 1_500.0;
/// Twenty periods of the frame: less than 0.5 m.
pub const BLIND_AFTER: Duration = Duration::from_ms(200);
/// The controller's link has not come back by itself.
pub const GIVES_UP_AFTER: Duration = Duration::from_ms(2_000);

/// Where the application is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ApproachPhase {
    /// The function does not park yet.
    Waiting,
    /// The vehicle drives.
    Approaching,
    /// The vehicle stands, and brake and gear are being set.
    Holding,
    /// The parking brake holds, and gear P is engaged.
    Parked,
    /// It ended before.
    GivenUp(GiveUp),
}

/// Why the application has given up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GiveUp {
    /// The driver steers or brakes.
    Overridden,
    /// The vehicle's motion is not heard.
    Blind,
    /// The function has left the state Parking.
    Stopped,
}

impl fmt::Display for ApproachPhase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Waiting => "waiting until the driving function parks",
            Self::Approaching => "approaching",
            Self::Holding => "standing: setting the parking brake and gear P",
            Self::Parked => "parked: the brake holds, gear P",
            Self::GivenUp(GiveUp::Overridden) => "given up: the driver took over",
            Self::GivenUp(GiveUp::Blind) => "given up: the vehicle's motion is not heard",
            Self::GivenUp(GiveUp::Stopped) => "given up: the driving function stopped parking",
        })
    }
}

/// What the SoC asks for: a sample of each topic, not yet protected.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Orders {
    /// `soc/power`
    pub power: PowerControl,
    /// `soc/lateral`
    pub lateral: LateralControl,
    /// `soc/longitudinal`
    pub longitudinal: LongitudinalControl,
    /// `soc/parking_brake`
    pub brake: ParkingBrake,
}

/// The parking application. It is told the time and the vehicle's frames.
#[derive(Clone, Debug)]
pub struct Approach {
    phase: ApproachPhase,
    way: f32,
    driven: f32,
    /// The newest motion, and when it arrived.
    motion: Option<(Instant, EgoMotion)>,
    /// When it was last seen to move.
    moved: Option<Instant>,
}

impl Approach {
    /// Creates an application that drives over a way, m; it is limited to 0 ..= [`WAY_MAX`].
    pub const fn new(way: f32) -> Self {
        Self {
            phase: ApproachPhase::Waiting,
            way: way.clamp(0.0, WAY_MAX),
            driven: 0.0,
            motion: None,
            moved: None,
        }
    }

    /// Returns the phase.
    pub const fn phase(&self) -> ApproachPhase {
        self.phase
    }

    /// Returns the way that was driven while the function parked, m.
    pub const fn driven(&self) -> f32 {
        self.driven
    }

    /// Takes a message of the vehicle bus that arrived at `now`, in the order of its id.
    pub fn on_message(&mut self, now: Instant, message: &Message) {
        match message {
            Message::EgoMotion(motion) => self.on_motion(now, *motion),
            Message::DriverRequest(request) if request.overrides && self.is_active() => {
                self.phase = ApproachPhase::GivenUp(GiveUp::Overridden);
            }
            Message::Control { control, .. } => self.on_mode(control.mode),
            _ => {}
        }
    }

    /// Returns whether it may still move the vehicle.
    const fn is_active(&self) -> bool {
        matches!(
            self.phase,
            ApproachPhase::Approaching | ApproachPhase::Holding
        )
    }

    const fn on_mode(&mut self, mode: ModeCode) {
        match (self.phase, mode) {
            (ApproachPhase::Waiting, ModeCode::Parking) if self.motion.is_some() => {
                self.phase = ApproachPhase::Approaching;
            }
            (_, ModeCode::Parking) => {}
            (ApproachPhase::Approaching | ApproachPhase::Holding, _) => {
                self.phase = ApproachPhase::GivenUp(GiveUp::Stopped);
            }
            _ => {}
        }
    }

    fn on_motion(&mut self, now: Instant, motion: EgoMotion) {
        let before = self.motion.replace((now, motion));
        if let (true, Some((at, before))) = (self.is_active(), before) {
            // The noise at standstill is no motion.
            let speed = f32::midpoint(before.speed, motion.speed);
            if speed > STANDS {
                self.driven += speed * now.since(at).as_secs_f32();
            }
        }
        let moved = match self.moved {
            Some(moved) if motion.speed.abs() < STANDS => moved,
            _ => now,
        };
        self.moved = Some(moved);
        let stands = now.since(moved) >= STANDS_FOR;
        let holds =
            motion.gear == GearCode::Park && motion.parking_brake == ParkingBrakeCode::Applied;
        match self.phase {
            ApproachPhase::Approaching if stands && self.left() < ARRIVED => {
                self.phase = ApproachPhase::Holding;
            }
            ApproachPhase::Holding if holds => self.phase = ApproachPhase::Parked,
            _ => {}
        }
    }

    fn left(&self) -> f32 {
        (self.way - self.driven).max(0.0)
    }

    /// Returns what to ask for at `now`.
    pub fn orders(&mut self, now: Instant) -> Orders {
        let silence = self.motion.map(|(at, _)| now.since(at));
        if self.is_active() && silence.is_none_or(|silence| silence > GIVES_UP_AFTER) {
            self.phase = ApproachPhase::GivenUp(GiveUp::Blind);
        }
        let is_blind = silence.is_none_or(|silence| silence > BLIND_AFTER);
        match self.phase {
            ApproachPhase::GivenUp(_) => Orders::default(),
            ApproachPhase::Holding | ApproachPhase::Parked => {
                let mut orders = self.drive(0.0, HOLDS_NM);
                orders.power.target_gear = Gear::Park;
                orders.brake.request = BrakeRequest::Apply;
                orders
            }
            ApproachPhase::Approaching if is_blind => self.drive(0.0, HOLDS_NM),
            ApproachPhase::Waiting | ApproachPhase::Approaching => {
                let speed = self.motion.map_or(0.0, |(_, motion)| motion.speed);
                let left = (self.left() - PREVIEW_S * speed).max(0.0);
                let allowed = (2.0 * DECELERATION * left).sqrt();
                self.drive(allowed.min(SPEED), 0.0)
            }
        }
    }

    /// Straight ahead with this speed, m/s, and this braking torque, Nm.
    fn drive(&self, speed: f32, brake_torque: f32) -> Orders {
        let is_held =
            |(_, motion): (Instant, EgoMotion)| motion.parking_brake != ParkingBrakeCode::Released;
        let request = match self.motion.is_some_and(is_held) {
            true => BrakeRequest::Release,
            false => BrakeRequest::Keep,
        };
        Orders {
            power: PowerControl {
                target_speed: speed,
                acceleration: ACCELERATION,
                distance: self.left(),
                target_gear: Gear::Drive,
                ..PowerControl::default()
            },
            lateral: LateralControl {
                enable: true,
                ..LateralControl::default()
            },
            longitudinal: LongitudinalControl {
                enable: true,
                brake_torque,
                speed,
                ..LongitudinalControl::default()
            },
            brake: ParkingBrake {
                request,
                ..ParkingBrake::default()
            },
        }
    }
}
