//! The SoC's side: the parking application in virtual time, its commands, and both over UDP.
#![allow(clippy::unwrap_used)]

mod stand_in;

use stand_in::{CYCLE_S, PointMass, StandIn, own_place};
use std::time::Duration;
use tandem_board::Instant;
use tandem_bus::e2e::Check;
use tandem_bus::{Control, DriverRequest, GearCode, Message, ModeCode, ParkingBrakeCode};
use tandem_qos_profiles::{Profiles, SOC};
use tandem_topics::endpoints::SocTopic;
use tandem_topics::{BrakeRequest, Gear, ParkingBrake, PowerControl, TopicType};
use tandem_topics_host::approach::{Approach, ApproachPhase, GiveUp, Orders, SPEED};
use tandem_topics_host::soc::{Commander, Soc};

const CYCLE_MS: u64 = 10;

/// The application and a point mass, in virtual time.
struct Drive {
    approach: Approach,
    vehicle: PointMass,
    now_ms: u64,
    fastest: f32,
    seed: u32,
}

impl Drive {
    fn begin(way: f32) -> Self {
        Self {
            approach: Approach::new(way),
            vehicle: PointMass::default(),
            now_ms: 0,
            fastest: 0.0,
            seed: 1,
        }
    }

    /// Noise of the wheel sensors, with a deviation of 0.03 m/s: the sum of four uniform numbers.
    fn noise(&mut self) -> f32 {
        let mut sum = -2.0;
        for _ in 0..4 {
            self.seed = self
                .seed
                .wrapping_mul(1_664_525)
                .wrapping_add(1_013_904_223);
            sum += (self.seed >> 8) as f32 / (1 << 24) as f32;
        }
        sum * 0.03 / 0.577
    }

    fn now(&self) -> Instant {
        Instant::from_ns(self.now_ms * 1_000_000)
    }

    fn tell(&mut self, message: &Message) {
        let now = self.now();
        self.approach.on_message(now, message);
    }

    fn mode(&mut self, mode: ModeCode) {
        let control = Control {
            mode,
            ..Control::default()
        };
        self.tell(&Message::Control { system: 1, control });
    }

    /// A cycle: the vehicle obeys if the function parks. `hears`: the application hears it.
    fn cycle(&mut self, hears: bool) -> Orders {
        self.now_ms += CYCLE_MS;
        let orders = self.approach.orders(self.now());
        let parks = self.approach.phase() != ApproachPhase::Waiting;
        self.vehicle.step(parks.then_some(&orders));
        self.fastest = self.fastest.max(self.vehicle.speed);
        if hears {
            let mut motion = self.vehicle.motion();
            if motion.speed > 0.05 {
                motion.speed += self.noise();
            }
            self.tell(&Message::EgoMotion(motion));
        }
        orders
    }

    fn cycles(&mut self, seconds: f32) {
        for _ in 0..(seconds / CYCLE_S) as u32 {
            self.cycle(true);
        }
    }

    /// Drives for a while, in the state Parking.
    fn under_way(way: f32) -> Self {
        let mut drive = Self::begin(way);
        drive.cycles(0.1);
        drive.mode(ModeCode::Parking);
        drive.cycles(2.0);
        assert_eq!(drive.approach.phase(), ApproachPhase::Approaching);
        assert!(drive.vehicle.speed > 0.8);
        drive
    }
}

/// D-3: it drives over the way that was asked for, never faster than 2 m/s, and parks.
#[test]
fn it_parks_at_the_end_of_the_way() {
    for way in [0.0, 0.5, 3.0, 12.0, 50.0] {
        let mut drive = Drive::begin(way);
        drive.cycles(1.0);
        assert_eq!(drive.approach.phase(), ApproachPhase::Waiting);
        assert_eq!(drive.approach.driven(), 0.0, "before the function parks");
        drive.mode(ModeCode::Parking);
        drive.cycles(60.0);
        assert_eq!(drive.approach.phase(), ApproachPhase::Parked, "{way}");
        let vehicle = drive.vehicle;
        assert!((vehicle.driven - way).abs() < 0.06, "{way}: {vehicle:?}");
        assert!(drive.fastest <= SPEED + 0.01, "{way}: {}", drive.fastest);
        assert_eq!(vehicle.gear, GearCode::Park);
        assert_eq!(vehicle.brake, ParkingBrakeCode::Applied);
        // The function ends its state: that is no reason to give up.
        drive.mode(ModeCode::None);
        assert_eq!(drive.approach.phase(), ApproachPhase::Parked);
    }
}

/// D-3: a parking brake that holds is released before it drives.
#[test]
fn it_releases_the_parking_brake() {
    let mut drive = Drive::begin(1.0);
    drive.vehicle.brake = ParkingBrakeCode::Applied;
    drive.cycle(true);
    drive.mode(ModeCode::Parking);
    assert_eq!(drive.cycle(true).brake.request, BrakeRequest::Release);
    drive.cycles(10.0);
    assert_eq!(drive.approach.phase(), ApproachPhase::Parked);
}

/// D-3: without the vehicle's motion it stops; if that lasts, it gives up.
#[test]
fn it_stops_while_it_is_blind() {
    let mut drive = Drive::under_way(12.0);
    for _ in 0..180 {
        drive.cycle(false);
    }
    let orders = drive.cycle(false);
    assert_eq!(orders.power.target_speed, 0.0);
    assert!(orders.longitudinal.enable && orders.longitudinal.brake_torque > 0.0);
    assert_eq!(drive.vehicle.speed, 0.0);
    drive.cycles(0.5);
    assert_eq!(drive.approach.phase(), ApproachPhase::Approaching);
    for _ in 0..201 {
        drive.cycle(false);
    }
    let given_up = ApproachPhase::GivenUp(GiveUp::Blind);
    assert_eq!(drive.approach.phase(), given_up);
    assert_eq!(drive.cycle(true), Orders::default());
}

/// D-3: the driver and the function end it, while it moves the vehicle.
#[test]
fn driver_and_function_end_it() {
    let mut drive = Drive::under_way(12.0);
    let request = DriverRequest {
        overrides: true,
        ..DriverRequest::default()
    };
    drive.tell(&Message::DriverRequest(request));
    let given_up = ApproachPhase::GivenUp(GiveUp::Overridden);
    assert_eq!(drive.approach.phase(), given_up);
    assert_eq!(drive.cycle(true), Orders::default());

    let mut drive = Drive::under_way(12.0);
    drive.mode(ModeCode::SafeStop);
    let given_up = ApproachPhase::GivenUp(GiveUp::Stopped);
    assert_eq!(drive.approach.phase(), given_up);
    assert!(!drive.cycle(true).longitudinal.enable);
}

/// D-3: each topic has its period, counter and CRC; after a stall there is no burst.
#[test]
fn commands_have_period_and_protection() {
    let mut commander = Commander::default();
    let orders = Orders::default();
    let mut checker = PowerControl::checker();
    let mut counts = [0; 4];
    let times = (0..1_000).chain([5_000, 5_001, 5_002]);
    for now_ms in times {
        let now = Instant::from_ns(now_ms * 1_000_000 + now_ms % 7 * 100_000);
        for topic in SocTopic::ALL {
            let Some(payload) = commander.due(now, topic, &orders).unwrap() else {
                continue;
            };
            counts[topic as usize] += 1;
            match topic {
                SocTopic::Power => {
                    let check = PowerControl::decode(&payload).unwrap().check(&mut checker);
                    assert!(matches!(check, Check::Initial | Check::Ok), "{check:?}");
                }
                SocTopic::ParkingBrake => {
                    let sample = ParkingBrake::decode(&payload).unwrap();
                    assert_eq!(i32::from(sample.counter), counts[3] - 1);
                }
                SocTopic::Lateral | SocTopic::Longitudinal => {}
            }
        }
    }
    assert_eq!(counts, [51, 51, 51, 11]);
}

/// An order out of range is an error, and takes no counter.
#[test]
fn an_order_out_of_range_is_refused() {
    let mut commander = Commander::default();
    let mut orders = Orders::default();
    orders.power.distance = -1.0;
    let due = |commander: &mut Commander, orders: &Orders| {
        commander.due(Instant::ORIGIN, SocTopic::Power, orders)
    };
    assert!(due(&mut commander, &orders).is_err());
    orders.power.distance = 1.0;
    let payload = due(&mut commander, &orders).unwrap().unwrap();
    assert_eq!(PowerControl::decode(&payload).unwrap().counter, 0);
}

/// D-2, D-3: over UDP, and although system A dies half-way: the SoC hears on, both systems had its
/// commands, and the vehicle is parked.
#[test]
fn it_parks_over_udp_although_a_system_dies() {
    let own = own_place();
    let place = own.place;
    let profiles = Profiles::load(SOC, "soc.xml").unwrap();
    let soc = Soc::open(place, (&profiles, "Tandem::Soc"), Approach::new(2.0));
    let mut soc = soc.unwrap();
    let (done, parked) = std::sync::mpsc::channel();
    let thread = std::thread::spawn(move || {
        loop {
            soc.turn(Duration::from_millis(2)).unwrap();
            let phase = soc.approach().phase();
            if matches!(phase, ApproachPhase::Parked | ApproachPhase::GivenUp(_)) {
                let _sent = done.send(());
                return soc;
            }
        }
    });
    let mut stand_in = StandIn::open(place);
    let mut orders = [None; 2];
    while parked.try_recv().is_err() {
        stand_in.cycle();
        if stand_in.vehicle.driven > 1.0 && stand_in.nodes[0].is_some() {
            orders = stand_in.orders;
            stand_in.nodes[0] = None;
        }
    }
    let soc = thread.join().unwrap();
    assert_eq!(soc.approach().phase(), ApproachPhase::Parked);
    assert!(stand_in.nodes[0].is_none(), "A has died");
    for orders in orders {
        let orders = orders.unwrap();
        assert_eq!(orders.power.target_gear, Gear::Drive);
        assert!(orders.lateral.enable && orders.longitudinal.enable);
    }
    let reports: Vec<_> = soc.gateway().reports().collect();
    let motion = reports.iter().find(|(id, _)| *id == 0x110).unwrap().1;
    let [a, b] = motion.samples;
    assert!(a > 0 && b > a && motion.frames < a + b, "{motion:?}");
    let of_a = reports.iter().find(|(id, _)| *id == 0x0A0).unwrap().1;
    assert_eq!(of_a.samples[0], 0, "a system does not hear its own frames");
}
