//! Sensors with clocks and delays of their own, and perception with and without global time.
//!
//! The ego stands. Every 3 s a vehicle crosses 40 m ahead with 30 m/s. The error is where the scene
//! has it, less where it is: a delay of 20 ms shows as 0.6 m.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

use std::fmt::Write as _;

use tandem_board::{CanFrame, CanId, Carried, Duration, Instant, SystemId};
use tandem_bus::{
    Control, FrameReceiver, FrameTransmitter, Message, ModeCode, RoleCode, SensorHeader,
    TimeStateCode, TimeSync,
};
use tandem_cores::driving::perception::{GlobalClock, Perception};
use tandem_timesync::{Arbitrary, BaseConfig, CanTimeMaster, GlobalTime, TimeBase};
use tandem_vehicle::{Scenario, SensorTiming, World, WorldConfig};

const MS: u64 = 1_000_000;
/// m/s
const SPEED: f64 = 30.0;
/// Time between two vehicles, s, and how many come.
const EVERY_S: f64 = 3.0;
const VEHICLES: usize = 14;
/// The y of each vehicle when its recording begins, m; the road lies on 0.
const FIRST_Y: f64 = -60.0;
/// Errors are measured while a vehicle is this near to the road, m.
const NEAR_Y: f64 = 30.0;

/// Returns a straight road along x with the ego standing at 0, and the crossing vehicles.
fn scenario() -> Scenario {
    let mut xml = String::from(
        "<commonRoad commonRoadVersion=\"2018b\" timeStepSize=\"0.5\" benchmarkID=\"crossing\">",
    );
    let bound = |name: &str, y: f64| {
        let point = |x: f64| format!("<point><x>{x}</x><y>{y}</y></point>");
        format!("<{name}>{}{}</{name}>", point(-300.0), point(900.0))
    };
    let (left, right) = (bound("leftBound", 1.75), bound("rightBound", -1.75));
    write!(xml, "<lanelet id=\"1\">{left}{right}</lanelet>").unwrap();
    for vehicle in 0..VEHICLES {
        let state = |step: usize| {
            let y = FIRST_Y + SPEED * 0.5 * step as f64;
            let time = 6 * vehicle + step;
            format!(
                "<position><point><x>40</x><y>{y}</y></point></position><orientation><exact>\
                 1.5707963</exact></orientation><time><exact>{time}</exact></time><velocity>\
                 <exact>{SPEED}</exact></velocity>"
            )
        };
        let later: String = (1..40)
            .map(|step| format!("<state>{}</state>", state(step)))
            .collect();
        write!(
            xml,
            "<obstacle id=\"{}\"><role>dynamic</role><type>car</type><shape><rectangle><length>4.5\
             </length><width>1.8</width></rectangle></shape><initialState>{}</initialState>\
             <trajectory>{later}</trajectory></obstacle>",
            vehicle + 100,
            state(0)
        )
        .unwrap();
    }
    write!(
        xml,
        "<planningProblem id=\"9\"><initialState><position><point><x>0</x><y>0</y></point>\
         </position><orientation><exact>0</exact></orientation><time><exact>0</exact></time>\
         <velocity><exact>0</exact></velocity></initialState></planningProblem></commonRoad>"
    )
    .unwrap();
    Scenario::parse(&xml, "crossing").unwrap()
}

/// The system's clock: 37 s ahead of the vehicle's, and 40 ppm too fast.
fn system(vehicle: Instant) -> Instant {
    let ns = vehicle.as_ns();
    Instant::from_ns(ns + 37_000 * MS + ns / 25_000)
}

/// A system that hears the sensors, and may be their master of time.
struct Bench {
    world: World,
    perception: Perception,
    transmitter: FrameTransmitter,
    receiver: FrameReceiver,
    base: TimeBase<Arbitrary>,
    /// `None`: the sensors get no global time.
    master: Option<CanTimeMaster>,
    /// How far the global time of the system's own use is ahead of the one that it sends, µs.
    lie_us: i32,
    now_ms: u64,
    states: Vec<TimeStateCode>,
}

/// The error of a scene at a scenario time, s: along the crossing vehicle's way, m; NaN if the
/// scene has no such object.
type Errors = Vec<(f64, f64)>;

impl Bench {
    fn new(seed: u64, timing: &[&str], gives_time: bool) -> Self {
        let mut world = World::new(&scenario(), WorldConfig { seed });
        let timing: Vec<SensorTiming> = timing.iter().map(|it| it.parse().unwrap()).collect();
        world.set_sensor_timing(&timing);
        let now = system(Instant::ORIGIN);
        let mut base = TimeBase::new(BaseConfig::CAN);
        base.set_free(now, GlobalTime::from_ns(4_294 * 1_000 * MS));
        Self {
            world,
            perception: Perception::new(),
            transmitter: FrameTransmitter::new(),
            receiver: FrameReceiver::new(),
            base,
            master: gives_time.then(|| CanTimeMaster::new(SystemId::A, true, now)),
            lie_us: 0,
            now_ms: 0,
            states: Vec::new(),
        }
    }

    /// Sends what the system sends at `at` on the vehicle's clock.
    fn send(&mut self, at: Instant) {
        if self.now_ms.is_multiple_of(10) {
            let control = Control {
                role: RoleCode::Master,
                mode: ModeCode::L3,
                term: 2,
                acceleration: -1.0,
                ..Control::default()
            };
            let message = Message::Control { system: 0, control };
            let frame = self.transmitter.encode(&message);
            let (id, now_ns) = (frame.id.into(), at.as_ns());
            assert!(self.world.on_frame(now_ns, id, frame.data()).is_some());
        }
        let conversion = self.base.conversion().unwrap();
        let Some(master) = &mut self.master else {
            return;
        };
        let time = conversion.at(system(at));
        if let Some(bytes) = master.poll(system(at), time) {
            let id = CanId::Standard(TimeSync::IDS[0]);
            let frame = CanFrame::new(id, false, &bytes).unwrap();
            // It waits for other frames of the bus.
            let waits = Duration::from_us(50 + 37 * (self.now_ms % 11));
            let (sent, at) = (at, at + waits);
            let carried = Carried { frame, sent, at };
            assert_eq!(self.world.hear(at, carried).ruling, None);
            let time = conversion.at(system(at));
            master.on_sent(system(at), time, false);
        }
    }

    /// Runs for this long. Returns the errors of the scenes.
    fn run(&mut self, ms: u64) -> Errors {
        let mut errors = Errors::new();
        for _ in 0..ms {
            let at = Instant::from_ns(self.now_ms * MS);
            self.send(at);
            let (mut heard, now) = (Vec::new(), system(at));
            self.world.step(at.as_ns(), &mut |id, data| {
                heard.push(self.receiver.receive(id.into(), data).unwrap());
            });
            let conversion = self.base.conversion().unwrap();
            let us = ((conversion.at(now).as_ns() / 1_000) as u32).wrapping_add_signed(self.lie_us);
            let global = GlobalClock::new(now, us.into(), conversion.error_at(now));
            assert!(global.is_some());
            self.perception.set_global(global);
            for message in &heard {
                if let Message::SensorHeader(_, SensorHeader { time_state, .. }) = message {
                    self.states.push(*time_state);
                }
                self.perception.on_message(now, message);
            }
            if self.now_ms % 50 == 40 {
                self.perception.cycle(now);
                errors.extend(self.errors());
            }
            self.now_ms += 1;
        }
        errors
    }

    /// Returns the errors of all vehicles that cross now.
    fn errors(&self) -> Errors {
        let time_s = self.world.snapshot().time_s;
        let y_of = |vehicle: usize| FIRST_Y + SPEED * (time_s - EVERY_S * vehicle as f64);
        let near = (0..VEHICLES).map(y_of).filter(|y| y.abs() < NEAR_Y);
        let objects = &self.perception.scene().objects;
        let errors = near.map(|y| {
            let apart = objects.iter().map(|it| f64::from(it.y) - y);
            let nearest = apart.min_by(|a, b| a.abs().total_cmp(&b.abs()));
            (
                time_s,
                nearest.filter(|it| it.abs() < 10.0).unwrap_or(f64::NAN),
            )
        });
        errors.collect()
    }
}

/// Mean and largest absolute error, m, and how many scenes lack the vehicle.
fn figures(errors: &Errors) -> (f64, f64, usize) {
    let found: Vec<f64> = errors
        .iter()
        .map(|it| it.1)
        .filter(|it| !it.is_nan())
        .collect();
    let mean = found.iter().sum::<f64>() / found.len() as f64;
    let most = found.iter().map(|it| it.abs()).fold(0.0, f64::max);
    (mean, most, errors.len() - found.len())
}

/// S-4, S-5: a constant delay of the sensors cannot be learned from arrivals; global stamps show
/// it.
#[test]
fn a_constant_delay_shows_with_global_stamps_only() {
    let clocks = ["all:offset:7300ms", "all:rate:-60ppm"];
    for (delay, gives_time) in [(0, false), (0, true), (20, false), (20, true)] {
        let delay_text = format!("all:delay:{delay}ms");
        let timing = [&clocks[..], &[delay_text.as_str()]].concat();
        let mut errors = Errors::new();
        for seed in 1..=3 {
            let mut bench = Bench::new(seed, &timing, gives_time);
            errors.extend(bench.run(40_000).into_iter().filter(|it| it.0 > 3.0));
        }
        let (mean, most, lacking) = figures(&errors);
        println!(
            "delay {delay} ms, global time {gives_time}: mean {mean:.3} m, most {most:.3} m, \
             lacking {lacking} of {}",
            errors.len()
        );
        match (delay, gives_time) {
            (20, false) => assert!(mean < -0.5, "{mean} m"),
            _ => assert!(mean.abs() <= 0.1, "{mean} m"),
        }
    }
}

/// S-5: whatever the sensors' clocks do, with and without global time: the error stays bounded,
/// and is as small as before 1 s after a leap, when a vehicle is at y = 0. A global time that
/// differs from what was sent to the sensors is believed after 10 s, so the run ends before.
#[test]
fn wrong_clocks_of_sensors_cost_a_bounded_error() {
    let different = [
        "radar-front:offset:5ms",
        "radar-front-left:offset:70000ms",
        "radar-front-right:rate:100ppm",
        "camera-front:rate:-100ppm",
    ];
    let cases: [(&str, &[&str], i32); 12] = [
        ("clocks differ", &different, 0),
        ("all +100 ppm", &["all:rate:100ppm"], 0),
        ("all -100 ppm", &["all:rate:-100ppm"], 0),
        ("all drift 2 ppm/s", &["all:drift:2ppm/s"], 0),
        ("radar +50 ms", &["radar-front:jump:50ms@17s"], 0),
        ("radar -50 ms", &["radar-front:jump:-50ms@17s"], 0),
        ("all +50 ms", &["all:jump:50ms@17s"], 0),
        ("all -50 ms", &["all:jump:-50ms@17s"], 0),
        ("all +1 s", &["all:jump:1000ms@17s"], 0),
        ("all -1 s", &["all:jump:-1000ms@17s"], 0),
        ("system +50 ms", &[], 50_000),
        ("system -50 ms", &[], -50_000),
    ];
    for (name, timing, lie_us) in cases {
        for gives_time in [false, true] {
            let timing = [&["all:delay:5ms", "all:jitter:3ms"], timing].concat();
            let mut bench = Bench::new(1, &timing, gives_time);
            let mut errors = bench.run(17_000);
            bench.lie_us = lie_us;
            errors.extend(bench.run(9_500));
            let within = |from, to| -> Errors {
                let within = errors.iter().filter(|it| (from..to).contains(&it.0));
                within.copied().collect()
            };
            let spans = [(3.0, 17.0), (17.0, 18.0), (18.0, 27.0)];
            let [before, leap, after] = spans.map(|(from, to)| figures(&within(from, to)));
            println!(
                "{name}, global time {gives_time}: before mean {:.3} most {:.3} m, leap most {:.3} \
                 m, after mean {:.3} most {:.3} m, lacking {} {} {}",
                before.0, before.1, leap.1, after.0, after.1, before.2, leap.2, after.2
            );
            assert_eq!(
                (before.2, leap.2, after.2),
                (0, 0, 0),
                "{name} {gives_time}"
            );
            // Without global time the delay of 5 ms shows as 0.15 m.
            let expected = if gives_time { 0.0 } else { -0.15 };
            for (mean, most, _) in [before, after] {
                assert!(
                    (mean - expected).abs() < 0.1,
                    "{name} {gives_time}: {mean} m"
                );
                assert!(most < 0.6, "{name} {gives_time}: {most} m");
            }
            // 50 ms at 30 m/s.
            assert!(leap.1 < 1.5 + 0.6, "{name} {gives_time}: {} m", leap.1);
            let is_synchronised = bench.states[200..].contains(&TimeStateCode::Global);
            assert_eq!(is_synchronised, gives_time);
        }
    }
}
