//! Tests of master and slave on a link in virtual time, and tables of messages.

use super::codec::{Body, Message, decode, send};
use super::*;
use crate::{Arbitrary, GlobalTime, Sample, Scale, Tai};
use Body::{FollowUp, Sync};
use proptest::prelude::*;
use std::vec::Vec;

const MASTER: PortIdentity = PortIdentity::from_mac([0, 0x1B, 0x19, 0, 0, 1]);
const OTHER: PortIdentity = PortIdentity::from_mac([0, 0x1B, 0x19, 0, 0, 2]);
const SLAVE: PortIdentity = PortIdentity::from_mac([0, 0x1B, 0x19, 0, 0, 9]);
const MS: u64 = 1_000_000;
/// The global time when the simulation begins, and the slave's local one, ns.
const EPOCH: u64 = 1_700_000_000_000_000_000;
const BEGIN: u64 = 5_000 * MS;
/// A message leaves so long after it was sent, ns.
const LEAVES_AFTER: u64 = 5 * MS;
const GPTP: PtpProfile = PtpProfile::GPTP;
const BOTH: [PtpProfile; 2] = [GPTP, PtpProfile::END_TO_END];

#[derive(Default)]
struct Out(Vec<Vec<u8>>);

impl TimeOutlet for Out {
    fn send(&mut self, message: &[u8], _: Option<EventId>) {
        self.0.push(message.to_vec());
    }
}

fn bytes(profile: PtpProfile, source: PortIdentity, sequence: u16, body: Body) -> Vec<u8> {
    let mut out = Out::default();
    send(profile, &Message::new(source, sequence, body), 0, &mut out);
    out.0.remove(0)
}

fn announce(source: PortIdentity) -> Body {
    Body::Announce(source.clock, Claims::default())
}

fn master<S: Scale>(profile: PtpProfile, identity: PortIdentity) -> Master<S> {
    Master::new(MasterSettings {
        identity,
        profile,
        claims: Claims::default(),
        sync_exponent: -3,
    })
}

/// Numbers that look random.
struct Rng(u64);

impl Rng {
    fn below(&mut self, end: usize) -> usize {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        (self.0 >> 33) as usize % end
    }
}

/// A message on the way: when it arrives, where (0: at the slave), and what it is.
type OnTheWay = (u64, usize, Vec<u8>);
/// What happens to a message on the way.
type Fault = fn(&mut Rng, &mut Vec<OnTheWay>);

/// Master and slave on a link. All times are ns of true time since the beginning.
struct Bench<S: Scale> {
    master: Master<S>,
    slave: Slave<S>,
    profile: PtpProfile,
    now: u64,
    /// How much faster than true time the slave's clock runs, 10^-9.
    ppb: i64,
    /// The master's time minus the true one.
    ahead: u64,
    /// To the slave and to the master.
    delays: [u64; 2],
    wire: Vec<OnTheWay>,
    fault: Fault,
    rng: Rng,
    samples: Vec<Sample<S>>,
}

impl<S: Scale> Bench<S> {
    fn new(profile: PtpProfile) -> Self {
        Self {
            master: master(profile, MASTER),
            slave: Slave::new(SlaveSettings::new(SLAVE, profile)),
            profile,
            now: 0,
            ppb: 0,
            ahead: 0,
            delays: [2_000; 2],
            wire: Vec::new(),
            fault: |_, _| {},
            rng: Rng(1),
            samples: Vec::new(),
        }
    }

    /// Returns the time of the slave's clock `later`, ns.
    fn local(&self, later: u64) -> Instant {
        let at = self.now + later;
        let gained = at as i64 / 1_000 * self.ppb / 1_000_000;
        Instant::from_ns((BEGIN + at).wrapping_add_signed(gained))
    }

    fn put(&mut self, to: usize, messages: Out) {
        let epoch = EPOCH + self.ahead;
        let global = |at: Instant| Some(GlobalTime::from_ns(epoch + at.as_ns()));
        for message in messages.0 {
            let mut copies = std::vec![(
                self.now + LEAVES_AFTER + self.delays[to],
                to,
                message.clone()
            )];
            (self.fault)(&mut self.rng, &mut copies);
            self.wire.extend(copies);
            let mut out = Out::default();
            match (EventId::of(&message), to) {
                (Some(event), 0) => {
                    let at = Instant::from_ns(self.now + LEAVES_AFTER);
                    self.master.on_sent(event, at, global, &mut out);
                }
                (Some(event), _) => {
                    self.slave
                        .on_sent(event, self.local(LEAVES_AFTER), &mut out);
                }
                _ => {}
            }
            self.put(to, out);
        }
    }

    fn run(&mut self, ms: u64) -> &mut Self {
        let end = self.now + ms * MS;
        while self.now < end {
            let [mut forth, mut back] = [Out::default(), Out::default()];
            let epoch = EPOCH + self.ahead;
            let global = |at: Instant| Some(GlobalTime::from_ns(epoch + at.as_ns()));
            let (now, local) = (Instant::from_ns(self.now), self.local(0));
            self.master.poll(now, global, &mut forth);
            self.slave.poll(local, &mut back);
            self.wire.sort_by_key(|it| it.0);
            if self.wire.first().is_some_and(|it| it.0 <= self.now) {
                let (_, to, message) = self.wire.remove(0);
                if to == 0 {
                    self.samples
                        .extend(self.slave.on_message(local, &message, &mut back));
                } else {
                    self.master.on_message(now, &message, global, &mut forth);
                }
            }
            self.put(0, forth);
            self.put(1, back);
            let next = self.wire.iter().map(|it| it.0).min().unwrap_or(u64::MAX);
            self.now = next.clamp(self.now, self.now - self.now % MS + MS);
        }
        self
    }

    /// Returns the errors of the samples, ns. They are within what the samples say of them.
    fn errors(&self) -> Vec<i64> {
        let error = |sample: &Sample<S>| {
            let local = (sample.local.as_ns() - BEGIN) as i128;
            let true_ns = local * 1_000_000_000 / (1_000_000_000 + i128::from(self.ppb));
            let truth = GlobalTime::from_ns(EPOCH + self.ahead + true_ns as u64);
            let error = sample.global.after(truth);
            assert!(
                error.unsigned_abs() <= sample.error.as_ns(),
                "{error} > {sample:?}"
            );
            error
        };
        self.samples.iter().map(error).collect()
    }

    /// Lets the slave hear a message, 1 µs after the last one.
    fn hear(&mut self, source: PortIdentity, sequence: u16, body: Body) -> Option<Sample<S>> {
        self.now += 1_000;
        let message = bytes(self.profile, source, sequence, body);
        self.slave
            .on_message(self.local(0), &message, &mut Out::default())
    }
}

/// S-2: both mechanisms find the delay and the ratio of the rates. Half of an asymmetry is error,
/// which no measurement there and back can see; the samples say how large it may be.
#[test]
fn the_error_is_half_of_the_asymmetry() {
    for profile in BOTH {
        for (ppb, delays, expected) in [
            (0, [2_000; 2], 0),
            (100_000, [2_000; 2], 0),
            (-100_000, [300_000; 2], 0),
            (20_000, [40_000, 10_000], -15_000),
        ] {
            let mut bench = Bench::<Arbitrary>::new(profile);
            (bench.ppb, bench.delays) = (ppb, delays);
            let errors = bench.run(20_000).errors();
            assert!(errors.len() > 140, "{}", errors.len());
            // The first delays are measured without the ratio of the rates.
            let errors = errors[40..].iter();
            let worst = errors.map(|it| (it - expected).abs()).max();
            assert!(worst <= Some(60), "{profile:?} {ppb}: {worst:?} ns");
            let status = bench.slave.status();
            assert!((status.rate_ppb + ppb).abs() < 100, "{status:?}");
            assert_eq!((status.why, status.counts.leaps), (None, 0));
        }
    }
}

/// S-2: no loss, doubling, delay, swap or damaged header of any message gives a wrong sample. Only
/// what keeps an event message on the way moves a sample by that; this is the time base's matter.
#[test]
fn faults_on_the_way_give_no_wrong_sample() {
    let faults: [Fault; 6] = [
        |rng, copies| copies.truncate(rng.below(4).min(1)),
        |rng, copies| {
            let mut copy = copies[0].clone();
            copy.0 += rng.below(400) as u64 * MS;
            copies.push(copy);
        },
        |rng, copies| {
            let is_event = EventId::of(&copies[0].2).is_some();
            copies[0].0 += if is_event {
                0
            } else {
                rng.below(400) as u64 * MS
            };
        },
        |rng, copies| {
            // Without the correction: like the times, only the checksum of the frame protects it.
            let place = rng.below(26);
            let place = if place < 8 { place } else { place + 8 };
            copies[0].2[place] ^= u8::from(rng.below(3) == 0) << rng.below(8);
        },
        |rng, copies| {
            let len = copies[0].2.len();
            copies[0].2.truncate(rng.below(4 * len));
        },
        |rng, copies| {
            // Before it another one with another time: an answer to another request or port, or a
            // message from another port.
            let mut forged = copies[0].clone();
            let is_answer = forged.2.len() == 54 && forged.2[0] & 15 != 2;
            let place = if is_answer {
                30 + 14 * rng.below(2)
            } else {
                27
            };
            forged.2[place] ^= 1;
            forged.2[42] ^= 0x40;
            copies.insert(0, forged);
        },
    ];
    for profile in BOTH {
        for (number, fault) in faults.into_iter().enumerate() {
            let mut samples = 0;
            for seed in 1..20 {
                let mut bench = Bench::<Arbitrary>::new(profile);
                (bench.fault, bench.rng, bench.ppb) = (fault, Rng(seed), 50_000);
                bench.slave = Slave::new(SlaveSettings {
                    master: Some(MASTER.clock),
                    ..SlaveSettings::new(SLAVE, profile)
                });
                let errors = bench.run(20_000).errors();
                let worst = errors.iter().map(|it| it.abs()).max().unwrap_or(0);
                assert!(worst <= 300, "fault {number}, seed {seed}: {worst} ns");
                samples += errors.len();
            }
            assert!(samples > 100, "fault {number}: {samples}");
        }
    }
}

/// S-2: a Follow_Up belongs to the one Sync of its number that came before it. A table has numbers
/// of messages, and for those of a Follow_Up whether a sample comes of it.
#[test]
#[rustfmt::skip]
fn a_follow_up_belongs_to_one_sync() {
    const S: Option<bool> = None;
    const YES: Option<bool> = Some(true);
    const NO: Option<bool> = Some(false);
    let tables: [&[(u16, Option<bool>)]; 11] = [
        &[(1, S), (1, YES)],
        &[(1, NO), (1, S)],
        &[(1, NO), (1, S), (1, YES)],
        &[(1, S), (2, S), (2, YES), (1, NO)],
        &[(1, S), (2, S), (1, NO), (2, YES)],
        &[(10, S), (99, NO), (10, YES)],
        &[(1, S), (1, YES), (1, NO), (1, S), (1, NO)],
        &[(1, S), (1, S), (1, NO), (2, S), (2, YES)],
        &[(2, S), (2, YES), (1, S), (1, NO), (3, S), (3, YES)],
        &[(0xFFFF, S), (0xFFFF, YES), (0, S), (0, YES)],
        &[(1, S), (1, YES), (0x2001, S), (0x2001, NO), (2, S), (2, YES)],
    ];
    for table in tables {
        let mut bench = Bench::<Arbitrary>::new(GPTP);
        // The same master is chosen again, and its numbers begin anew.
        bench.run(2_500).slave.poll(Instant::NEVER, &mut Out::default());
        bench.hear(MASTER, 0, announce(MASTER));
        for &(sequence, expected) in table {
            let body = expected.map_or(Sync, |_| FollowUp(EPOCH + bench.now));
            assert!(bench.hear(OTHER, sequence, body).is_none());
            let sample = bench.hear(MASTER, sequence, body);
            assert_eq!(sample.is_some(), expected == YES, "{table:?} at {sequence}");
        }
    }
}

/// S-2: a slave without samples tells why.
#[test]
#[rustfmt::skip]
fn it_tells_why_there_are_no_samples() {
    type Heard = (PtpProfile, PortIdentity, Body);
    fn why<S: Scale>(settings: SlaveSettings, heard: &[Heard]) -> Option<Why> {
        let mut slave = Slave::<S>::new(settings);
        for (at, (profile, source, body)) in heard.iter().enumerate() {
            let message = bytes(*profile, *source, 1, *body);
            slave.on_message(Instant::from_ns(at as u64 * MS), &message, &mut Out::default());
        }
        slave.status().why
    }
    let domain_7 = PtpProfile { domain: 7, ..GPTP };
    let any = SlaveSettings::new(SLAVE, GPTP);
    let one = SlaveSettings { master: Some(MASTER.clock), ..any };
    let fixed = SlaveSettings { unannounced: Some(Claims::default()), ..any };
    let heard = [
        (GPTP, MASTER, announce(MASTER)),
        (GPTP, MASTER, Sync),
        (GPTP, MASTER, FollowUp(EPOCH)),
        (GPTP, MASTER, announce(OTHER)),
    ];
    let table = [
        (any, &[][..], Why::Silent),
        (any, &[(GPTP, SLAVE, Sync)], Why::Silent),
        (any, &[(PtpProfile::END_TO_END, MASTER, Sync)], Why::OtherProfile),
        (any, &[(domain_7, MASTER, Sync)], Why::OtherDomain),
        (any, &[(GPTP, MASTER, Sync), (domain_7, OTHER, Sync)], Why::NoAnnounce),
        (one, &[(GPTP, OTHER, announce(OTHER))], Why::OtherMaster),
        (any, &heard[..1], Why::NoFollowUp),
        (fixed, &heard[1..2], Why::NoFollowUp),
        (any, &heard[..3], Why::NoAnswer),
        (fixed, &heard[1..3], Why::NoAnswer),
        (one, &heard[..3], Why::NoAnswer),
        (any, &heard, Why::OtherGrandmaster),
    ];
    for (settings, messages, expected) in table {
        assert_eq!(why::<Arbitrary>(settings, messages), Some(expected), "{messages:?}");
    }
    assert_eq!(why::<Tai>(any, &heard), Some(Why::OtherScale));
    let mut slave = Slave::<Arbitrary>::new(fixed);
    let mut message = bytes(GPTP, MASTER, 1, Sync);
    slave.on_message(Instant::ORIGIN, &message[..20], &mut Out::default());
    assert_eq!(slave.status().why, Some(Why::Malformed));
    message[6] = 0;
    slave.on_message(Instant::ORIGIN, &message, &mut Out::default());
    assert_eq!(slave.status().why, Some(Why::OneStep));
}

/// S-2: a peer delay needs one whole exchange with one peer. Each answer has its sender, whom it
/// answers, the request's number, its time, a correction in half ns, and its arrival if it is the
/// first of the two.
#[test]
#[rustfmt::skip]
fn a_peer_delay_needs_one_whole_exchange() {
    type Answer = (PortIdentity, PortIdentity, u16, u64, i64, Option<u64>);
    let first = |t2, t4| (MASTER, SLAVE, 1, t2, 0, Some(t4));
    let second = |t3| (MASTER, SLAVE, 1, t3, 0, None);
    let (answer, follow_up) = (first(100, 220), second(120));
    let table: [(&[Answer], bool, Result<u64, Why>); 15] = [
        (&[answer, follow_up], true, Ok(100)),
        (&[first(200, 500), second(250)], true, Ok(225)),
        (&[(MASTER, SLAVE, 1, 100, 4, Some(220)), follow_up], true, Ok(99)),
        (&[answer, (MASTER, SLAVE, 1, 120, 3, None)], true, Ok(99)),
        (&[follow_up, answer, first(1, 900), second(2)], true, Ok(100)),
        (&[answer, follow_up], false, Err(Why::NoStamp)),
        (&[answer], true, Err(Why::NoAnswer)),
        (&[follow_up], true, Err(Why::NoAnswer)),
        (&[(MASTER, SLAVE, 0, 100, 0, Some(220)), follow_up], true, Err(Why::NoAnswer)),
        (&[answer, (MASTER, SLAVE, 2, 120, 0, None)], true, Err(Why::NoAnswer)),
        (&[(MASTER, OTHER, 1, 100, 0, Some(220)), follow_up], true, Err(Why::NoAnswer)),
        (&[answer, (OTHER, SLAVE, 1, 120, 0, None)], true, Err(Why::ManyPeers)),
        (&[answer, follow_up, (OTHER, SLAVE, 1, 100, 0, Some(220))], true, Err(Why::ManyPeers)),
        (&[first(100, 220), second(500_120)], true, Err(Why::NegativeDelay)),
        (&[first(100, 3 * MS), second(120)], true, Err(Why::DelayAboveThreshold)),
    ];
    for (answers, has_stamp, expected) in table {
        let mut bench = Bench::<Arbitrary>::new(GPTP);
        for body in [announce(MASTER), Sync, FollowUp(EPOCH)] {
            bench.hear(MASTER, 1, body);
        }
        let (t1, mut out) = (bench.local(0), Out::default());
        bench.slave.poll(t1, &mut out);
        let event = EventId::of(&out.0[0]).unwrap();
        let sequence = if has_stamp { event.sequence } else { 0 };
        bench.slave.on_sent(EventId { sequence, ..event }, t1, &mut out);
        for &(source, to, sequence, time, correction, t4) in answers {
            let response = t4.map(|_| Body::PeerResponse(time, to));
            let body = response.unwrap_or(Body::PeerResponseFollowUp(time, to));
            let mut message = bytes(GPTP, source, sequence, body);
            message[8..16].copy_from_slice(&(correction << 15).to_be_bytes());
            let at = t1 + Duration::from_ns(t4.unwrap_or(1_000));
            bench.slave.on_message(at, &message, &mut out);
        }
        bench.slave.poll(t1 + Duration::from_ms(1_000), &mut out);
        let status = bench.slave.status();
        let found = status.delay.map(Duration::as_ns).ok_or_else(|| status.why.unwrap());
        assert_eq!(found, expected, "{answers:?}");
    }
}

/// S-2: a second master is counted and never mixed in. Another grandmaster, behind the same port or
/// another one, is followed after the time-out.
#[test]
fn another_master_has_to_wait() {
    for profile in BOTH {
        let mut bench = Bench::<Arbitrary>::new(profile);
        bench.run(4_100);
        bench.hear(OTHER, 7, announce(OTHER));
        bench.hear(OTHER, 7, Sync);
        assert!(bench.hear(OTHER, 7, FollowUp(9)).is_none());
        let status = bench.slave.status();
        assert_eq!((status.counts.others, status.counts.chosen), (2, 1));
        bench.hear(MASTER, 0, announce(OTHER));
        assert_eq!(bench.slave.status().why, Some(Why::OtherGrandmaster));
        bench.samples.clear();
        assert!(bench.run(800).samples.is_empty());
        (bench.master, bench.delays) = (master(profile, OTHER), [50_000; 2]);
        assert!(bench.run(1_500).samples.is_empty());
        let status = bench.run(4_000).slave.status();
        assert_eq!(status.followed.map(|it| it.port), Some(OTHER));
        assert!(bench.errors().len() > 10, "{status:?}");
    }
}

/// S-2: a leap of the master's time is counted before samples have the new time.
#[test]
fn a_leap_of_the_master_is_told() {
    for (profile, ahead) in [
        (BOTH[0], 0),
        (BOTH[0], 1_000),
        (BOTH[1], 0),
        (BOTH[1], 1_000),
    ] {
        let mut bench = Bench::<Arbitrary>::new(profile);
        bench.ahead = 500 * MS;
        bench.run(3_000).samples.clear();
        bench.ahead = ahead * MS;
        bench.run(6_000);
        let status = bench.slave.status();
        assert_eq!((status.counts.leaps, status.why), (1, None));
        assert!(bench.errors().len() > 40);
    }
}

/// S-2: a delay counts until three requests in a row have got no answer.
#[test]
fn a_delay_ends_without_answers() {
    for profile in BOTH {
        let mut bench = Bench::<Arbitrary>::new(profile);
        bench.run(4_500);
        bench.fault = |_, copies| copies.retain(|it| ![3, 9].contains(&(it.2[0] & 15)));
        assert_eq!(bench.run(1_900).slave.status().why, None);
        assert_eq!(bench.run(3_000).slave.status().why, Some(Why::NoAnswer));
    }
}

/// S-2: a master whose caller has no time, or gets no stamps, sends none.
#[test]
fn a_master_without_time_is_silent() {
    for profile in BOTH {
        let mut bench = Bench::<Tai>::new(profile);
        let (master, mut out) = (&mut bench.master, Out::default());
        let ask = bytes(profile, SLAVE, 1, Body::DelayRequest);
        master.poll(Instant::ORIGIN, |_| None, &mut out);
        master.on_message(Instant::ORIGIN, &ask, |_| None, &mut out);
        assert!(out.0.is_empty());
        let (at, time) = (Instant::from_ns(1_000 * MS), |_| {
            Some(GlobalTime::from_ns(EPOCH))
        });
        master.poll(at, time, &mut out);
        let kinds: Vec<u8> = out.0.iter().map(|it| it[0] & 15).collect();
        assert_eq!(kinds, [0xB, 0x0]);
        let sync = EventId::of(&out.0[1]).unwrap();
        let sequence = sync.sequence - 1;
        master.on_sent(EventId { sequence, ..sync }, at, time, &mut out);
        master.on_sent(sync, at, |_| None, &mut out);
        master.on_sent(sync, at, time, &mut out);
        assert_eq!(out.0.len(), 2);
        // One request after the other is answered, each with its own time of sending.
        let answers = usize::from(profile == GPTP);
        for sequence in [1, 2] {
            let ask = bytes(profile, SLAVE, sequence, Body::PeerRequest);
            master.on_message(at, &ask, time, &mut out);
        }
        assert_eq!(out.0.len(), 2 + answers);
        for (sequence, sent) in [(2, 0), (1, answers)] {
            master.on_sent(EventId { kind: 3, sequence }, at, time, &mut out);
            assert_eq!(out.0.len(), 2 + answers + sent);
        }
        assert!(bench.run(5_000).errors().len() > 10);
        let followed = bench.slave.status().followed;
        assert!(followed.is_some_and(|it| it.claims.is_ptp_timescale));
    }
}

/// S-2: the header is checked. A byte of a Follow_Up, its new value, and what is read.
#[test]
#[rustfmt::skip]
fn the_header_is_checked() {
    let whole = bytes(GPTP, MASTER, 7, FollowUp(EPOCH));
    assert_eq!(EventId::of(&whole), None);
    let (read, malformed) = (Ok(FollowUp(EPOCH)), Err(Why::Malformed));
    let table = [
        (1, 0x02, read), (1, 0x12, read), (1, 0x01, malformed), (1, 0x03, malformed),
        (0, 0x08, Err(Why::OtherProfile)), (4, 1, Err(Why::OtherDomain)),
        (0, 0x1D, Ok(Body::Other)),
        (3, 44, read), (3, 43, malformed), (3, 77, read), (3, 78, malformed),
        // Seconds beyond 64 bits of ns; more than 10^9 ns; a correction that is too large.
        (34, 0xFF, malformed), (40, 0x40, malformed), (8, 0x7F, malformed),
    ];
    for (place, byte, expected) in table {
        let mut bytes = [&whole[..], &[0]].concat();
        bytes[9..16].fill(0xFF);
        bytes[place] = byte;
        let body = decode(&bytes, GPTP).map(|it| it.body);
        assert_eq!(body, expected, "byte {place} is {byte:#x}");
    }
    for len in 0..whole.len() {
        assert_eq!(decode(&whole[..len], GPTP), Err(Why::Malformed));
    }
}

#[test]
fn the_state_is_small() {
    let sizes = (size_of::<Slave<Tai>>(), size_of::<Master<Tai>>());
    assert!(sizes.0 <= 768 && sizes.1 <= 192, "{sizes:?} bytes");
}

proptest! {
    /// S-2: no bytes at any time do harm. A message that is read is written as it was.
    #[test]
    fn any_bytes_at_any_time(
        heard: Vec<(u64, Vec<u8>)>,
        is_peer: bool,
        header: [[u8; 9]; 6],
        len: u8,
    ) {
        let profile = BOTH[usize::from(is_peer)];
        let mut slave = Slave::<Arbitrary>::new(SlaveSettings {
            unannounced: Some(Claims::default()),
            ..SlaveSettings::new(SLAVE, profile)
        });
        for (at, content) in heard {
            let mut bytes = [header.as_flattened(), &content].concat();
            let kind = profile.sdo << 4 | content.len() as u8 & 15;
            bytes[..6].copy_from_slice(&[kind, 2, 0, len, 0, 0]);
            let (at, mut out) = (Instant::from_ns(at), Out::default());
            slave.poll(at, &mut out);
            slave.on_message(at, &bytes, &mut out);
            if let Some(event) = out.0.first().and_then(|it| EventId::of(it)) {
                slave.on_sent(event, at, &mut out);
            }
            if let Ok(message) = decode(&bytes, profile) {
                send(profile, &message, 0, &mut out);
                let again = decode(out.0.last().unwrap(), profile).map(|it| it.body);
                prop_assert!(message.body == Body::Other || again == Ok(message.body));
            }
        }
    }
}
