//! An SoC parks the vehicle: approach, standstill, brake, and what ends it before. D-3

use std::cell::RefCell;
use std::collections::VecDeque;
use std::rc::Rc;
use tandem_board::{Board, CoreId, Duration, SystemId};
use tandem_bus::{GearCode, ModeCode, ParkingBrakeCode};
use tandem_cores::Core;
use tandem_cores::core0::Core0;
use tandem_cores::driving::parking::{
    PARKING_SPEED, SOC_BRAKE_PERIOD, SOC_PERIOD, SOC_STOP_LIMIT, SocSample,
};
use tandem_cores::trace::Event;
use tandem_sim::drive::{Drive, poller};
use tandem_topics::{
    BrakeRequest, Gear, LateralControl, LongitudinalControl, ParkingBrake, PowerControl,
};
use tandem_vehicle::{Habit, WorldSnapshot};

use crate::print_story;

/// Way from the start to the place where the vehicle is parked, m.
const WAY_M: f64 = 12.0;
/// Time until both systems drive and the driver has asked.
const START_MS: u64 = 2_500;

type Inbox = Rc<RefCell<Vec<SocSample>>>;

/// The network from the SoC to one system.
#[derive(Clone, Copy)]
struct Link {
    delay_ms: u64,
    /// Of 100 samples this many are lost.
    loses: u64,
}

/// Both systems, a vehicle, and an SoC that both systems hear.
struct Parked {
    drive: Drive,
    ms: u64,
    inboxes: [Inbox; 2],
    on_the_way: [VecDeque<(u64, SocSample)>; 2],
    links: [Link; 2],
    noise: u64,
}

impl Parked {
    fn new(links: [Link; 2], habit: Habit) -> Self {
        let config = tandem_cores::Config::rt();
        let inboxes = [Inbox::default(), Inbox::default()];
        let of = inboxes.clone();
        let drive = Drive::with("parking", 3, move |board| {
            if board.identity().core != CoreId::CONTROL {
                return poller(board, config);
            }
            let inbox = Rc::clone(&of[board.identity().system.index()]);
            let board: &'static _ = Box::leak(Box::new(board.clone()));
            let mut core = Core0::new(board, config);
            Box::new(move |_| {
                for sample in inbox.borrow_mut().drain(..) {
                    core.on_soc(board.now(), sample);
                }
                core.poll()
            })
        });
        drive.seen.borrow_mut().world.set_driver(habit);
        Self {
            drive,
            ms: 0,
            inboxes,
            on_the_way: Default::default(),
            links,
            noise: 1,
        }
    }

    /// Runs for `ms`, in which the SoC sends what `soc` returns for the vehicle.
    fn run(&mut self, ms: u64, soc: &mut dyn FnMut(&WorldSnapshot) -> [SocSample; 4]) {
        for _ in 0..ms {
            self.drive.run_for(Duration::from_ms(1));
            self.ms += 1;
            let ms = |period: Duration| period.as_us() / 1_000;
            if self.ms.is_multiple_of(ms(SOC_PERIOD)) {
                let [power, lateral, longitudinal, brake] = soc(&self.now());
                self.send(&[power, lateral, longitudinal]);
                if self.ms.is_multiple_of(ms(SOC_BRAKE_PERIOD)) {
                    self.send(&[brake]);
                }
            }
            for (way, inbox) in self.on_the_way.iter_mut().zip(&self.inboxes) {
                while way.front().is_some_and(|(due, _)| *due <= self.ms) {
                    inbox
                        .borrow_mut()
                        .extend(way.pop_front().map(|(_, sample)| sample));
                }
            }
        }
    }

    fn send(&mut self, samples: &[SocSample]) {
        for (way, link) in self.on_the_way.iter_mut().zip(self.links) {
            for sample in samples {
                self.noise = self
                    .noise
                    .wrapping_mul(6_364_136_223_846_793_005)
                    .wrapping_add(1);
                if (self.noise >> 33) % 100 >= link.loses {
                    way.push_back((self.ms + link.delay_ms, *sample));
                }
            }
        }
    }

    fn silent(&mut self, ms: u64) {
        for _ in 0..ms {
            self.drive.run_for(Duration::from_ms(1));
            self.ms += 1;
        }
    }

    fn now(&self) -> WorldSnapshot {
        self.drive.seen.borrow().world.snapshot().clone()
    }

    fn modes(&self) -> Vec<ModeCode> {
        let mut modes: Vec<_> = self
            .drive
            .seen
            .borrow()
            .log
            .accepted()
            .map(|it| it.mode)
            .collect();
        modes.dedup();
        modes
    }

    /// Returns the events that say that a system found something wrong.
    fn alarms(&self) -> Vec<Event> {
        let alarms = self.drive.events.iter().map(|(.., event)| *event);
        let is_alarm = |event: &Event| {
            matches!(
                event,
                Event::Agreement { stage: 1.., .. }
                    | Event::WrongCommand { .. }
                    | Event::WrongScene { .. }
                    | Event::WrongTrajectory { .. }
                    | Event::SensorLies { .. }
                    | Event::PeerScene { .. }
                    | Event::WrongEcho
                    | Event::ClockWrong { .. }
                    | Event::SocSilent { .. }
            )
        };
        alarms.filter(is_alarm).collect()
    }

    /// The largest share of the limit by which the commands of both systems differed, %.
    fn worst_agreement(&self) -> u8 {
        let used = self
            .drive
            .events
            .iter()
            .filter_map(|(.., event)| match event {
                Event::Agreement { percent, .. } => Some(*percent),
                _ => None,
            });
        used.max().unwrap_or(0)
    }

    fn refused(&self) -> u64 {
        let counts = self.drive.seen.borrow().world.gate().counts();
        counts.implausible + counts.stale + counts.invalid + counts.unexplained
    }
}

const PARKS: Habit = Habit {
    overrides_s: None,
    answers_after_s: None,
    parks_from_s: Some(0.0),
};
const NEAR: [Link; 2] = [
    Link {
        delay_ms: 1,
        loses: 0,
    },
    Link {
        delay_ms: 3,
        loses: 0,
    },
];
const FAR: [Link; 2] = [
    Link {
        delay_ms: 2,
        loses: 5,
    },
    Link {
        delay_ms: 45,
        loses: 10,
    },
];

fn asks(speed: f32, left: f32, angle: f32, parks: bool) -> [SocSample; 4] {
    let (target_gear, request) = match parks {
        true => (Gear::Park, BrakeRequest::Apply),
        false => (Gear::Drive, BrakeRequest::Release),
    };
    [
        SocSample::Power(PowerControl {
            target_speed: speed,
            acceleration: 0.8,
            distance: left,
            target_gear,
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
            request,
            ..ParkingBrake::default()
        }),
    ]
}

/// An SoC that drives [`WAY_M`] forward in the lane, stops and sets the brake.
fn approach(speed: f32) -> impl FnMut(&WorldSnapshot) -> [SocSample; 4] {
    let mut start = None;
    move |now| {
        let begin = *start.get_or_insert(now.station);
        let left = (begin + WAY_M - now.station).max(0.0);
        let angle = -0.1 * now.lateral_offset - 0.5 * now.pose.yaw;
        asks(
            speed,
            left as f32,
            angle as f32,
            left < 0.3 && now.speed == 0.0,
        )
    }
}

/// D-3: the SoC approaches forward, stops and sets the brake. The two systems hear it at different
/// times and miss samples, and no check of theirs takes this for a fault.
#[test]
fn an_soc_approaches_stops_and_sets_the_brake() {
    for (links, speed) in [(NEAR, 2.0), (FAR, 3.0), (FAR, 1.0)] {
        let mut parked = Parked::new(links, PARKS);
        parked.silent(START_MS);
        let begin = parked.now();
        assert_eq!(
            (begin.speed, begin.gear),
            (0.0, GearCode::Drive),
            "it waits"
        );
        parked.run(20_000, &mut approach(speed));
        print_story(&parked.drive);
        let now = parked.now();
        let way = now.station - begin.station;
        println!("{way:.2} m, agreement {} %", parked.worst_agreement());
        assert!((way - WAY_M).abs() < 0.3, "{way}");
        assert_eq!(now.speed, 0.0);
        assert_eq!(
            (now.gear, now.parking_brake),
            (GearCode::Park, ParkingBrakeCode::Applied)
        );
        // The work of the SoC is done.
        parked.silent(3_000);
        assert_eq!(parked.modes(), [ModeCode::L3, ModeCode::Parking]);
        assert_eq!(parked.alarms(), []);
        assert!(
            parked.worst_agreement() < 50,
            "{}",
            parked.worst_agreement()
        );
        assert_eq!(
            (parked.refused(), parked.drive.masters()),
            (0, vec![SystemId::A])
        );
        let metrics = parked.drive.seen.borrow().world.metrics();
        assert!(
            metrics.standing_s == 0.0 && metrics.lateral_error_max_m < 0.3,
            "{metrics:?}"
        );
        assert!(metrics.jerk_max.0 < 9.5, "{metrics:?}");
    }
}

/// D-3: whatever the SoC asks for, the vehicle stays slow, nothing jumps, and no check of the
/// systems takes it for a fault of theirs.
#[test]
fn a_wrong_soc_stays_within_the_limits() {
    type Of = fn(u64) -> f32;
    let swings: Of = |at| if at % 40 < 20 { 0.65 } else { -0.65 };
    let turns: Of = |at| (at as f32 * 0.02).sin() * 0.5;
    let races: Of = |at| if at % 25 < 20 { 300.0 } else { 0.0 };
    // The last one circles: it loses its lane, and is stopped because it is blind.
    let cases: [(Of, Of, &[ModeCode]); 3] = [
        (swings, races, &[]),
        (turns, |_| 3.0, &[]),
        (|_| 0.65, races, &[ModeCode::SafeStop]),
    ];
    for (angle, speed, then) in cases {
        let mut parked = Parked::new(FAR, PARKS);
        parked.silent(START_MS);
        let (mut sent, mut fastest) = (0, 0.0_f64);
        parked.run(12_000, &mut |now| {
            sent += 1;
            fastest = fastest.max(now.speed);
            let mut asked = asks(speed(sent), 6_000.0, angle(sent), sent % 50 > 45);
            for sample in &mut asked {
                match sample {
                    SocSample::Power(power) => {
                        power.acceleration = if sent % 90 < 70 { 32.0 } else { -32.0 };
                    }
                    SocSample::Longitudinal(brakes) if sent % 170 > 160 => {
                        brakes.brake_torque = 20_000.0;
                    }
                    _ => {}
                }
            }
            asked
        });
        print_story(&parked.drive);
        println!("{fastest:.2} m/s, agreement {} %", parked.worst_agreement());
        assert!(
            (1.0..f64::from(PARKING_SPEED) + 0.2).contains(&fastest),
            "{fastest}"
        );
        let expected = [&[ModeCode::L3, ModeCode::Parking], then].concat();
        assert_eq!(parked.modes(), expected);
        assert_eq!(parked.alarms(), []);
        assert_eq!(
            (parked.refused(), parked.drive.masters()),
            (0, vec![SystemId::A])
        );
        assert!(
            parked.worst_agreement() < 80,
            "{}",
            parked.worst_agreement()
        );
        let metrics = parked.drive.seen.borrow().world.metrics();
        assert!(
            metrics.jerk_max.0 < 9.5 && metrics.deceleration_max < 4.5,
            "{metrics:?}"
        );
    }
}

/// D-3: the network is cut while the vehicle approaches. It stands within the stated time, and
/// gear and brake hold it. Neither the SoC that returns nor anybody but the driver moves it again.
#[test]
fn a_silent_network_stops_the_vehicle_for_good() {
    for after_ms in [1_500, 2_710, 4_130] {
        let mut parked = Parked::new(FAR, PARKS);
        parked.silent(START_MS);
        let mut soc = approach(PARKING_SPEED);
        parked.run(after_ms, &mut soc);
        let (cut_ms, speed) = (parked.ms, parked.now().speed);
        assert!(speed > 0.5, "{speed}");
        while parked.now().speed > 0.0 {
            parked.silent(1);
        }
        // Samples are on the way for a while.
        let ms = parked.ms - cut_ms - 45;
        println!("from {speed:.2} m/s: stands after {ms} ms");
        assert!(ms <= SOC_STOP_LIMIT.as_us() / 1_000, "{ms}");
        parked.silent(1_500);
        let now = parked.now();
        assert_eq!(
            (now.gear, now.parking_brake),
            (GearCode::Park, ParkingBrakeCode::Applied)
        );
        parked.run(3_000, &mut soc);
        assert_eq!(parked.now().station, now.station);
        let expected = [ModeCode::L3, ModeCode::Parking, ModeCode::SafeStop];
        assert_eq!(parked.modes(), expected);
        let only_silence = |it: &Event| matches!(it, Event::SocSilent { topic: 0..3 });
        assert!(
            parked.alarms().iter().all(only_silence),
            "{:?}",
            parked.alarms()
        );
        assert_eq!(parked.alarms().len(), 2);
    }
}

/// D-3, T-RED-4: the master is lost while the vehicle approaches. The other system goes on parking
/// from the master's last command, in its term.
#[test]
fn a_takeover_does_not_end_parking() {
    for after_ms in [1_000, 3_000, 9_000] {
        let mut parked = Parked::new(NEAR, PARKS);
        parked.silent(START_MS);
        let begin = parked.now().station;
        let mut soc = approach(2.0);
        parked.run(after_ms, &mut soc);
        parked.drive.pair.power_off(SystemId::A);
        parked.run(16_000 - after_ms, &mut soc);
        print_story(&parked.drive);
        let now = parked.now();
        assert!(
            (now.station - begin - WAY_M).abs() < 0.3,
            "{}",
            now.station - begin
        );
        assert_eq!(
            (now.gear, now.parking_brake),
            (GearCode::Park, ParkingBrakeCode::Applied)
        );
        assert_eq!(parked.modes(), [ModeCode::L3, ModeCode::Parking]);
        assert_eq!(parked.drive.masters(), [SystemId::A, SystemId::B]);
        assert!(parked.drive.gap_max() < Duration::from_ms(20));
        assert_eq!(parked.refused(), 0);
        assert!(parked.drive.seen.borrow().world.metrics().jerk_max.0 < 9.5);
    }
}

/// D-3, T-RED-4: a system that was reset while the other parked joins and goes on parking when
/// the other is lost. If the SoC is silent by then, the vehicle stays where it stands.
#[test]
fn a_system_that_joins_parks_too() {
    for is_cut in [false, true] {
        let mut parked = Parked::new(NEAR, PARKS);
        parked.silent(START_MS);
        let begin = parked.now().station;
        let mut soc = approach(1.0);
        parked.run(3_000, &mut soc);
        parked.drive.pair.kill_core(SystemId::B, CoreId::CONTROL);
        parked.run(500, &mut soc);
        let mut after = |parked: &mut Parked, ms| match is_cut {
            true => parked.silent(ms),
            false => parked.run(ms, &mut soc),
        };
        after(&mut parked, 4_000);
        let stood = parked.now();
        parked.drive.pair.power_off(SystemId::A);
        after(&mut parked, 14_000);
        print_story(&parked.drive);
        let now = parked.now();
        assert_eq!(parked.drive.masters(), [SystemId::A, SystemId::B]);
        assert_eq!(
            (now.gear, now.parking_brake),
            (GearCode::Park, ParkingBrakeCode::Applied)
        );
        if is_cut {
            assert_eq!(stood.speed, 0.0);
            assert_eq!(now.station, stood.station);
        } else {
            assert!(stood.speed > 0.5);
            assert!((now.station - begin - WAY_M).abs() < 0.3);
            assert_eq!(parked.modes(), [ModeCode::L3, ModeCode::Parking]);
        }
    }
}

/// D-3: the driver takes the vehicle from the SoC at once, and it drives on: the brake is released.
#[test]
fn the_driver_takes_the_vehicle_from_the_soc() {
    let mut parked = Parked::new(
        NEAR,
        Habit {
            overrides_s: Some((18.0, 60.0)),
            ..PARKS
        },
    );
    parked.silent(START_MS);
    let mut soc = approach(2.0);
    parked.run(15_000, &mut soc);
    assert_eq!(parked.now().gear, GearCode::Park);
    parked.run(8_000, &mut soc);
    let now = parked.now();
    assert_eq!(
        (now.gear, now.parking_brake),
        (GearCode::Drive, ParkingBrakeCode::Released)
    );
    assert!(now.speed > 3.0, "{}", now.speed);
    let expected = [ModeCode::L3, ModeCode::Parking, ModeCode::None];
    assert_eq!(parked.modes(), expected);
}

/// D-3: without a request of the driver the SoC's command does nothing, and a vehicle that is fast
/// first slows down.
#[test]
fn the_soc_commands_only_a_slow_vehicle_of_a_driver_who_asks() {
    let mut parked = Parked::new(NEAR, Habit::default());
    parked.run(9_000, &mut |_| asks(0.0, 0.0, 0.5, true));
    assert_eq!(parked.modes(), [ModeCode::L3]);
    assert!(parked.now().speed > 5.0);
    let mut parked = Parked::new(
        NEAR,
        Habit {
            parks_from_s: Some(8.0),
            ..PARKS
        },
    );
    let mut begins = None;
    parked.run(14_000, &mut |now| {
        if now.accepted.is_some() && now.time_s > 8.0 && now.speed <= 3.0 && begins.is_none() {
            begins = Some(now.time_s);
        }
        asks(1.0, 100.0, 0.0, false)
    });
    assert!(begins.is_some_and(|at_s| at_s > 8.5), "{begins:?}");
    assert_eq!(parked.modes(), [ModeCode::L3, ModeCode::Parking]);
    assert!((parked.now().speed - 1.0).abs() < 0.1);
    assert_eq!((parked.alarms(), parked.refused()), (vec![], 0));
}

/// T-RED-9: while both systems park they are compared. If they hear two different SoCs, neither
/// finds a fault in itself, and the vehicle is stopped.
#[test]
fn two_systems_that_hear_different_commands_stop() {
    let mut parked = Parked::new(NEAR, PARKS);
    parked.silent(START_MS);
    let mut straight = |_: &WorldSnapshot| asks(3.0, 100.0, 0.0, false);
    parked.run(6_000, &mut straight);
    assert!(parked.now().speed > 2.8);
    let to_b = Rc::clone(&parked.inboxes[1]);
    // Its own samples reach B never again, these do.
    parked.links[1].loses = 100;
    parked.run(4_000, &mut move |_| {
        to_b.borrow_mut().extend(asks(3.0, 100.0, 0.6, false));
        asks(3.0, 100.0, 0.0, false)
    });
    let stages = parked.alarms();
    assert!(
        stages.contains(&Event::Agreement {
            stage: 2,
            percent: 100
        }),
        "{stages:?}"
    );
    assert_eq!(
        parked.modes(),
        [ModeCode::L3, ModeCode::Parking, ModeCode::SafeStop]
    );
    assert_eq!(parked.now().speed, 0.0);
}
