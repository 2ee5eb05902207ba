//! The controller's firmware on a DDS domain: its topics reach Tandem and Cyclone DDS, and an SoC
//! parks it. Needs QEMU and the images, so only `cargo xtask firmware test` runs it.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::print_stdout,
    reason = "all of it is a test"
)]

use std::io::{BufRead as _, BufReader};
use std::net::Ipv4Addr;
use std::path::PathBuf;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::Duration;

use tandem_board::{HardwareFault, Instant, SystemId, VehiclePort as _};
use tandem_board_qemu::{EmulatedWorld, MachineOptions, WorldLayout};
use tandem_board_udp::UdpPlace;
use tandem_bus::{GearCode, ParkingBrakeCode};
use tandem_cores::driving::parking::SOC_STOP_LIMIT;
use tandem_cores::task_table::TaskCode;
use tandem_cores::trace::Event;
use tandem_qos_profiles::{Profiles, SOC};
use tandem_topics::endpoints::OUTPUTS;
use tandem_topics::{CanFrame, EntityId, Guid, GuidPrefix, TopicType as _};
use tandem_topics_host::approach::{Approach, ApproachPhase};
use tandem_topics_host::gateway::Gateway;
use tandem_topics_host::node::Node;
use tandem_topics_host::soc::Soc;
use tandem_vehicle::{Habit, Scenario, World, WorldConfig};

const LAYOUTS: [WorldLayout; 2] = [WorldLayout::One, WorldLayout::Two];
/// Virtual time of a drive whose frames are heard, ms.
const DRIVE_MS: u64 = 5_000;
/// A reader that was there before has joined both systems by this time, ms.
const JOINED_MS: u64 = 1_500;
/// A reader has joined a system after this many of its frames.
const JOINED_FRAMES: usize = 500;
/// Way to the place where the vehicle is parked, m.
const WAY_M: f32 = 12.0;

/// Both emulated systems on a domain, and their vehicle.
struct Drive {
    systems: EmulatedWorld,
    vehicle: World,
    /// Frames on the bus so far.
    on_bus: u64,
    events: Vec<(SystemId, Event)>,
}

impl Drive {
    fn start(scenario: &str, layout: WorldLayout, place: UdpPlace) -> Self {
        let images = std::env::var_os("TANDEM_IMAGES").expect("cargo xtask firmware test sets it");
        let image = PathBuf::from(images).join("controller");
        let mut systems = EmulatedWorld::start(&image, layout, MachineOptions::default()).unwrap();
        systems.connect_network(place).unwrap();
        systems.step().unwrap();
        systems.set_ignition(true);
        let scenario = Scenario::load(scenario).unwrap();
        Self {
            systems,
            vehicle: World::new(&scenario, WorldConfig { seed: 1 }),
            on_bus: 0,
            events: vec![],
        }
    }

    /// Runs for a millisecond of virtual time.
    fn step(&mut self) -> Instant {
        let due = self.systems.step().unwrap();
        let on_bus = &mut self.on_bus;
        self.vehicle
            .run_period(due, &mut self.systems, &mut |_| *on_bus += 1);
        let events = &mut self.events;
        let lost = self.systems.drain_trace(&mut |traced| {
            events.extend(Event::decode(traced.record).map(|event| (traced.system, event)));
        });
        assert_eq!(lost, 0, "the trace has gaps");
        due
    }
}

/// Returns a place that only one test uses.
fn place(domain: u16, layout: WorldLayout) -> UdpPlace {
    let station = if layout == WorldLayout::One { 3 } else { 4 };
    UdpPlace::new(domain, Ipv4Addr::new(127, 77, 3, station)).unwrap()
}

/// Returns how many frames were given, after checking that none is missing between them.
fn all_frames(gateway: &Gateway) -> u64 {
    for (id, report) in gateway.reports() {
        let flaws = (report.lost, report.jumps, report.damaged);
        assert_eq!(flaws, (0, 0, 0), "{id:#05x}: {report:?}");
    }
    gateway.reports().map(|(_, report)| report.frames).sum()
}

/// D-1, D-2: each frame of the bus reaches a reader outside from both systems, from when it has
/// joined.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn frames_of_both_systems_reach_a_participant_of_tandem() {
    for layout in LAYOUTS {
        let place = place(225, layout);
        let mut node = Node::open(place, &[], &OUTPUTS).unwrap();
        let mut gateway = Gateway::default();
        let mut drive = Drive::start("free-lane", layout, place);
        let mut joined = None;
        for ms in 0..DRIVE_MS {
            let now = drive.step();
            node.tell_time(now);
            while node.turn(Duration::ZERO).unwrap() {
                while let Some(sample) = node.take(0) {
                    let frame = CanFrame::decode(sample.payload()).unwrap();
                    gateway.hear(now, sample.writer, &frame);
                }
            }
            if ms == JOINED_MS {
                // What it missed while it joined was told to it.
                let lost = node.participant.reader_counts(0).lost;
                joined = Some((lost, drive.on_bus));
                gateway = Gateway::default();
            }
        }
        let (lost, on_bus) = joined.unwrap();
        let counts = node.participant.reader_counts(0);
        assert_eq!((counts.lost, counts.replaced), (lost, 0));
        let (given, on_bus) = (all_frames(&gateway), drive.on_bus - on_bus);
        println!("{layout:?}: {given} frames of {on_bus} on the bus");
        // At both ends some are on their way.
        assert!(
            given > 1_500 && given.abs_diff(on_bus) < 20,
            "{given} of {on_bus}"
        );
        for (id, report) in gateway.reports() {
            let [a, b] = report.samples;
            // A system does not hear itself.
            let is_own = a == 0 || b == 0;
            assert!(is_own || a.abs_diff(b) < 5, "{id:#05x}: {a} {b}");
        }
        drive.systems.end().unwrap();
    }
}

/// Cyclone DDS in a process, which prints what it reads until its input ends.
struct Cyclone {
    process: Child,
    ends: Option<ChildStdin>,
    says: BufReader<ChildStdout>,
}

impl Cyclone {
    const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/topics/cyclone.py");

    /// Returns `None` if this machine lacks it, and the test does not demand it.
    fn start(place: UdpPlace) -> Option<Self> {
        let python = std::env::var_os("TANDEM_PYTHON").unwrap_or_else(|| "python3".into());
        let imports = Command::new(&python)
            .args(["-c", "import cyclonedds"])
            .output();
        if !imports.is_ok_and(|output| output.status.success()) {
            let required =
                std::env::var_os("TANDEM_REQUIRE_CYCLONEDDS").is_some_and(|it| it == "1");
            assert!(!required, "no Python with cyclonedds");
            println!("SKIPPED: no Python with cyclonedds (TANDEM_PYTHON names another one)");
            return None;
        }
        let mut process = Command::new(&python)
            .args([Self::SCRIPT, &place.domain().to_string()])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let ends = process.stdin.take();
        let mut says = BufReader::new(process.stdout.take().unwrap());
        let mut line = String::new();
        says.read_line(&mut line).unwrap();
        assert_eq!(line, "ready\n");
        Some(Self {
            process,
            ends,
            says,
        })
    }

    /// Returns what it has read: the number of the writer, and the frame.
    fn end(mut self) -> Vec<(u8, CanFrame)> {
        self.ends = None;
        let read = (&mut self.says).lines().map(|line| {
            let line = line.unwrap();
            let mut words = line.split(' ');
            let mut number = || words.next().unwrap().parse::<u32>().unwrap();
            let [writer, id, period_ms, length] = [(); 4].map(|()| number());
            let text = words.next().unwrap_or_default();
            let mut data = [0; 64];
            for (byte, index) in data.iter_mut().zip((0..text.len()).step_by(2)) {
                *byte = u8::from_str_radix(&text[index..index + 2], 16).unwrap();
            }
            let frame = CanFrame {
                id,
                period_ms: period_ms as u16,
                length: length as u8,
                data,
            };
            (writer as u8, frame)
        });
        let read = read.collect();
        assert!(self.process.wait().unwrap().success());
        read
    }
}

/// D-1, D-2: Cyclone DDS subscribes to both emulated systems, and no frame is lost.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn frames_of_both_systems_reach_cyclone() {
    for layout in LAYOUTS {
        let domain = if layout == WorldLayout::One { 223 } else { 224 };
        // Cyclone uses this address alone.
        let place = UdpPlace::new(domain, Ipv4Addr::LOCALHOST).unwrap();
        let Some(cyclone) = Cyclone::start(place) else {
            return;
        };
        let mut drive = Drive::start("free-lane", layout, place);
        for _ in 0..DRIVE_MS {
            drive.step();
        }
        drive.systems.end().unwrap();
        let read = cyclone.end();
        let given = [0, 1].map(|writer| {
            let guid = Guid {
                prefix: GuidPrefix([writer; 12]),
                entity: EntityId([0; 4]),
            };
            let mut gateway = Gateway::default();
            let of_writer = read.iter().filter(|(of, _)| *of == writer);
            for (_, frame) in of_writer.skip(JOINED_FRAMES) {
                gateway.hear(Instant::ORIGIN, guid, frame);
            }
            all_frames(&gateway)
        });
        println!("{layout:?}: {given:?} frames, {} on the bus", drive.on_bus);
        assert!(given.iter().all(|frames| *frames > 1_500), "{given:?}");
    }
}

/// Both systems and an SoC that parks. It gets its time from the machines: they are no faster and
/// no slower than it.
struct Parking {
    drive: Drive,
    soc: Soc,
}

impl Parking {
    fn start(layout: WorldLayout, domain: u16) -> Self {
        let place = place(domain, layout);
        let mut drive = Drive::start("parking", layout, place);
        drive.vehicle.set_driver(Habit {
            parks_from_s: Some(0.0),
            ..Habit::default()
        });
        let profiles = Profiles::load(SOC, "soc.xml").unwrap();
        let profile = (&profiles, "Tandem::Soc");
        let soc = Soc::open(place, profile, Approach::new(WAY_M)).unwrap();
        Self { drive, soc }
    }

    /// Runs until this holds; returns for how many milliseconds.
    fn run(&mut self, most_ms: u64, is_over: impl Fn(&Self) -> bool) -> u64 {
        for ms in 0..most_ms {
            if is_over(self) {
                return ms;
            }
            let now = self.drive.step();
            self.soc.turn_at(now).unwrap();
        }
        panic!("{:?}: {}", self.soc.approach(), self.drive.systems.log());
    }

    fn assert_parked(&self) {
        let now = self.drive.vehicle.snapshot();
        let parked = (0.0, GearCode::Park, ParkingBrakeCode::Applied);
        assert_eq!((now.speed, now.gear, now.parking_brake), parked);
    }
}

/// D-3: an SoC parks the firmware. Under FreeRTOS the busy topics task leaves 4 of its 16 KiB.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn an_soc_parks_the_firmware() {
    for layout in LAYOUTS {
        let mut parking = Parking::start(layout, 222);
        let ms = parking.run(40_000, |it| {
            it.soc.approach().phase() == ApproachPhase::Parked
        });
        parking.assert_parked();
        let driven = parking.soc.approach().driven();
        println!("{layout:?}: parked after {ms} ms, {driven:.2} m");
        assert!((driven - WAY_M).abs() < 0.3, "{driven}");
        assert!(all_frames(parking.soc.gateway()) > 4_000);
        for (system, event) in &parking.drive.events {
            assert!(!matches!(event, Event::SocSilent { .. }), "{system}");
        }
        let free = parking.drive.events.iter().filter_map(|it| match it.1 {
            Event::Stack {
                task: TaskCode::TOPICS,
                free_bytes,
            } => Some(free_bytes),
            _ => None,
        });
        let free = free.min();
        println!("{free:?} bytes of the stack are free");
        match layout {
            WorldLayout::One => assert_eq!(free, None, "there is no kernel"),
            WorldLayout::Two => assert!(free.is_some_and(|bytes| bytes > 4 << 10), "{free:?}"),
        }
        parking.drive.systems.end().unwrap();
    }
}

/// D-3: the cables of both systems are cut while the firmware parks: it stands within the limit.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn a_cut_network_stops_the_firmware() {
    let mut parking = Parking::start(WorldLayout::Two, 221);
    parking.run(40_000, |it| it.soc.approach().driven() > 3.0);
    let speed = parking.drive.vehicle.snapshot().speed;
    assert!(speed > 0.3, "{speed}");
    for system in SystemId::ALL {
        let systems = &mut parking.drive.systems;
        systems.set_fault(system, HardwareFault::Network, true);
    }
    let stands = |it: &Parking| it.drive.vehicle.snapshot().speed == 0.0;
    let ms = parking.run(10_000, stands);
    println!("cut at {speed:.2} m/s: stands after {ms} ms");
    assert!(ms <= SOC_STOP_LIMIT.as_us() / 1_000, "{ms} ms");
    let is_secured = |it: &Parking| it.drive.vehicle.snapshot().gear == GearCode::Park;
    parking.run(2_000, is_secured);
    parking.drive.systems.end().unwrap();
}
