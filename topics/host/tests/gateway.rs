//! The gateway against a model of the bus: each frame that a system published is given once.

use std::collections::BTreeMap;

use proptest::prelude::*;
use tandem_board::{Instant, SystemId};
use tandem_bus::{Control, DriverRequest, EgoMotion, FrameTransmitter, Message};
use tandem_topics::{CanFrame, EntityId, Guid, GuidPrefix, endpoints};
use tandem_topics_host::gateway::{Gateway, Passed, content};

/// Length of a drive, ms.
const DRIVE_MS: u64 = 12_000;
/// An id that the DBC does not have.
const FOREIGN: u32 = 0x8000_0123;
const FOREIGN_PERIOD_MS: u16 = 100;

/// A frame on the bus.
struct OnBus {
    at_ms: u64,
    frame: CanFrame,
    /// The system that sent it, and therefore does not hear it.
    sender: Option<SystemId>,
}

/// What happens to what a system publishes.
#[derive(Clone, Debug)]
struct Stream {
    /// How much later it arrives, ms, in each tenth of the drive.
    lags_ms: Vec<u64>,
    /// From when on it arrives not, and for how long, ms.
    outages_ms: Vec<(u64, u64)>,
    /// Of 100 samples, how many are lost beside that.
    loss_percent: u64,
    seed: u64,
    /// When the system starts again, with a writer of a new name, ms.
    restarts_ms: Vec<u64>,
}

fn streams(lag_ms: u64, outage_ms: u64) -> impl Strategy<Value = [Stream; 2]> {
    let stream = move || {
        (
            prop::collection::vec(0..=lag_ms, 10),
            prop::collection::vec((0..DRIVE_MS, 0..=outage_ms), 0..4),
            prop_oneof![Just(0), 0..60_u64],
            any::<u64>(),
            prop::collection::vec(0..DRIVE_MS, 0..3),
        )
            .prop_map(
                |(lags_ms, outages_ms, loss_percent, seed, restarts_ms)| Stream {
                    lags_ms,
                    outages_ms,
                    loss_percent,
                    seed,
                    restarts_ms,
                },
            )
    };
    [stream(), stream()]
}

fn sample(message: &Message, transmitter: &mut FrameTransmitter) -> CanFrame {
    let encoded = transmitter.encode(message);
    CanFrame {
        id: encoded.id.into(),
        period_ms: 0,
        length: encoded.len as u8,
        data: encoded.bytes,
    }
}

/// The frames of a drive. `varies`: the values of two frames differ.
fn bus(varies: bool) -> Vec<OnBus> {
    let mut transmitter = FrameTransmitter::new();
    let mut frames = Vec::new();
    for at_ms in (0..DRIVE_MS).step_by(10) {
        let speed = if varies { at_ms as f32 / 100.0 } else { 0.0 };
        let mut send = |message, sender| {
            let frame = sample(&message, &mut transmitter);
            frames.push(OnBus {
                at_ms,
                frame,
                sender,
            });
        };
        let motion = EgoMotion {
            speed,
            ..EgoMotion::default()
        };
        send(Message::EgoMotion(motion), None);
        let control = Control {
            acceleration: speed / 10.0,
            ..Control::default()
        };
        send(Message::Control { system: 0, control }, Some(SystemId::A));
        if at_ms % 100 == 0 {
            let request = DriverRequest {
                set_speed: speed,
                ..DriverRequest::default()
            };
            send(Message::DriverRequest(request), None);
        }
    }
    frames
}

/// Frames without counter whose data do not change.
fn foreign_bus() -> Vec<OnBus> {
    let times = (0..DRIVE_MS).step_by(FOREIGN_PERIOD_MS.into());
    let frame = CanFrame {
        id: FOREIGN,
        period_ms: FOREIGN_PERIOD_MS,
        length: 8,
        data: [7; 64],
    };
    let on_bus = |at_ms| OnBus {
        at_ms,
        frame,
        sender: None,
    };
    times.map(on_bus).collect()
}

/// A sample that arrives: when, from which system and writer, which frame of the bus.
type Arrival = (u64, SystemId, Guid, usize);

fn arrivals(bus: &[OnBus], system: SystemId, stream: &Stream) -> Vec<Arrival> {
    let (mut seed, mut last) = (stream.seed, 0);
    let mut arrivals = Vec::new();
    for (place, on_bus) in bus.iter().enumerate() {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        let at = on_bus.at_ms;
        let is_out = |(from, time): &(u64, u64)| (*from..from + time).contains(&at);
        let is_lost = (seed >> 33) % 100 < stream.loss_percent;
        if on_bus.sender == Some(system) || is_lost || stream.outages_ms.iter().any(is_out) {
            continue;
        }
        last = (at + stream.lags_ms[(at * 10 / DRIVE_MS) as usize]).max(last);
        let starts = stream.restarts_ms.iter().filter(|start| **start <= at);
        let start = [system.index() as u8, starts.count() as u8, 0, 0, 0];
        let writer = Guid {
            prefix: endpoints::controller_prefix(system.index() as u8, start),
            entity: EntityId([0, 0, 1, 3]),
        };
        arrivals.push((last, system, writer, place));
    }
    arrivals
}

/// What the gateway has given: places in the bus, and how they passed.
struct Given {
    gateway: Gateway,
    passed: Vec<(usize, Passed)>,
    /// The places of all frames that arrived.
    heard: Vec<usize>,
}

fn drive(bus: &[OnBus], streams: &[Stream; 2]) -> Given {
    let [a, b] = SystemId::ALL.map(|system| arrivals(bus, system, &streams[system.index()]));
    let mut all: Vec<Arrival> = a.into_iter().chain(b).collect();
    all.sort_by_key(|(at, ..)| *at);
    let mut gateway = Gateway::default();
    let mut passed = Vec::new();
    for (at, _, writer, place) in &all {
        let now = Instant::from_ns(at * 1_000_000);
        if let Some(how) = gateway.hear(now, *writer, &bus[*place].frame) {
            passed.push((*place, how));
        }
    }
    let mut heard: Vec<usize> = all.iter().map(|(.., place)| *place).collect();
    heard.sort_unstable();
    heard.dedup();
    Given {
        gateway,
        passed,
        heard,
    }
}

impl Given {
    /// Each frame that arrived, once.
    fn check_once(&self) -> Result<(), TestCaseError> {
        let mut given: Vec<usize> = self.passed.iter().map(|(place, _)| *place).collect();
        given.sort_unstable();
        prop_assert_eq!(&given, &self.heard);
        Ok(())
    }

    /// A frame is late if a newer one of its id was given before. Returns how many frames each id
    /// lacks, between its first and its last one.
    fn check_order(&self, bus: &[OnBus]) -> Result<BTreeMap<u32, u64>, TestCaseError> {
        let mut newest = BTreeMap::new();
        for (place, how) in &self.passed {
            let id = bus[*place].frame.id;
            let before = *newest.get(&id).unwrap_or(&0);
            prop_assert_eq!(*how == Passed::Late, *place < before, "{:x} {}", id, place);
            newest.insert(id, before.max(*place));
        }
        let mut lacks = BTreeMap::new();
        for (id, last) in newest {
            let is_of = |place: &&usize| bus[**place].frame.id == id;
            let mut given = self.passed.iter().map(|(place, _)| place).filter(is_of);
            let Some(first) = given.next().copied() else {
                continue;
            };
            // The counter tells nothing of what is before the first frame.
            let sent = bus[first..=last].iter().filter(|one| one.frame.id == id);
            let after = self.heard.iter().filter(|place| **place >= first);
            let heard = after.filter(is_of).count();
            lacks.insert(id, (sent.count() - heard) as u64);
        }
        Ok(lacks)
    }

    fn jumps(&self) -> u64 {
        self.gateway.reports().map(|(_, report)| report.jumps).sum()
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// D-2: up to 1.2 s apart, with any loss, any outage and any restart, even if the values never
    /// change.
    #[test]
    fn each_frame_is_given_once(streams in streams(1_200, DRIVE_MS), varies: bool) {
        let bus = bus(varies);
        drive(&bus, &streams).check_once()?;
    }

    /// D-2: up to 9 s apart, if values differ.
    #[test]
    fn values_tell_a_system_that_is_seconds_behind(streams in streams(9_000, DRIVE_MS)) {
        let bus = bus(true);
        drive(&bus, &streams).check_once()?;
    }

    /// D-2: frames without counter, up to half a period apart.
    #[test]
    fn a_frame_without_counter_is_given_once(streams in streams(49, DRIVE_MS)) {
        let bus = foreign_bus();
        drive(&bus, &streams).check_once()?;
    }

    /// D-2: what neither system published is counted by id; what one fills in is not.
    #[test]
    fn losses_are_counted_by_id(streams in streams(60, 70)) {
        let bus = bus(false);
        let given = drive(&bus, &streams);
        let lacks = given.check_order(&bus)?;
        prop_assert_eq!(given.jumps(), 0);
        for (id, report) in given.gateway.reports() {
            prop_assert_eq!(report.lost, lacks[&id], "{:x}", id);
        }
    }

    /// Bytes of others never panic, and nothing that one system alone publishes is ever lost.
    #[test]
    fn any_frames_pass(frames in prop::collection::vec(any_frame(), 0..300)) {
        let mut gateway = Gateway::default();
        for (at_ms, frame) in frames {
            let now = Instant::from_ns(u64::from(at_ms) * 1_000_000);
            let writer = Guid { prefix: GuidPrefix([9; 12]), ..Guid::default() };
            prop_assert!(gateway.hear(now, writer, &frame).is_some());
        }
    }
}

fn any_frame() -> impl Strategy<Value = (u16, CanFrame)> {
    let id = prop_oneof![Just(0x110), Just(0xA0), Just(FOREIGN), 0..300_u32];
    (any::<u16>(), id, any::<u16>(), any::<u8>(), any::<u8>()).prop_map(
        |(at_ms, id, period_ms, length, byte)| {
            let frame = CanFrame {
                id,
                period_ms,
                length,
                data: [byte; 64],
            };
            (at_ms, frame)
        },
    )
}

/// D-2: a system dies, and the other one goes on: no frame is missing, although the values never
/// change and the systems stood still at the same counters before.
#[test]
fn the_death_of_a_system_loses_none() {
    let bus = bus(false);
    let quiet = Stream {
        lags_ms: vec![0; 10],
        outages_ms: vec![(200, 3_000)],
        loss_percent: 0,
        seed: 1,
        restarts_ms: Vec::new(),
    };
    // A dies while B does not arrive; B returns 0.1 s later.
    let dies = Stream {
        outages_ms: vec![(3_100, DRIVE_MS)],
        ..quiet.clone()
    };
    let given = drive(&bus, &[dies, quiet]);
    given.check_once().unwrap();
    let motion = given.gateway.reports().find(|(id, _)| *id == 0x110);
    assert_eq!(motion.unwrap().1.lost, 10);
}

/// Equal frames without counter in a burst: one system has lost one of them, and which does not
/// matter.
#[test]
fn equal_frames_of_a_burst_are_counted() {
    let frame = foreign_bus()[0].frame;
    let names = [0, 1].map(|system| Guid {
        prefix: endpoints::controller_prefix(system, [0; 5]),
        ..Guid::default()
    });
    let mut gateway = Gateway::default();
    let order = [0, 1, 1, 0, 1, 0, 0];
    let given = order.map(|system| {
        let passed = gateway.hear(Instant::ORIGIN, names[system], &frame);
        usize::from(passed.is_some())
    });
    assert_eq!(given, [1, 0, 1, 0, 1, 0, 1]);
}

/// A restarted sender begins with counter 0: that is a jump, and no loss.
#[test]
fn a_restarted_sender_is_no_loss() {
    let mut gateway = Gateway::default();
    let motion = Message::EgoMotion(EgoMotion::default());
    let mut at_ms = 0;
    for frames in [200, 50] {
        let mut transmitter = FrameTransmitter::new();
        for _ in 0..frames {
            at_ms += 10;
            let now = Instant::from_ns(at_ms * 1_000_000);
            let frame = sample(&motion, &mut transmitter);
            let passed = gateway.hear(now, Guid::default(), &frame);
            assert_eq!(passed, Some(Passed::InOrder));
            assert!(content(&frame).len() == 16);
        }
    }
    let (_, report) = gateway.reports().next().unwrap();
    assert_eq!((report.frames, report.lost, report.jumps), (250, 0, 1));
}

/// A sender of nonsense fills all places for ids. What is silent makes room, and the memory of an
/// id is bounded.
#[test]
fn ids_of_nonsense_do_not_keep_the_others_out() {
    let mut gateway = Gateway::default();
    let mut hear = |at_ms: u64, id| {
        let frame = CanFrame {
            id,
            ..foreign_bus()[0].frame
        };
        let now = Instant::from_ns(at_ms * 1_000_000);
        gateway.hear(now, Guid::default(), &frame).is_some()
    };
    let given = (0..10_000).filter(|id| hear(0, 1 << 31 | *id)).count();
    assert_eq!(given, 512);
    assert!(!hear(9_999, 0x110));
    assert!(hear(10_000, 0x110));
    assert!(hear(10_010, 0x111));
    assert_eq!(
        (gateway.refused, gateway.reports().count()),
        (10_000 - 512 + 1, 2)
    );
}

/// The named limit: two frames of one signal that equal each other after 256 frames.
#[test]
fn values_that_return_with_the_counter_may_be_taken_for_late() {
    let names = [0, 1].map(|system| Guid {
        prefix: endpoints::controller_prefix(system, [0; 5]),
        ..Guid::default()
    });
    for returns in [false, true] {
        let mut gateway = Gateway::default();
        let mut transmitter = FrameTransmitter::new();
        let mut last = None;
        for n in 0..=256_u64 {
            let speed = match n {
                0 => 3.0,
                256 if returns => 3.0,
                _ => 0.0,
            };
            let motion = EgoMotion {
                speed,
                ..EgoMotion::default()
            };
            let frame = sample(&Message::EgoMotion(motion), &mut transmitter);
            let now = Instant::from_ns(n * 10_000_000);
            last = gateway.hear(now, names[usize::from(n == 256)], &frame);
        }
        assert_eq!(last.is_none(), returns);
    }
}
