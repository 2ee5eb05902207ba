//! Parking (core 0): drives as the SoC asks, at walking speed and within limits of its own. D-3
//!
//! The SoC sends four topics. The newest sample of each counts until its time-out; without all four
//! the SoC does not command, and the driving function stops the vehicle. What it asks for passes
//! three limits: the speed, acceleration and braking of this file, the rates of [`Shaper`], and the
//! interlocks of gear and parking brake, which move only while the vehicle stands. What stands in
//! the way is the SoC's matter: it has its own sensors.

use tandem_board::{Duration, Instant};
use tandem_bus::{BrakeRequestCode, GearCode, ParkingBrakeCode};
use tandem_topics::endpoints::SocTopic;
use tandem_topics::{
    BrakeRequest, Gear, LateralControl, LongitudinalControl, ParkingBrake, PowerControl,
};

use super::control::{STANDSTILL_BRAKE, Shaper, Wish, follows};
use super::function::FunctionState;
use super::math::{abs, clamp, max, min, sqrt};
use super::types::{Command, ControlStep, Ego, StepFunction};
use super::vehicle::{MASS_KG, WHEEL_RADIUS_M};

/// Period at which the SoC sends power, lateral and longitudinal control: half the rate of core 0
/// is enough at walking speed.
pub const SOC_PERIOD: Duration = Duration::from_ms(20);
/// A sample of these topics counts for this long: ten periods. A lost one is repaired within two,
/// and an ADAS computer without real time stalls for some 60 ms. At 3 m/s it is 0.6 m.
///
/// It also keeps two systems alike that receive a sample at different times: within this time,
/// steering and acceleration move by less than the comparison of both tolerates.
pub const SOC_TIMEOUT: Duration = Duration::from_ms(200);
/// Period at which the SoC sends the request to the parking brake.
pub const SOC_BRAKE_PERIOD: Duration = Duration::from_ms(100);
/// A request to the parking brake counts for this long: five periods. It moves nothing while the
/// vehicle drives.
pub const SOC_BRAKE_TIMEOUT: Duration = Duration::from_ms(500);

/// The highest speed in parking, m/s: the vehicle stands 1.8 m after a safe stop begins to brake.
pub const PARKING_SPEED: f32 = 3.0;
/// The largest acceleration in parking, m/s².
const PARKING_ACCELERATION: f32 = 1.0;
/// The hardest braking in parking, m/s²: what still counts as not hard, and so begins softly.
const PARKING_BRAKING: f32 = 4.0;
/// How hard the speed may always be reduced, m/s²: an SoC that permits no change of the speed could
/// otherwise not be slowed down.
const SLOWING: f32 = 1.0;
/// From the end of the way the vehicle brakes with this deceleration, m/s² …
const APPROACH_BRAKING: f32 = 0.5;
/// … as if it were ahead by this time, s: the delay of the brake.
const APPROACH_PREVIEW_S: f32 = 0.35;
/// Feedback of the speed, 1/s: stiffer than that of L3, for a stop within a few centimetres.
const SPEED_GAIN: f32 = 2.0;
/// A vehicle that shall be slower than this stands, m/s.
const HALTS: f32 = 0.05;

/// The longest time from the last sample of the SoC to standstill: the time-out, a control cycle,
/// 0.6 s until the brake acts after the largest acceleration, 1.2 s of braking at 2.5 m/s² from the
/// highest speed, and 0.8 s of releasing it softly.
pub const SOC_STOP_LIMIT: Duration = Duration::from_ms(2_800);

/// A sample of a topic of the SoC, decoded and checked end to end.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SocSample {
    /// Motion that the drive train shall reach.
    Power(PowerControl),
    /// Request to the steering.
    Lateral(LateralControl),
    /// Request to the brakes and the speed control.
    Longitudinal(LongitudinalControl),
    /// Request to the parking brake.
    Brake(ParkingBrake),
}

/// Gear and parking brake, as the vehicle reports them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct BodyState {
    pub(crate) gear: GearCode,
    pub(crate) brake: ParkingBrakeCode,
}

/// What core 0 asks of gear and parking brake.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct BodyRequest {
    pub(crate) gear: GearCode,
    pub(crate) brake: BrakeRequestCode,
}

/// The newest samples of all topics: what the SoC asks for.
#[derive(Clone, Copy, Debug)]
struct Asked {
    power: PowerControl,
    lateral: LateralControl,
    longitudinal: LongitudinalControl,
    brake: ParkingBrake,
}

/// The SoC's samples, and the control that follows them.
#[derive(Clone, Debug)]
pub(crate) struct Parking {
    power: Option<(Instant, PowerControl)>,
    lateral: Option<(Instant, LateralControl)>,
    longitudinal: Option<(Instant, LongitudinalControl)>,
    brake: Option<(Instant, ParkingBrake)>,
    body: BodyState,
    shaper: Shaper,
    wish: Wish,
    last_step: ControlStep,
    /// The function parks, or secures the vehicle in the stop that ended it.
    secures: bool,
}

impl Parking {
    pub(crate) fn new() -> Self {
        Self {
            power: None,
            lateral: None,
            longitudinal: None,
            brake: None,
            body: BodyState::default(),
            shaper: Shaper::new(),
            wish: Wish::default(),
            last_step: ControlStep::default(),
            secures: false,
        }
    }

    /// Takes a sample that arrived at `at`.
    pub(crate) const fn on_sample(&mut self, at: Instant, sample: SocSample) {
        match sample {
            SocSample::Power(sample) => self.power = Some((at, sample)),
            SocSample::Lateral(sample) => self.lateral = Some((at, sample)),
            SocSample::Longitudinal(sample) => self.longitudinal = Some((at, sample)),
            SocSample::Brake(sample) => self.brake = Some((at, sample)),
        }
    }

    pub(crate) const fn on_body(&mut self, body: BodyState) {
        self.body = body;
    }

    /// Returns what the SoC asks for at `now`, or the topic without which it does not command: the
    /// sample is missing or too old, or disables its control.
    fn asked(&self, now: Instant) -> Result<Asked, SocTopic> {
        fn fresh<T: Copy>(
            now: Instant,
            newest: &Option<(Instant, T)>,
            limit: Duration,
        ) -> Option<T> {
            let is_fresh = |(at, _): &&(Instant, T)| now.since(*at) <= limit;
            newest.as_ref().filter(is_fresh).map(|(_, sample)| *sample)
        }
        let lateral = fresh(now, &self.lateral, SOC_TIMEOUT).filter(|it| it.enable);
        let longitudinal = fresh(now, &self.longitudinal, SOC_TIMEOUT).filter(|it| it.enable);
        Ok(Asked {
            power: fresh(now, &self.power, SOC_TIMEOUT).ok_or(SocTopic::Power)?,
            lateral: lateral.ok_or(SocTopic::Lateral)?,
            longitudinal: longitudinal.ok_or(SocTopic::Longitudinal)?,
            brake: fresh(now, &self.brake, SOC_BRAKE_TIMEOUT).ok_or(SocTopic::ParkingBrake)?,
        })
    }

    /// Returns whether parking may begin: the SoC commands, and the vehicle is slow.
    pub(crate) fn may_begin(&self, now: Instant, ego: &Ego) -> bool {
        ego.speed <= PARKING_SPEED && self.asked(now).is_ok()
    }

    /// Returns the topic whose silence ends parking; `None` also if the vehicle is parked, because
    /// then the SoC's work is done.
    pub(crate) fn silent(&self, now: Instant) -> Option<SocTopic> {
        let silent = self.asked(now).err();
        silent.filter(|_| !self.is_parked())
    }

    /// Returns whether gear and brake hold the vehicle without a controller.
    fn is_parked(&self) -> bool {
        (self.body.gear, self.body.brake) == (GearCode::Park, ParkingBrakeCode::Applied)
    }

    /// Returns the age of the oldest sample that moves the vehicle; `None` if the SoC does not
    /// command.
    pub(crate) fn age(&self, now: Instant) -> Option<Duration> {
        self.asked(now).ok()?;
        let moves = [self.power?.0, self.lateral?.0, self.longitudinal?.0];
        moves.into_iter().map(|at| now.since(at)).max()
    }

    pub(crate) fn wish(&self) -> Wish {
        self.wish
    }

    pub(crate) fn resume(&mut self, last: &Command) {
        self.shaper.resume(last);
    }

    pub(crate) fn last_step(&self) -> &ControlStep {
        &self.last_step
    }

    /// Returns the command for `now`; to be called every 10 ms while the function parks.
    pub(crate) fn step(&mut self, now: Instant, ego: &Ego) -> Command {
        let last = self.shaper.last();
        let pose = match self.asked(now) {
            Ok(asked) => self.pose(&asked, ego),
            Err(_) => [last.steering_angle, 0.0, 0.0],
        };
        let step = ControlStep {
            function: StepFunction::Parking,
            pose,
            ego: *ego,
            last,
            ..ControlStep::default()
        };
        self.wish = wish(&step);
        let command = self.shaper.shape(&self.wish, ego);
        self.last_step = ControlStep { command, ..step };
        command
    }

    /// Returns angle, speed and acceleration that the SoC asks for, as [`ControlStep::pose`].
    fn pose(&self, asked: &Asked, ego: &Ego) -> [f32; 3] {
        let Asked {
            power,
            lateral,
            longitudinal,
            brake,
        } = asked;
        // The vehicle stops first if it shall not drive, or cannot.
        let drives = power.target_gear == Gear::Drive
            && brake.request != BrakeRequest::Apply
            && self.body == BodyState::default();
        let left = max(power.distance - APPROACH_PREVIEW_S * ego.speed, 0.0);
        let approach = sqrt(2.0 * APPROACH_BRAKING * left);
        let speed = match drives {
            true => min(min(power.target_speed, longitudinal.speed), approach),
            false => 0.0,
        };
        let acceleration = if longitudinal.brake_torque > 0.0 {
            -longitudinal.brake_torque / (MASS_KG * WHEEL_RADIUS_M)
        } else {
            abs(power.acceleration)
        };
        [lateral.road_wheel_angle, speed, acceleration]
    }

    /// Returns what to ask of gear and parking brake; `None` while parking has nothing to do with
    /// them. `speed`: of the vehicle, m/s. To be called in each control cycle.
    pub(crate) fn body(
        &mut self,
        now: Instant,
        state: FunctionState,
        speed: f32,
    ) -> Option<BodyRequest> {
        self.secures = match state {
            FunctionState::Parking => true,
            FunctionState::MinimalRisk => self.secures,
            _ => false,
        };
        if !self.secures {
            return None;
        }
        let stands = speed < HALTS;
        let asked = self.asked(now).ok();
        let secured = BodyRequest {
            gear: GearCode::Park,
            brake: BrakeRequestCode::Apply,
        };
        let (gear, brake) = match asked.filter(|_| state == FunctionState::Parking) {
            Some(asked) => (asked.power.target_gear, asked.brake.request),
            None if stands => return Some(secured),
            None => (Gear::Drive, BrakeRequest::Keep),
        };
        Some(BodyRequest {
            gear: match gear {
                Gear::Drive => GearCode::Drive,
                _ if !stands => GearCode::Drive,
                Gear::Neutral => GearCode::Neutral,
                Gear::Park => GearCode::Park,
            },
            brake: match brake {
                BrakeRequest::Apply if stands => BrakeRequestCode::Apply,
                BrakeRequest::Keep | BrakeRequest::Apply => BrakeRequestCode::Keep,
                BrakeRequest::Release => BrakeRequestCode::Release,
            },
        })
    }
}

/// Returns whether a step of parking follows from its inputs. Another core does not hear the SoC:
/// it finds a fault in the limits and in the arithmetic. T-RED-9
#[must_use]
pub fn is_right_parking(step: &ControlStep) -> bool {
    follows(step, &wish(step))
}

/// The command of this step before the limits of its rates.
fn wish(step: &ControlStep) -> Wish {
    let [steering_angle, speed, acceleration] = step.pose;
    let speed = clamp(speed, 0.0, PARKING_SPEED);
    let faster = clamp(acceleration, 0.0, PARKING_ACCELERATION);
    let slower = clamp(acceleration, SLOWING, PARKING_BRAKING);
    let brake = clamp(acceleration, -PARKING_BRAKING, 0.0);
    let follows_speed = clamp(SPEED_GAIN * (speed - step.ego.speed), -slower, faster);
    let acceleration = if speed < HALTS && step.ego.speed < 0.3 {
        STANDSTILL_BRAKE
    } else if brake < 0.0 {
        min(follows_speed, brake)
    } else {
        follows_speed
    };
    Wish {
        command: Command {
            steering_angle,
            acceleration,
        },
        urgent: false,
    }
}
