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
pub const SOC_PERIOD: Duration = Duration::from_ms(SocTopic::Power.period_ms() as u64);
/// A sample of these topics counts for this long: ten periods. A lost one is repaired within two,
/// and an ADAS computer without real time stalls for some 60 ms. At 3 m/s it is 0.6 m.
///
/// Two systems may receive a sample at times that differ by as much: steering and acceleration move
/// so slowly that the comparison of both does not take this for a disagreement.
pub const SOC_TIMEOUT: Duration = Duration::from_ms(200);
/// Period at which the SoC sends the request to the parking brake.
pub const SOC_BRAKE_PERIOD: Duration = Duration::from_ms(SocTopic::ParkingBrake.period_ms() as u64);
/// A request to the parking brake counts for this long: five periods. It moves nothing while the
/// vehicle drives.
pub const SOC_BRAKE_TIMEOUT: Duration = Duration::from_ms(500);

/// The highest speed in parking, m/s: a safe stop brakes for 1.8 m from there.
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

/// The longest time from the last sample of the SoC to standstill: the time-out, 0.6 s from the
/// largest acceleration to the braking of a safe stop without a jerk, and 1.5 s of braking from the
/// highest speed with a soft end.
pub const SOC_STOP_LIMIT: Duration = Duration::from_ms(2_300);

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
    /// It was parked, and the driver has not driven since: the SoC commands no more.
    is_done: bool,
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
            is_done: false,
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
    /// sample is missing or too old, or disables its control. Nothing once the vehicle was parked.
    fn asked(&self, now: Instant) -> Result<Asked, SocTopic> {
        fn fresh<T: Copy>(
            now: Instant,
            newest: &Option<(Instant, T)>,
            limit: Duration,
        ) -> Option<T> {
            let is_fresh = |(at, _): &&(Instant, T)| now.since(*at) <= limit;
            newest.as_ref().filter(is_fresh).map(|(_, sample)| *sample)
        }
        if self.is_done {
            return Err(SocTopic::ParkingBrake);
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
        let parks = state == FunctionState::Parking && self.is_parked();
        self.is_done = self.secures && (self.is_done || parks);
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

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;
    extern crate std;

    const MS: fn(u64) -> Instant = |ms| Instant::from_ns((10_000 + ms) * 1_000_000);

    fn samples() -> [SocSample; 4] {
        [
            SocSample::Power(PowerControl {
                target_speed: 2.0,
                acceleration: 0.5,
                distance: 50.0,
                target_gear: Gear::Drive,
                ..PowerControl::default()
            }),
            SocSample::Lateral(LateralControl {
                enable: true,
                road_wheel_angle: 0.2,
                ..LateralControl::default()
            }),
            SocSample::Longitudinal(LongitudinalControl {
                enable: true,
                speed: 3.0,
                ..LongitudinalControl::default()
            }),
            SocSample::Brake(ParkingBrake {
                request: BrakeRequest::Release,
                ..ParkingBrake::default()
            }),
        ]
    }

    /// A vehicle at this speed, m/s, and an SoC whose samples have arrived at 0 ms.
    fn heard(alter: impl Fn(&mut SocSample)) -> Parking {
        let mut parking = Parking::new();
        for mut sample in samples() {
            alter(&mut sample);
            parking.on_sample(MS(0), sample);
        }
        parking
    }

    fn at(speed: f32) -> Ego {
        Ego {
            speed,
            ..Ego::default()
        }
    }

    /// D-3: the SoC commands only with all four topics. Each counts until its time-out, and a
    /// control that is disabled does not count.
    #[test]
    fn each_topic_has_its_time_out() {
        let topics = [
            (SocTopic::Power, SOC_TIMEOUT),
            (SocTopic::Lateral, SOC_TIMEOUT),
            (SocTopic::Longitudinal, SOC_TIMEOUT),
            (SocTopic::ParkingBrake, SOC_BRAKE_TIMEOUT),
        ];
        for (silent, (topic, limit)) in topics.into_iter().enumerate() {
            let mut missing = Parking::new();
            let mut late = heard(|_| {});
            for (index, sample) in samples().into_iter().enumerate() {
                if index != silent {
                    missing.on_sample(MS(0), sample);
                    late.on_sample(MS(0) + limit, sample);
                }
            }
            assert_eq!(missing.silent(MS(0)), Some(topic));
            assert_eq!(late.silent(MS(0) + limit), None, "{topic:?}");
            let over = MS(0) + limit + Duration::from_us(1);
            assert_eq!(late.silent(over), Some(topic));
            assert!(late.may_begin(MS(0), &at(PARKING_SPEED)));
            assert!(
                !late.may_begin(MS(0), &at(PARKING_SPEED + 0.1)) && !late.may_begin(over, &at(0.0))
            );
            late.on_body(PARKED);
            assert_eq!(late.silent(over), None, "its work is done");
        }
        for topic in [SocTopic::Lateral, SocTopic::Longitudinal] {
            let parking = heard(|sample| match (sample, topic) {
                (SocSample::Lateral(it), SocTopic::Lateral) => it.enable = false,
                (SocSample::Longitudinal(it), SocTopic::Longitudinal) => it.enable = false,
                _ => {}
            });
            assert_eq!(parking.silent(MS(0)), Some(topic));
        }
    }

    const PARKED: BodyState = BodyState {
        gear: GearCode::Park,
        brake: ParkingBrakeCode::Applied,
    };

    /// The wish of a vehicle at `speed` whose SoC sends `samples()` with this change.
    fn wished(speed: f32, alter: impl Fn(&mut SocSample)) -> f32 {
        let mut parking = heard(alter);
        parking.step(MS(0), &at(speed));
        parking.wish().command.acceleration
    }

    fn power(sample: &mut SocSample, alter: impl Fn(&mut PowerControl)) {
        if let SocSample::Power(power) = sample {
            alter(power);
        }
    }

    fn longitudinal(sample: &mut SocSample, alter: impl Fn(&mut LongitudinalControl)) {
        if let SocSample::Longitudinal(longitudinal) = sample {
            alter(longitudinal);
        }
    }

    /// D-3: each value of the SoC acts, and none beyond the limits.
    #[test]
    fn the_soc_is_followed_within_the_limits() {
        let near = |one: f32, other: f32| assert!(abs(one - other) < 0.02, "{one} {other}");
        near(wished(0.0, |_| {}), 0.5);
        near(
            wished(0.0, |it| power(it, |it| it.acceleration = 30.0)),
            PARKING_ACCELERATION,
        );
        near(
            wished(0.0, |it| power(it, |it| it.acceleration = -30.0)),
            PARKING_ACCELERATION,
        );
        near(wished(2.0, |_| {}), 0.0);
        near(
            wished(2.0, |it| longitudinal(it, |it| it.speed = 1.8)),
            -0.4,
        );
        near(
            wished(2.5, |it| power(it, |it| it.acceleration = 0.0)),
            -SLOWING,
        );
        // No speed above the limit.
        let races = |it: &mut SocSample| {
            power(it, |it| it.target_speed = 300.0);
            longitudinal(it, |it| it.speed = 300.0);
        };
        near(wished(PARKING_SPEED, races), 0.0);
        near(wished(PARKING_SPEED + 0.1, races), -0.2);
        // The brake: 752 Nm are 2 m/s².
        near(
            wished(1.0, |it| longitudinal(it, |it| it.brake_torque = 752.0)),
            -2.0,
        );
        near(
            wished(1.0, |it| longitudinal(it, |it| it.brake_torque = 20_000.0)),
            -PARKING_BRAKING,
        );
        // The end of the way, and what keeps the vehicle from driving.
        near(
            wished(2.0, |it| power(it, |it| it.distance = 0.0)),
            -SLOWING,
        );
        near(
            wished(0.0, |it| power(it, |it| it.distance = 0.0)),
            STANDSTILL_BRAKE,
        );
        near(
            wished(0.0, |it| power(it, |it| it.target_gear = Gear::Park)),
            STANDSTILL_BRAKE,
        );
        let applies = |it: &mut SocSample| {
            if let SocSample::Brake(brake) = it {
                brake.request = BrakeRequest::Apply;
            }
        };
        near(wished(0.0, applies), STANDSTILL_BRAKE);
        for body in [
            PARKED,
            BodyState {
                gear: GearCode::Drive,
                ..PARKED
            },
        ] {
            let mut parking = heard(|_| {});
            parking.on_body(body);
            parking.step(MS(0), &at(0.0));
            near(parking.wish().command.acceleration, STANDSTILL_BRAKE);
        }
    }

    /// D-3: gear and brake move only while the vehicle stands. In the stop that ends parking they
    /// hold it; in a stop without parking they are left alone.
    #[test]
    fn gear_and_brake_wait_for_standstill() {
        use FunctionState as F;
        let parks = |it: &mut SocSample| match it {
            SocSample::Power(power) => power.target_gear = Gear::Park,
            SocSample::Brake(brake) => brake.request = BrakeRequest::Apply,
            _ => {}
        };
        let (drive, park) = (GearCode::Drive, GearCode::Park);
        let (keep, apply, release) = (
            BrakeRequestCode::Keep,
            BrakeRequestCode::Apply,
            BrakeRequestCode::Release,
        );
        let mut parking = heard(parks);
        let mut body = |now, state, speed| {
            let request = parking.body(now, state, speed);
            request.map(|BodyRequest { gear, brake }| (gear, brake))
        };
        let over = MS(501);
        assert_eq!(body(MS(0), F::MinimalRisk, 0.0), None);
        assert_eq!(body(MS(0), F::Active, 0.0), None);
        assert_eq!(body(MS(0), F::Parking, 1.0), Some((drive, keep)));
        assert_eq!(body(MS(0), F::Parking, 0.0), Some((park, apply)));
        assert_eq!(body(over, F::MinimalRisk, 1.0), Some((drive, keep)));
        assert_eq!(body(over, F::MinimalRisk, 0.0), Some((park, apply)));
        assert_eq!(body(over, F::Ready, 0.0), None);
        assert_eq!(body(over, F::MinimalRisk, 0.0), None);
        let mut parking = heard(|_| {});
        let request = parking.body(MS(0), F::Parking, 1.0);
        let released = BodyRequest {
            gear: drive,
            brake: release,
        };
        assert_eq!(request, Some(released));
    }

    /// T-RED-9: another core accepts a right step, and rejects one with any wrong part.
    #[test]
    fn a_step_is_computed_again() {
        let mut parking = heard(|_| {});
        for cycle in 0..15 {
            parking.step(MS(10 * cycle), &at(1.0));
            assert!(is_right_parking(parking.last_step()), "{cycle}");
        }
        let good = *parking.last_step();
        let faults: [fn(&mut ControlStep); 5] = [
            |step| step.command.steering_angle += 1e-4,
            |step| step.command.acceleration += 0.01,
            |step| step.command = step.last,
            |step| step.pose[1] = 1.0,
            |step| step.command.steering_angle = f32::NAN,
        ];
        for (index, fault) in faults.iter().enumerate() {
            let mut step = good;
            fault(&mut step);
            assert!(!is_right_parking(&step), "fault {index}");
        }
    }

    /// D-3: the documentation states the times and limits that the code keeps.
    #[test]
    fn the_limits_in_the_docs_are_those_that_run() {
        let docs = include_str!("../../../docs/driving-function.md");
        let row = |first: &str| -> Vec<&str> {
            let mut rows = docs
                .lines()
                .map(|line| line.split('|').map(str::trim).collect::<Vec<_>>());
            rows.find(|row| row.get(1) == Some(&first)).expect("a row")
        };
        let ms = |time: Duration| std::format!("{} ms", time.as_us() / 1_000);
        for topic in [
            "`PowerControl`",
            "`LateralControl`",
            "`LongitudinalControl`",
        ] {
            assert_eq!(row(topic)[2..4], [ms(SOC_PERIOD), ms(SOC_TIMEOUT)]);
        }
        assert_eq!(
            row("`ParkingBrake`")[2..4],
            [ms(SOC_BRAKE_PERIOD), ms(SOC_BRAKE_TIMEOUT)]
        );
        assert_eq!(row("speed")[2], std::format!("{PARKING_SPEED} m/s"));
        let both = std::format!("{PARKING_ACCELERATION} m/s², {PARKING_BRAKING} m/s²");
        assert_eq!(row("acceleration, braking")[2], both);
        let stop = std::format!(
            "at most {} s after the last sample",
            SOC_STOP_LIMIT.as_secs_f32()
        );
        assert!(docs.replace('\n', " ").contains(&stop), "{stop}");
    }
}
