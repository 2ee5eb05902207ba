//! Participants over a network that loses, doubles and delays datagrams, in virtual time.
#![allow(clippy::unwrap_used)]

use std::collections::VecDeque;
use tandem_board::{Duration, Instant, NetworkAddress, Recipient};
use tandem_topics::{
    Counts, Durability, Endpoint, GuidPrefix, Outlet, Participant, Qos, READERS, Reliability,
};

const RELIABLE: Qos = Qos {
    reliability: Reliability::Reliable,
    durability: Durability::TransientLocal,
    depth: 3,
};
const UP: Endpoint = Endpoint {
    topic: "vehicle_can",
    type_name: "tandem::CanFrame",
    qos: RELIABLE,
};
const NOW: Qos = Qos {
    durability: Durability::Volatile,
    ..RELIABLE
};
const BEST_EFFORT: Qos = Qos {
    reliability: Reliability::BestEffort,
    durability: Durability::Volatile,
    depth: 3,
};
static UPS: [Endpoint; 1] = [UP];
static NEW_ONES: [Endpoint; 1] = [Endpoint { qos: NOW, ..UP }];
static UNSURE: [Endpoint; 1] = [Endpoint {
    qos: BEST_EFFORT,
    ..UP
}];
static UNSURE_OLD: [Endpoint; 1] = [Endpoint {
    qos: Qos {
        durability: Durability::TransientLocal,
        ..BEST_EFFORT
    },
    ..UP
}];
static OTHERS: [Endpoint; 1] = [Endpoint {
    topic: "another",
    ..UP
}];
static NONE: [Endpoint; 0] = [];
const MS: Duration = Duration::from_ms(1);

type Mcu = Participant<1, 0, 3, 80, 0>;
type Soc = Participant<0, 1, 3, 0, 80>;

/// Messages that a participant sends, and what it tells.
#[derive(Default)]
struct Sent {
    messages: Vec<(Recipient, Vec<u8>)>,
}

impl Outlet for Sent {
    fn send(&mut self, to: Recipient, message: &[u8]) {
        self.messages.push((to, message.to_vec()));
    }
}

const fn place(node: usize) -> NetworkAddress {
    NetworkAddress {
        address: [10, 0, 0, node as u8],
        port: 7_410,
    }
}

const fn prefix(node: usize, start: u8) -> GuidPrefix {
    GuidPrefix([1, 2, 3, 4, node as u8, start, 0, 0, 0, 0, 0, 0])
}

/// Asserts that each part of a message is valid: RTPS 2.5, 8.3.8. A reader of another vendor drops
/// the whole message otherwise.
fn assert_valid(message: &[u8]) {
    let mut rest = &message[20..];
    while let [kind, flags, low, high, body @ ..] = rest {
        assert_eq!(flags & 1, 1, "all numbers are little-endian");
        let (body, behind) = body.split_at(u16::from_le_bytes([*low, *high]).into());
        let word = |at: usize| u32::from_le_bytes(body[at..at + 4].try_into().unwrap());
        let number = |at: usize| u64::from(word(at)) << 32 | u64::from(word(at + 4));
        assert_eq!(body.len() % 4, 0);
        match kind {
            0x06 => assert!(number(8) > 0, "ACKNACK: {body:?}"),
            0x07 => assert!(
                number(8) > 0 && number(16) + 1 >= number(8),
                "HEARTBEAT: {body:?}"
            ),
            0x08 => assert!(number(8) > 0 && number(16) > number(8), "GAP: {body:?}"),
            0x15 => assert!(number(12) > 0, "DATA: {body:?}"),
            _ => {}
        }
        rest = behind;
    }
    assert!(rest.is_empty());
}

/// One writer and some readers on a network.
struct World {
    now: Instant,
    mcu: Mcu,
    socs: Vec<Soc>,
    /// Datagrams under way: when they arrive, at which node. Node 0 is the writer.
    under_way: VecDeque<(Instant, usize, Vec<u8>)>,
    /// Says of each datagram how often it arrives.
    copies: Box<dyn FnMut(usize, usize) -> usize>,
    /// Announcements are lost.
    is_silent: bool,
    taken: Vec<Vec<u32>>,
    written: u32,
}

fn soc(node: usize, start: u8, inputs: &'static [Endpoint; 1]) -> Soc {
    Soc::new(prefix(node, start), place(node), &NONE, inputs)
}

impl World {
    fn new(inputs: &[&'static [Endpoint; 1]]) -> Self {
        Self {
            now: Instant::ORIGIN,
            mcu: Mcu::new(prefix(0, 0), place(0), &UPS, &NONE),
            socs: (1..)
                .zip(inputs)
                .map(|(node, inputs)| soc(node, 0, inputs))
                .collect(),
            under_way: VecDeque::new(),
            copies: Box::new(|_, _| 1),
            is_silent: false,
            taken: vec![Vec::new(); inputs.len()],
            written: 0,
        }
    }

    fn carry(&mut self, from: usize, sent: Sent) {
        for (to, message) in sent.messages {
            assert_valid(&message);
            for node in 0..=self.socs.len() {
                let is_for = match to {
                    Recipient::Everyone => node != from && !self.is_silent,
                    Recipient::One(at) => at == place(node),
                };
                if is_for {
                    for copy in 0..(self.copies)(from, node) {
                        let at = self.now + MS.times(1 + 3 * copy as u32);
                        self.under_way.push_back((at, node, message.clone()));
                    }
                }
            }
        }
    }

    fn with(&mut self, node: usize, act: impl FnOnce(&mut Self, &mut Sent)) {
        let mut sent = Sent::default();
        act(self, &mut sent);
        self.carry(node, sent);
    }

    fn step(&mut self) {
        self.now += MS;
        let now = self.now;
        let mut arrived: Vec<_> = self.under_way.iter().cloned().collect();
        arrived.retain(|(at, ..)| *at <= now);
        self.under_way.retain(|(at, ..)| *at > now);
        for (_, node, message) in arrived {
            self.with(node, |world, sent| match node {
                0 => world.mcu.hear(now, &message, sent),
                _ => world.socs[node - 1].hear(now, &message, sent),
            });
        }
        self.with(0, |world, sent| {
            world.mcu.poll(now, sent);
        });
        for node in 1..=self.socs.len() {
            self.with(node, |world, sent| {
                world.socs[node - 1].poll(now, sent);
            });
            while let Some(sample) = self.socs[node - 1].take(0) {
                assert_eq!(sample.writer.prefix, prefix(0, 0));
                let number = u32::from_le_bytes(sample.payload().try_into().unwrap());
                self.taken[node - 1].push(number);
            }
        }
    }

    fn run(&mut self, ms: u64) {
        for _ in 0..ms {
            self.step();
        }
    }

    fn write(&mut self) {
        self.written += 1;
        let number = self.written;
        self.with(0, |world, sent| {
            let sample = number.to_le_bytes();
            world.mcu.write(0, &sample, sent).unwrap();
        });
    }

    /// Writes `count` samples, one each `ms`, and waits for the repair of the last ones.
    fn publish(&mut self, count: u32, ms: u64) {
        for _ in 0..count {
            self.write();
            self.run(ms);
        }
        self.run(1_000);
    }
}

fn numbers(range: std::ops::RangeInclusive<u32>) -> Vec<u32> {
    range.collect()
}

/// A generator of chances: splitmix64.
fn chances(mut seed: u64) -> impl FnMut() -> u64 {
    move || {
        seed = seed.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (seed ^ (seed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        mixed ^ (mixed >> 31)
    }
}

/// D-2: all samples of a period of 10 ms arrive once and in their order, also through a network
/// that loses every fifth datagram and doubles others. What a longer burst costs is counted and
/// told by its tag.
#[test]
fn what_is_lost_is_repaired_or_counted() {
    for seed in 0..20 {
        let mut world = World::new(&[&UPS]);
        let mut chance = chances(seed);
        world.copies = Box::new(move |_, _| match chance() % 10 {
            0 | 1 => 0,
            2 => 2,
            _ => 1,
        });
        world.run(4_000);
        assert_eq!(world.mcu.readers_of(0), 1, "seed {seed}");
        world.publish(500, 10);
        let taken = &world.taken[0];
        assert!(taken.is_sorted_by(|a, b| a < b), "seed {seed}: {taken:?}");
        let missing: Vec<_> = (1..=500).filter(|it| !taken.contains(it)).collect();
        let counts = world.socs[0].reader_counts(0);
        assert_eq!(counts.lost as usize, missing.len(), "seed {seed}");
        assert!(missing.len() < 15, "seed {seed}: {missing:?}");
        assert!(world.mcu.writer_counts(0).repaired > 50, "seed {seed}");
    }
}

/// D-4: of a burst of four lost samples, the three newest are sent again. The oldest is told.
#[test]
fn a_burst_that_is_longer_than_the_history_is_told() {
    let mut world = World::new(&[&UPS]);
    world.run(2_000);
    world.publish(10, 10);
    world.copies = Box::new(|_, _| 0);
    for _ in 0..4 {
        world.write();
    }
    world.copies = Box::new(|_, _| 1);
    world.run(1_000);
    let expected: Vec<u32> = (1..=10).chain(12..=14).collect();
    assert_eq!(world.taken[0], expected);
    assert_eq!(world.socs[0].reader_counts(0).lost, 1);
    // The reader did not ask for it: the heartbeat told that it is gone.
    assert_eq!(world.mcu.writer_counts(0).repaired, 3);
}

/// D-4: the periodic heartbeat alone repairs the loss of the last sample.
#[test]
fn the_last_sample_is_repaired_after_a_heartbeat() {
    let mut world = World::new(&[&UPS]);
    world.run(2_000);
    world.publish(2, 10);
    world.copies = Box::new(|_, _| 0);
    world.write();
    world.copies = Box::new(|_, _| 1);
    world.run(100);
    assert_eq!(world.taken[0], [1, 2]);
    world.run(300);
    assert_eq!(world.taken[0], [1, 2, 3]);
}

/// D-4, D-5: a reader that joins late gets the last three samples if it asks for them.
#[test]
fn a_late_reader_gets_the_history_that_it_asks_for() {
    let mut world = World::new(&[&UPS, &NEW_ONES]);
    let mut is_there = false;
    for _ in 0..10 {
        world.write();
    }
    world.run(2_000);
    assert_eq!(world.taken, [vec![8, 9, 10], vec![]]);
    is_there |= world.mcu.readers_of(0) == 2;
    assert!(is_there);
    world.publish(3, 10);
    assert_eq!(world.taken, [numbers(8..=13), numbers(11..=13)]);
}

/// D-4: the third reader is refused and counted. It gets a place when another one has left.
#[test]
fn a_third_reader_is_refused() {
    let mut world = World::new(&[&UPS, &UPS, &UPS]);
    world.run(2_000);
    world.publish(5, 10);
    assert_eq!(world.mcu.readers_of(0), READERS);
    assert_eq!(world.mcu.writer_counts(0).refused, 1);
    let heard: Vec<_> = world
        .taken
        .iter()
        .filter(|taken| !taken.is_empty())
        .collect();
    assert_eq!(heard, [&numbers(1..=5), &numbers(1..=5)]);
}

/// A reader whose quality of service does not fit is counted and gets nothing; one of another topic
/// is a stranger.
#[test]
fn what_does_not_fit_is_not_served() {
    let mut world = World::new(&[&OTHERS]);
    world.run(2_000);
    world.publish(5, 10);
    assert_eq!(world.mcu.readers_of(0), 0);
    assert_eq!(world.mcu.writer_counts(0).incompatible, 0);
    // A writer without guarantee, and a reader that wants one.
    let mut world = World::new(&[&UPS]);
    world.mcu = Mcu::new(prefix(0, 0), place(0), &UNSURE, &NONE);
    world.run(2_000);
    world.publish(5, 10);
    assert_eq!(world.mcu.readers_of(0), 0);
    assert_eq!(world.mcu.writer_counts(0).incompatible, 1);
    assert_eq!(world.socs[0].reader_counts(0).incompatible, 1);
    assert_eq!(world.taken[0], [0; 0]);
}

/// A reader without guarantee gets what arrives, in order, and asks for nothing.
#[test]
fn a_reader_without_guarantee_does_not_ask() {
    let mut world = World::new(&[&UNSURE]);
    world.run(2_000);
    world.publish(2, 10);
    world.copies = Box::new(|_, _| 0);
    world.write();
    world.copies = Box::new(|_, _| 1);
    world.publish(2, 10);
    assert_eq!(world.taken[0], [1, 2, 4, 5]);
    assert_eq!(world.mcu.writer_counts(0).repaired, 0);
}

/// A reader without guarantee that asks for history begins with the first sample that arrives.
#[test]
fn a_late_reader_without_guarantee_gets_what_is_new() {
    let mut world = World::new(&[&UNSURE_OLD]);
    for _ in 0..10 {
        world.write();
    }
    world.run(2_000);
    world.publish(3, 10);
    assert_eq!(world.taken[0], [11, 12, 13]);
}

/// A participant that starts again is another one: it is found at once, and the place of the dead
/// one is free when its lease has ended.
#[test]
fn a_participant_that_starts_again_is_a_new_one() {
    let mut world = World::new(&[&UPS, &UPS]);
    world.run(2_000);
    world.publish(3, 10);
    world.socs[0] = soc(1, 1, &UPS);
    world.run(2_000);
    // Its place is still held by the dead one.
    assert_eq!(world.mcu.writer_counts(0).refused, 1);
    // Its lease ends, and the new one gets the place.
    world.run(12_000);
    assert_eq!(world.mcu.readers_of(0), 2);
}

/// One that says that it leaves has no place any more.
#[test]
fn who_leaves_is_forgotten() {
    let mut world = World::new(&[&UPS]);
    world.run(2_000);
    assert_eq!(world.mcu.readers_of(0), 1);
    world.with(1, |world, sent| world.socs[0].leave(sent));
    world.now += MS;
    let left = world.under_way.pop_back().unwrap();
    let mut sent = Sent::default();
    world.mcu.hear(world.now, &left.2, &mut sent);
    assert_eq!(world.mcu.readers_of(0), 0);
}

/// A reader that takes nothing keeps the newest samples of its depth, and counts the others.
#[test]
fn what_is_not_taken_is_replaced() {
    let mut soc = soc(1, 0, &UPS);
    let mut mcu = Mcu::new(prefix(0, 0), place(0), &UPS, &NONE);
    let mut now = Instant::ORIGIN;
    let mut both = |mcu: &mut Mcu, soc: &mut Soc, first: Sent| {
        let (mut to_soc, mut rounds) = (first, 0);
        while !to_soc.messages.is_empty() && rounds < 20 {
            now += MS;
            let mut to_mcu = Sent::default();
            for (_, message) in &to_soc.messages {
                soc.hear(now, message, &mut to_mcu);
            }
            to_soc = Sent::default();
            for (_, message) in &to_mcu.messages {
                mcu.hear(now, message, &mut to_soc);
            }
            rounds += 1;
        }
    };
    let mut sent = Sent::default();
    mcu.poll(Instant::ORIGIN, &mut sent);
    both(&mut mcu, &mut soc, sent);
    for number in 1..=5u32 {
        let mut sent = Sent::default();
        mcu.write(0, &number.to_le_bytes(), &mut sent).unwrap();
        both(&mut mcu, &mut soc, sent);
    }
    let taken: Vec<_> = std::iter::from_fn(|| soc.take(0))
        .map(|sample| sample.payload()[0])
        .collect();
    assert_eq!(taken, [3, 4, 5]);
    assert_eq!(soc.reader_counts(0).replaced, 2);
}

/// A reader notes 32 samples from a missing one on. Those further ahead are sent again.
#[test]
fn a_long_burst_behind_a_loss_arrives() {
    static DEEP: [Endpoint; 1] = [Endpoint {
        qos: Qos {
            depth: 64,
            ..RELIABLE
        },
        ..UP
    }];
    let mut from = Participant::<1, 0, 64, 4, 0>::new(prefix(0, 0), place(0), &DEEP, &NONE);
    let mut to = Participant::<0, 1, 64, 0, 4>::new(prefix(1, 0), place(1), &NONE, &DEEP);
    let (mut sent, mut answers) = (Sent::default(), Sent::default());
    for step in 0..200 {
        let now = Instant::ORIGIN + MS.times(10 * step);
        from.poll(now, &mut sent);
        if step == 100 {
            sent.messages.clear();
            for number in 1..=50u32 {
                from.write(0, &number.to_le_bytes(), &mut sent).unwrap();
            }
            sent.messages.remove(0);
        }
        for (_, message) in std::mem::take(&mut sent).messages {
            to.hear(now, &message, &mut answers);
        }
        to.poll(now, &mut answers);
        for (_, message) in std::mem::take(&mut answers).messages {
            from.hear(now, &message, &mut sent);
        }
    }
    let taken = std::iter::from_fn(|| to.take(0));
    let taken: Vec<_> = taken.map(|sample| sample.payload()[0]).collect();
    assert_eq!(taken, (1..=50).collect::<Vec<u8>>());
    assert_eq!(to.reader_counts(0), Counts::default());
    assert!(from.writer_counts(0).repaired > 1);
}

/// Datagrams of others are counted, and change nothing.
#[test]
fn what_is_not_rtps_is_counted() {
    let mut world = World::new(&[]);
    let mut sent = Sent::default();
    for datagram in [
        &b""[..],
        b"RTP",
        b"RTPX\x02\x03\0\0abcdefghijkl",
        b"RTPS\x03\x03\0\0abcdefghijkl",
    ] {
        world.mcu.hear(world.now, datagram, &mut sent);
    }
    assert_eq!(world.mcu.foreign, 4);
    assert!(sent.messages.is_empty());
}

/// Some vendors repeat their announcement just before its lease ends, so a lost one must not end
/// the exchange: samples and their acknowledgements show as well that a participant lives.
#[test]
fn any_message_renews_a_lease() {
    let mut world = World::new(&[&UPS]);
    world.run(2_000);
    world.is_silent = true;
    // The lease is 10 s.
    for _ in 0..1_100 {
        world.write();
        world.run(10);
    }
    world.run(10);
    assert_eq!(world.taken[0].len(), 1_100);
}

/// D-4: a reader that was refused a place gets it when another one leaves.
#[test]
fn a_place_that_becomes_free_is_given_away() {
    let mut world = World::new(&[&UPS, &UPS, &UPS]);
    world.run(2_000);
    let served = |world: &World| {
        let taken = world.taken.iter();
        taken.filter(|taken| !taken.is_empty()).count()
    };
    world.publish(5, 10);
    assert_eq!(served(&world), READERS);
    let first = world.taken.iter().position(|taken| !taken.is_empty());
    let leaves = first.unwrap() + 1;
    world.with(leaves, |world, sent| world.socs[leaves - 1].leave(sent));
    // Its process has ended: it says no more.
    world.copies = Box::new(move |from, to| usize::from(from != leaves && to != leaves));
    world.run(500);
    world.publish(5, 10);
    assert_eq!(served(&world), 3, "{:?}", world.taken);
}
