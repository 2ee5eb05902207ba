//! An SoC on the network of both systems: frames of the bus go up, commands come down. D-1 to D-4

use std::collections::BTreeMap;

use tandem_board::{Channel, CoreId, Duration, Instant, Network, Recipient, SystemId};
use tandem_board_sim::{Config, SimStation};
use tandem_bus::{FrameReceiver, GearCode, ParkingBrakeCode};
use tandem_cores::driving::parking::SOC_STOP_LIMIT;
use tandem_cores::trace::Event;
use tandem_peripherals::network::PortFault;
use tandem_sim::drive::{Drive, poller};
use tandem_topics::endpoints::{INPUTS, OUTPUTS, SocTopic, controller_prefix, system_of};
use tandem_topics::{CanFrame, GuidPrefix, Outlet, Participant, TopicType};
use tandem_topics_host::approach::{Approach, ApproachPhase};
use tandem_topics_host::gateway::{Gateway, Passed, content};
use tandem_topics_host::soc::Commander;
use tandem_vehicle::{Habit, WorldSnapshot};

use crate::print_story;

const MS: Duration = Duration::from_ms(1);
/// The time of a datagram in cables and switch.
const WIRE: Duration = Duration::from_us(100);
/// Way to the place where the vehicle is parked, m.
pub(crate) const WAY_M: f32 = 12.0;

struct Port<'a>(&'a SimStation);

impl Outlet for Port<'_> {
    fn send(&mut self, to: Recipient, message: &[u8]) {
        let _lost = self.0.try_send(Channel::Topics, to, message);
    }
}

/// The parking application of the SoC's process, on a station of the simulated network.
pub(crate) struct Soc {
    pub(crate) station: SimStation,
    participant: Participant<4, 1, 32, 255, 255>,
    gateway: Gateway,
    receiver: FrameReceiver,
    commander: Commander,
    pub(crate) approach: Approach,
    /// Samples of each system.
    heard: BTreeMap<u8, u32>,
}

impl Soc {
    pub(crate) fn join(drive: &mut Drive, name: u8) -> Self {
        let station = drive.pair.join_network();
        let at = station.address(Channel::Topics).expect("it");
        Self {
            station,
            participant: Participant::new(GuidPrefix([name; 12]), at, &INPUTS, &OUTPUTS),
            gateway: Gateway::default(),
            receiver: FrameReceiver::new(),
            commander: Commander::default(),
            approach: Approach::new(WAY_M),
            heard: BTreeMap::new(),
        }
    }

    pub(crate) fn turn(&mut self, now: Instant) {
        let mut bytes = [0; 1_472];
        while let Some(it) = self.station.try_receive(Channel::Topics, &mut bytes) {
            let port = &mut Port(&self.station);
            self.participant.hear(now, &bytes[..it.len], port);
            while let Some(sample) = self.participant.take(0) {
                let system = system_of(sample.writer.prefix).expect("a system");
                *self.heard.entry(system).or_default() += 1;
                let frame = CanFrame::decode(sample.payload()).expect("a frame");
                if self.gateway.hear(now, sample.writer, &frame) == Some(Passed::InOrder)
                    && let Ok(message) = self.receiver.receive(frame.id, content(&frame))
                {
                    self.approach.on_message(now, &message);
                }
            }
        }
        let orders = self.approach.orders(now);
        let port = &mut Port(&self.station);
        for topic in SocTopic::ALL {
            let payload = self.commander.due(now, topic, &orders).expect("in range");
            if let Some(payload) = payload {
                let written = self.participant.write(topic as usize, &payload, port);
                written.expect("a free number");
            }
        }
        self.participant.poll(now, port);
    }

    /// Frames that neither system has published, of all ids.
    fn lost(&self) -> u64 {
        self.gateway.reports().map(|(_, report)| report.lost).sum()
    }
}

/// Returns a parking drive on a network, without an SoC.
fn parking(seed: u64) -> Drive {
    let config = Config {
        seed,
        network: Some(WIRE),
        ..Config::default()
    };
    let limits = tandem_cores::Config::rt();
    let drive = Drive::on_board("parking", config, move |board| poller(board, limits));
    drive.seen.borrow_mut().world.set_driver(Habit {
        parks_from_s: Some(0.0),
        ..Habit::default()
    });
    drive
}

pub(crate) struct Parked {
    pub(crate) drive: Drive,
    pub(crate) soc: Soc,
}

impl Parked {
    pub(crate) fn new(seed: u64) -> Self {
        let mut drive = parking(seed);
        let soc = Soc::join(&mut drive, 7);
        Self { drive, soc }
    }

    pub(crate) fn run_until(
        &mut self,
        most_ms: u64,
        mut is_over: impl FnMut(&Self) -> bool,
    ) -> u64 {
        for ms in 0..most_ms {
            if is_over(self) {
                return ms;
            }
            self.drive.run_for(MS);
            self.soc.turn(self.drive.pair.now());
        }
        most_ms
    }

    pub(crate) fn now(&self) -> WorldSnapshot {
        self.drive.seen.borrow().world.snapshot().clone()
    }

    pub(crate) fn assert_parked(&self) {
        let now = self.now();
        assert_eq!(now.speed, 0.0);
        assert_eq!(
            (now.gear, now.parking_brake),
            (GearCode::Park, ParkingBrakeCode::Applied)
        );
    }

    fn events(&self, is: fn(&Event) -> bool) -> Vec<Event> {
        let events = self.drive.events.iter().map(|(.., event)| *event);
        events.filter(is).collect()
    }
}

pub(crate) fn is_parked(parked: &Parked) -> bool {
    parked.soc.approach.phase() == ApproachPhase::Parked
}

/// D-2, D-3, T-RED-4: the SoC parks by what it hears, and the master dies on the way. Each frame of
/// the bus reaches the SoC, before, during and after the takeover.
#[test]
fn an_soc_parks_by_topics_and_a_takeover_loses_no_frame() {
    for (seed, dies_at_m) in [(3, None), (4, Some(1.0)), (5, Some(6.0))] {
        let mut parked = Parked::new(seed);
        if let Some(way) = dies_at_m {
            parked.run_until(60_000, |it| it.soc.approach.driven() > way);
            parked.drive.pair.power_off(SystemId::A);
        }
        parked.run_until(60_000, is_parked);
        parked.run_until(500, |_| false);
        print_story(&parked.drive);
        parked.assert_parked();
        let driven = parked.soc.approach.driven();
        assert!((driven - WAY_M).abs() < 0.3, "{driven}");
        let frames: u64 = parked.soc.gateway.reports().map(|(_, it)| it.frames).sum();
        println!(
            "{:?} samples, {frames} frames, {} lost",
            parked.soc.heard,
            parked.soc.lost()
        );
        assert!(frames > 4_000, "{frames}");
        assert_eq!(parked.soc.lost(), 0);
        assert_eq!(parked.soc.heard.len(), 2);
        assert_eq!(
            parked.events(|it| matches!(it, Event::SocSilent { .. })),
            []
        );
        let gap = parked.drive.gap_max();
        assert!(gap < Duration::from_ms(20), "{gap:?}");
    }
}

/// D-4: cables that lose a fifth of all datagrams. Heartbeats with each sample repair what the
/// depth of three allows, and two systems publish: nearly each frame arrives, and what is lost is
/// told by its id.
#[test]
fn an_soc_parks_over_cables_that_lose_datagrams() {
    let mut parked = Parked::new(6);
    let fault = PortFault {
        lost_out: 100,
        lost_in: 100,
        ..PortFault::default()
    };
    for system in SystemId::ALL {
        parked.drive.pair.disturb_network(system, fault);
    }
    parked.run_until(60_000, is_parked);
    parked.assert_parked();
    let (mut frames, mut lost) = (0, 0);
    for (id, report) in parked.soc.gateway.reports() {
        println!("{id:#05x}: {} frames, {} lost", report.frames, report.lost);
        frames += report.frames;
        lost += report.lost;
    }
    assert!(frames > 5_000 && lost * 50 < frames, "{lost} of {frames}");
    assert_eq!(
        parked.events(|it| matches!(it, Event::SocSilent { .. })),
        []
    );
}

/// D-3: the network is cut on the way. The vehicle stands within the stated time, for good.
#[test]
fn a_cut_network_stops_the_vehicle_within_the_stated_time() {
    for cut_at_m in [0.3, 3.0, 9.0] {
        let mut parked = Parked::new(8);
        parked.run_until(60_000, |it| it.soc.approach.driven() > cut_at_m);
        let speed = parked.now().speed;
        assert!(speed > 0.3, "{speed}");
        let cut = PortFault {
            lost_out: 1_000,
            lost_in: 1_000,
            ..PortFault::default()
        };
        parked.soc.station.disturb(cut);
        let ms = parked.run_until(10_000, |it| it.now().speed == 0.0);
        println!("cut at {cut_at_m} m, {speed:.2} m/s: stands after {ms} ms");
        assert!(ms <= SOC_STOP_LIMIT.as_us() / 1_000, "{ms}");
        parked.run_until(2_000, |_| false);
        parked.assert_parked();
        // The network is back: the stop is completed, and nothing moves.
        parked.soc.station.disturb(PortFault::default());
        let station = parked.now().station;
        parked.run_until(5_000, |_| false);
        assert_eq!(parked.now().station, station);
        let silent = parked.events(|it| matches!(it, Event::SocSilent { .. }));
        assert_eq!(silent.len(), 2, "{silent:?}");
    }
}

/// D-4: a writer serves two readers and a reader two writers. Two SoCs are heard, one commands; a
/// third finds no place, and disturbs neither.
#[test]
fn a_third_computer_finds_no_place() {
    let mut parked = Parked::new(9);
    let mut others: Vec<_> = [8, 9].map(|name| Soc::join(&mut parked.drive, name)).into();
    // They command too: to stay where they are.
    for other in &mut others {
        other.approach = Approach::new(0.0);
    }
    for ms in 0..30_000 {
        parked.run_until(1, |_| false);
        // The first SoC was there before.
        if ms > 1_500 {
            let now = parked.drive.pair.now();
            others.iter_mut().for_each(|other| other.turn(now));
        }
        if is_parked(&parked) {
            break;
        }
    }
    parked.assert_parked();
    let driven = parked.soc.approach.driven();
    assert!((driven - WAY_M).abs() < 0.3, "{driven}");
    let heard = others.iter().map(|other| other.heard.len());
    assert_eq!(heard.collect::<Vec<_>>(), [2, 0]);
    assert_eq!(parked.soc.lost(), 0);
}

/// D-2: the controller supervises loss and age of each frame that it hears.
#[test]
fn a_frame_that_falls_silent_is_told_by_its_id() {
    let mut parked = Parked::new(10);
    parked.run_until(3_000, |_| false);
    let silent = |it: &Event| matches!(it, Event::FrameSilent { .. });
    assert_eq!(parked.events(silent), []);
    parked.drive.pair.power_off(SystemId::A);
    parked.run_until(1_000, |_| false);
    let ids: Vec<u32> = parked
        .drive
        .events
        .iter()
        .filter(|(_, system, core, _)| (*system, *core) == (SystemId::B, CoreId::CONTROL))
        .filter_map(|(.., event)| match event {
            Event::FrameSilent { id, .. } => Some(*id),
            _ => None,
        })
        .collect();
    assert_eq!(ids, [0x0A0, 0x0B0], "the frames of the system that is lost");
}

/// The names of the systems' participants differ from start to start.
#[test]
fn a_restarted_system_is_a_new_participant() {
    let mut parked = Parked::new(11);
    parked.run_until(3_000, |_| false);
    let of_b = |parked: &Parked| {
        let writers = parked.soc.participant.writers_of(0);
        let prefixes = writers.map(|writer| writer.prefix);
        prefixes
            .filter(|it| system_of(*it) == Some(1))
            .collect::<Vec<_>>()
    };
    let before = of_b(&parked);
    assert_eq!(before.len(), 1);
    assert_ne!(before, [controller_prefix(1, [0; 5])]);
    parked.drive.pair.power_off(SystemId::B);
    parked.run_until(500, |_| false);
    parked.drive.pair.power_on(SystemId::B);
    parked.run_until(20_000, |it| {
        of_b(it).iter().any(|name| !before.contains(name))
    });
    let after = of_b(&parked);
    assert!(after.iter().any(|name| !before.contains(name)), "{after:?}");
}

/// A battery is connected again: the clock begins anew, and only the flash tells the two starts
/// apart. A subscriber that has heard the first one hears the second one too.
#[test]
fn a_start_with_the_same_clock_is_a_new_participant() {
    let mut flash: Option<Vec<u8>> = None;
    let mut names = vec![];
    for _ in 0..3 {
        let mut parked = Parked::new(11);
        let pair = &mut parked.drive.pair;
        pair.power_off(SystemId::B);
        if let Some(before) = flash {
            pair.edit_flash(SystemId::B, |bytes| bytes.copy_from_slice(&before));
        }
        pair.power_on(SystemId::B);
        parked.run_until(3_000, |_| false);
        let writers = parked.soc.participant.writers_of(0);
        names.extend(
            writers
                .map(|it| it.prefix)
                .find(|it| system_of(*it) == Some(1)),
        );
        flash = Some(parked.drive.pair.flash(SystemId::B));
    }
    let [first, second, third] = names[..] else {
        panic!("{names:?}");
    };
    assert!(first != second && second != third, "{names:?}");
}
