//! Tests of the control with the plant of the vehicle: parking that ends in a stop, and two systems
//! that hear the SoC at different times. D-3
extern crate std;

mod attack;

use super::super::agreement::{Agreement, Deviation, Stage};
use super::{Driving, Output};
use crate::driving::function::{Driver, FunctionState};
use crate::driving::parking::{
    PARKING_SPEED, SOC_BRAKE_TIMEOUT, SOC_PERIOD, SOC_STOP_LIMIT, SOC_TIMEOUT, SocSample,
};
use crate::driving::perception::Perception;
use crate::driving::types::{Ego, Lanes, Scene};
use tandem_board::{Duration, Instant};
use tandem_redundancy::{Mode, Phase};
use tandem_topics::{
    BrakeRequest, Gear, LateralControl, LongitudinalControl, ParkingBrake, PowerControl,
};
use tandem_vehicle::actuators::{Actuators, Request};
use tandem_vehicle::plant::{BMW_320I, PlantState};

/// What the SoC asks for: speed, m/s, and road wheel angle, rad.
fn samples((speed, angle): (f32, f32)) -> [SocSample; 4] {
    [
        SocSample::Power(PowerControl {
            target_speed: speed,
            acceleration: 30.0,
            distance: 1_000.0,
            target_gear: Gear::Drive,
            ..PowerControl::default()
        }),
        SocSample::Lateral(LateralControl {
            enable: true,
            road_wheel_angle: angle,
            ..LateralControl::default()
        }),
        SocSample::Longitudinal(LongitudinalControl {
            enable: true,
            speed,
            ..LongitudinalControl::default()
        }),
        SocSample::Brake(ParkingBrake {
            request: BrakeRequest::Release,
            ..ParkingBrake::default()
        }),
    ]
}

/// The vehicle in its lane, and the time since its start, ms.
struct Vehicle {
    state: PlantState,
    actuators: Actuators,
    scene: Scene,
    ms: u64,
}

impl Vehicle {
    fn new() -> Self {
        let lanes = Some(Lanes::alone(3.5, 80.0));
        Self {
            state: PlantState::default(),
            actuators: Actuators::settled(Request::default()),
            scene: Scene {
                lanes,
                ..Perception::new().scene().clone()
            },
            ms: 0,
        }
    }

    fn now(&self) -> Instant {
        Instant::from_ns((1_000 + self.ms) * 1_000_000)
    }

    /// One control cycle of a system.
    fn control(&mut self, system: &mut Driving) -> Output {
        let ego = Ego {
            speed: self.state.speed as f32,
            yaw_rate: self.state.yaw_rate as f32,
            steering_angle: self.state.steering_angle as f32,
            ..Ego::default()
        };
        system.on_driver(Driver::Parks);
        system.on_ego(self.now(), ego);
        if self.ms.is_multiple_of(50) {
            (self.scene.at, self.scene.measured, self.scene.ego) = (self.now(), self.now(), ego);
            system.on_scene(self.scene.clone());
        }
        system.cycle(self.now(), Mode::L3)
    }

    /// The vehicle obeys for 10 ms.
    fn obey(&mut self, output: &Output) {
        for _ in 0..10 {
            let request = Request {
                steering_angle: f64::from(output.command.steering_angle),
                acceleration: f64::from(output.command.acceleration),
            };
            let input = self.actuators.step(request, &self.state, &BMW_320I);
            self.state = self.state.stepped(input, 1e-3, &BMW_320I);
            self.state.speed = self.state.speed.max(0.0);
            if self.state.speed < 0.1 {
                self.state.settle_slowly_rolling(&BMW_320I);
            }
            self.ms += 1;
        }
    }
}

/// Parks at `speed`; from `cut_ms` on no sample of the topics `cut` arrives. Returns the time from
/// the last of these samples to standstill, ms.
fn stop_ms(speed: f32, cut_ms: u64, cut: &[usize]) -> u64 {
    let (mut vehicle, mut system) = (Vehicle::new(), Driving::new());
    let mut last_ms = 0;
    loop {
        if vehicle.ms.is_multiple_of(SOC_PERIOD.as_us() / 1_000) {
            let is_cut = |index| vehicle.ms > cut_ms && cut.contains(&index);
            for (index, sample) in samples((speed, 0.1)).into_iter().enumerate() {
                if !is_cut(index) {
                    system.on_soc(vehicle.now(), sample);
                }
            }
            if vehicle.ms <= cut_ms {
                last_ms = vehicle.ms;
            }
        }
        let output = vehicle.control(&mut system);
        let stops = output.state == FunctionState::MinimalRisk;
        assert!(
            stops || output.state == FunctionState::Parking,
            "{:?}",
            output.state
        );
        if stops && vehicle.state.speed == 0.0 {
            return vehicle.ms - last_ms;
        }
        vehicle.obey(&output);
        assert!(vehicle.state.speed < f64::from(PARKING_SPEED) + 0.1);
        assert!(vehicle.ms < cut_ms + 10_000, "it does not stop");
    }
}

/// D-3: from every speed, and whenever the network is cut, the vehicle stands within the stated
/// time.
#[test]
fn a_silent_soc_ends_at_standstill_within_the_stated_time() {
    let limit = SOC_STOP_LIMIT.as_us() / 1_000;
    let mut longest = (0, 0, 0);
    for tenths in 1..=10 {
        let speed = 0.3 * tenths as f32;
        for cut_ms in (0..6_000).step_by(10) {
            let ms = stop_ms(speed, cut_ms, &[0, 1, 2, 3]);
            assert!(ms <= limit, "{speed} m/s, cut at {cut_ms} ms: {ms} ms");
            longest = longest.max((ms, tenths, cut_ms));
        }
    }
    std::println!("{longest:?}");
    assert!(
        longest.0 + 200 >= limit,
        "the limit is no guess: {longest:?}"
    );
}

/// D-3: each topic by itself ends in the stop, at its own time-out.
#[test]
fn each_silent_topic_ends_in_the_stop() {
    let ms = |time: Duration| time.as_us() / 1_000;
    for topic in 0..4 {
        let timeout = if topic == 3 {
            SOC_BRAKE_TIMEOUT
        } else {
            SOC_TIMEOUT
        };
        let ms = ms(SOC_STOP_LIMIT) + ms(timeout) - ms(SOC_TIMEOUT);
        let stopped = stop_ms(PARKING_SPEED, 3_500, &[topic]);
        assert!(
            (ms - 1_000..=ms).contains(&stopped),
            "topic {topic}: {stopped} ms"
        );
    }
}

/// T-RED-9: two systems that hear the SoC at different times, up to the time-out, do not disagree,
/// not even if the SoC turns the wheels and changes the speed all the time.
#[test]
fn a_late_sample_is_no_disagreement() {
    let flips = |ms: u64, half_ms: u64| (ms / half_ms).is_multiple_of(2);
    for (late_ms, (turns_ms, speeds_ms)) in [20, 100, SOC_TIMEOUT.as_us() / 1_000]
        .into_iter()
        .flat_map(|late_ms| [(900, 700), (1_700, 2_500), (4_300, 9_000)].map(|it| (late_ms, it)))
    {
        let asked = |ms| {
            let speed = if flips(ms, speeds_ms) { 3.0 } else { 1.0 };
            (speed, if flips(ms, turns_ms) { 0.6 } else { -0.6 })
        };
        let (mut vehicle, mut agreement) = (Vehicle::new(), Agreement::new());
        let (mut master, mut standby) = (Driving::new(), Driving::new());
        let (mut fastest, mut worst) = (0.0_f32, 0);
        while vehicle.ms < 40_000 {
            if vehicle.ms.is_multiple_of(20) {
                let hear = |system: &mut Driving, ms| {
                    let now = vehicle.now();
                    samples(asked(ms)).map(|sample| system.on_soc(now, sample))
                };
                hear(&mut master, vehicle.ms);
                hear(&mut standby, vehicle.ms.saturating_sub(late_ms));
            }
            let (obeyed, theirs) = (vehicle.control(&mut master), vehicle.control(&mut standby));
            let parks = [obeyed.state, theirs.state];
            assert_eq!(parks, [FunctionState::Parking; 2], "{}", vehicle.ms);
            let apart = Deviation::of(&obeyed.command, &theirs.standalone, obeyed.speed);
            let change = agreement.cycle(vehicle.now(), Phase::Standby, Some(apart));
            worst = worst.max(change.map_or(0, |(_, percent)| percent));
            fastest = fastest.max(obeyed.speed);
            standby.on_obeyed(obeyed.command);
            vehicle.obey(&obeyed);
        }
        std::println!("{late_ms} ms, {turns_ms} ms, {speeds_ms} ms: {worst} % of the limit");
        assert!(fastest > 1.5);
        assert_eq!(agreement.stage(), Stage::Agreed);
        assert!(worst < 50, "{late_ms} ms: {worst} %");
    }
}
