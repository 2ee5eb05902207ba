//! Parking with an SoC that says anything, a driver who asks for anything, and a parking brake and
//! a gear that hold nothing: what may not happen whatever they do. D-3

use super::{SocSample, Vehicle};
use crate::core0::driving::{Driving, Output};
use crate::driving::function::{Driver, FunctionState};
use crate::driving::parking::{
    BodyState, PARKING_SPEED, SOC_BRAKE_PERIOD, SOC_BRAKE_TIMEOUT, SOC_PERIOD, SOC_STOP_LIMIT,
    SOC_TIMEOUT,
};
use crate::driving::types::{Command, Ego};
use proptest::prelude::*;
use tandem_board::Duration;
use tandem_bus::{BrakeRequestCode, GearCode, ParkingBrakeCode};
use tandem_redundancy::Mode;
use tandem_topics::{
    BrakeRequest, Gear, LateralControl, LongitudinalControl, ParkingBrake, PowerControl,
};

/// What all say for a time.
#[derive(Clone, Debug)]
struct Phase {
    ms: u64,
    driver: Driver,
    permitted: Mode,
    /// Which topics arrive.
    arrive: [bool; 4],
    power: PowerControl,
    lateral: LateralControl,
    longitudinal: LongitudinalControl,
    brake: ParkingBrake,
}

fn power() -> impl Strategy<Value = PowerControl> {
    let speed = prop_oneof![3 => 0.0..4.0_f32, 1 => 0.0..327.0_f32];
    let distance = prop_oneof![0.0..3.0_f32, Just(6_553.5)];
    let gear = prop_oneof![6 => Just(Gear::Drive), 1 => Just(Gear::Neutral), 3 => Just(Gear::Park)];
    (speed, -32.0..32.0_f32, distance, gear).prop_map(
        |(target_speed, acceleration, distance, target_gear)| PowerControl {
            target_speed,
            acceleration,
            distance,
            target_gear,
            ..PowerControl::default()
        },
    )
}

fn phase() -> impl Strategy<Value = Phase> {
    let driver = prop_oneof![
        12 => Just(Driver::Parks),
        1 => Just(Driver::Drives),
        1 => Just(Driver::Unheard),
    ];
    let permitted = prop_oneof![
        12 => Just(Mode::L3),
        2 => Just(Mode::DegradedL2),
        1 => Just(Mode::SafeStop),
    ];
    let arrives = || prop::bool::weighted(0.97);
    let lateral = (prop::bool::weighted(0.97), -0.65..0.65_f32);
    let torque = prop_oneof![3 => Just(0.0), 1 => 0.0..20_000.0_f32];
    let longitudinal = (prop::bool::weighted(0.97), torque, 0.0..327.0_f32);
    let brake = prop_oneof![
        2 => Just(BrakeRequest::Keep),
        2 => Just(BrakeRequest::Apply),
        6 => Just(BrakeRequest::Release),
    ];
    let arrive = [arrives(), arrives(), arrives(), arrives()];
    let says = (power(), lateral, longitudinal, brake);
    (10..2_500_u64, driver, permitted, arrive, says).prop_map(
        |(ms, driver, permitted, arrive, (power, lateral, longitudinal, request))| Phase {
            ms,
            driver,
            permitted,
            arrive,
            power,
            lateral: LateralControl {
                enable: lateral.0,
                road_wheel_angle: lateral.1,
                ..LateralControl::default()
            },
            longitudinal: LongitudinalControl {
                enable: longitudinal.0,
                brake_torque: longitudinal.1,
                speed: longitudinal.2,
                ..LongitudinalControl::default()
            },
            brake: ParkingBrake {
                request,
                ..ParkingBrake::default()
            },
        },
    )
}

const HOLDS: BodyState = BodyState {
    gear: GearCode::Park,
    brake: ParkingBrakeCode::Applied,
};

/// The vehicle, and what must be known of its past.
struct Attack {
    vehicle: Vehicle,
    system: Driving,
    body: BodyState,
    /// Way of the motor of the parking brake, ms.
    way_ms: u64,
    /// The driver has asked, and has not driven since.
    asked: bool,
    /// It was parked, and the driver has not driven since.
    parked: bool,
    state: FunctionState,
    /// Since when it has this state, and since when it cannot drive, ms.
    since_ms: u64,
    held_ms: Option<u64>,
    /// When each topic arrived last with its control enabled, ms.
    heard_ms: [Option<u64>; 4],
    /// The stop that ended parking.
    secures: bool,
}

impl Attack {
    fn new() -> Self {
        Self {
            vehicle: Vehicle::new(),
            system: Driving::new(),
            body: BodyState::default(),
            way_ms: 0,
            asked: false,
            parked: false,
            state: FunctionState::Off,
            since_ms: 0,
            held_ms: None,
            heard_ms: [None; 4],
            secures: false,
        }
    }

    fn hears(&mut self, phase: &Phase) {
        let (now, ms) = (self.vehicle.now(), self.vehicle.ms);
        let samples = [
            SocSample::Power(phase.power),
            SocSample::Lateral(phase.lateral),
            SocSample::Longitudinal(phase.longitudinal),
            SocSample::Brake(phase.brake),
        ];
        for (index, sample) in samples.into_iter().enumerate() {
            let period = [SOC_PERIOD, SOC_BRAKE_PERIOD][index / 3].as_us() / 1_000;
            if phase.arrive[index] && ms.is_multiple_of(period) {
                self.system.on_soc(now, sample);
                let enables = [true, phase.lateral.enable, phase.longitudinal.enable, true];
                self.heard_ms[index] = enables[index].then_some(ms);
            }
        }
        let ego = Ego {
            speed: self.vehicle.state.speed as f32,
            yaw_rate: self.vehicle.state.yaw_rate as f32,
            steering_angle: self.vehicle.state.steering_angle as f32,
            ..Ego::default()
        };
        self.system.on_driver(phase.driver);
        self.system.on_ego(now, ego);
        if ms.is_multiple_of(50) {
            let scene = &mut self.vehicle.scene;
            (scene.at, scene.measured, scene.ego) = (now, now, ego);
            self.system.on_scene(scene.clone());
        }
        self.system.on_body(self.body);
    }

    /// Gear and brake move as they are asked.
    fn moves_body(&mut self, output: &Output) {
        let (gear, brake) = match output.body {
            _ if output.mode == Mode::None => (GearCode::Drive, BrakeRequestCode::Release),
            Some(request) => (request.gear, request.brake),
            None => (self.body.gear, BrakeRequestCode::Keep),
        };
        self.body.gear = gear;
        let applies = match brake {
            BrakeRequestCode::Apply => true,
            BrakeRequestCode::Release => false,
            BrakeRequestCode::Keep => matches!(
                self.body.brake,
                ParkingBrakeCode::Applied | ParkingBrakeCode::Applying
            ),
        };
        self.way_ms = if applies {
            (self.way_ms + 10).min(1_000)
        } else {
            self.way_ms.saturating_sub(10)
        };
        self.body.brake = match (applies, self.way_ms) {
            (true, 1_000) => ParkingBrakeCode::Applied,
            (true, _) => ParkingBrakeCode::Applying,
            (false, 0) => ParkingBrakeCode::Released,
            (false, _) => ParkingBrakeCode::Releasing,
        };
    }

    /// One control cycle, and what must hold after it.
    fn step(&mut self, phase: &Phase) {
        self.hears(phase);
        let now = self.vehicle.now();
        let mut output = self.system.cycle(now, phase.permitted);
        let (ms, speed) = (self.vehicle.ms, self.vehicle.state.speed);
        if output.state != self.state {
            self.secures = self.state == FunctionState::Parking;
            (self.state, self.since_ms) = (output.state, ms);
        }
        if phase.driver == Driver::Drives {
            (self.asked, self.parked) = (false, false);
        }
        self.asked |= phase.driver == Driver::Parks;
        assert!(
            self.asked || output.mode == Mode::None,
            "the driver has not asked"
        );
        if let Some(body) = output.body {
            let rests = body.gear == GearCode::Drive && body.brake != BrakeRequestCode::Apply;
            assert!(rests || speed < 0.06, "{body:?} at {speed} m/s");
        }
        let Command {
            steering_angle,
            acceleration,
        } = output.command;
        assert!(steering_angle.abs() < 0.62 && acceleration.abs() <= 9.5);
        if output.mode == Mode::None {
            output.command.acceleration = -2.0;
        }
        self.moves_body(&output);
        self.vehicle.obey(&output);
        self.judge(&output);
    }

    fn judge(&mut self, output: &Output) {
        let (ms, speed) = (self.vehicle.ms, self.vehicle.state.speed);
        let lasts = |since: u64, limit: Duration| ms - since > limit.as_us() / 1_000;
        let parks = output.state == FunctionState::Parking;
        // Parking may begin while another function accelerates through its highest speed.
        let begins = !lasts(self.since_ms, Duration::from_ms(1_000));
        let most = f64::from(PARKING_SPEED) + if begins { 0.3 } else { 0.15 };
        assert!(!parks || speed < most, "{speed} m/s");
        if self.body == BodyState::default() || output.mode == Mode::None {
            self.held_ms = None;
        } else if lasts(*self.held_ms.get_or_insert(ms), Duration::from_ms(1_000)) {
            assert!(speed < 1e-3, "{speed} m/s against {:?}", self.body);
        }
        self.parked |= parks && self.body == HOLDS;
        assert!(!self.parked || speed < 1e-3, "it was parked");
        assert!(!self.parked || output.mode == Mode::None || self.body == HOLDS);
        let stops = output.state == FunctionState::MinimalRisk && self.secures;
        if stops && lasts(self.since_ms, SOC_STOP_LIMIT) {
            assert!(speed < 1e-3, "{speed} m/s at the end of the stop");
        }
        if stops && lasts(self.since_ms, SOC_STOP_LIMIT + Duration::from_ms(1_500)) {
            assert_eq!(self.body, HOLDS);
        }
        let limits = [SOC_TIMEOUT, SOC_TIMEOUT, SOC_TIMEOUT, SOC_BRAKE_TIMEOUT];
        let late = |(heard, limit): (Option<u64>, Duration)| {
            heard.is_none_or(|at| lasts(at, limit + Duration::from_ms(10)))
        };
        let is_silent = self.heard_ms.into_iter().zip(limits).any(late);
        assert!(
            !parks || !is_silent || self.body == HOLDS,
            "{:?}",
            self.heard_ms
        );
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    #[test]
    fn nothing_that_the_soc_says_does_harm(phases in prop::collection::vec(phase(), 1..12)) {
        let mut attack = Attack::new();
        for phase in &phases {
            for _ in 0..phase.ms / 10 {
                attack.step(phase);
            }
        }
    }
}
