//! A controller and an SoC on a network, and datagrams that are forged in the name of any one.

use tandem_board::{Duration, Instant, NetworkAddress, Recipient};
use tandem_topics::endpoints::{INPUTS, OUTPUTS};
use tandem_topics::{
    CanFrame, Controller, Endpoint, GuidPrefix, Outlet, Participant, PowerControl, TopicType as _,
};

const COMMAND: usize = PowerControl::PAYLOAD_LEN;
pub(crate) type Mcu = Controller;
pub(crate) type Soc = Participant<4, 1, 3, COMMAND, { CanFrame::PAYLOAD_LEN }>;

pub(crate) const START: Instant = Instant::from_ns(1_000_000_000);
/// What is forged or damaged is healed within this time, ms: two announcements, or the period in
/// which all are asked for their endpoints.
pub(crate) const HEALS_MS: u64 = 10_000;

pub(crate) const MCU: GuidPrefix = tandem_topics::endpoints::controller_prefix(0, [0; 5]);
pub(crate) const SOC: GuidPrefix = prefix(1, 0);

/// Ids of endpoints: of writers and readers of the participants, and of discovery.
pub(crate) type Id = [u8; 4];
pub(crate) const POWER_WRITER: Id = [0, 0, 1, 3];
pub(crate) const CAN_WRITER: Id = [0, 0, 1, 3];
pub(crate) const CAN_READER: Id = [0, 1, 1, 4];
pub(crate) const PUBLICATIONS_WRITER: Id = [0, 0, 3, 0xC2];
pub(crate) const PUBLICATIONS_READER: Id = [0, 0, 3, 0xC7];
pub(crate) const SUBSCRIPTIONS_WRITER: Id = [0, 0, 4, 0xC2];
const PARTICIPANTS_WRITER: Id = [0, 1, 0, 0xC2];

pub(crate) const fn place(node: usize) -> NetworkAddress {
    NetworkAddress {
        address: [10, 0, 0, node as u8],
        port: 7_410,
    }
}

pub(crate) const fn prefix(node: u8, start: u8) -> GuidPrefix {
    GuidPrefix([1, 2, 3, 4, node, start, 0, 0, 0, 0, 0, 0])
}

/// The messages that a participant sends.
#[derive(Default)]
pub(crate) struct Sent(pub(crate) Vec<(Recipient, Vec<u8>)>);

impl Outlet for Sent {
    fn send(&mut self, to: Recipient, message: &[u8]) {
        self.0.push((to, message.to_vec()));
    }
}

/// A message of a participant.
pub(crate) fn message(from: GuidPrefix, parts: &[Vec<u8>]) -> Vec<u8> {
    let head = [&b"RTPS\x02\x03\0\0"[..], &from.0].concat();
    [head, parts.concat()].concat()
}

fn part(kind: u8, flags: u8, mut body: Vec<u8>) -> Vec<u8> {
    body.resize(body.len().next_multiple_of(4), 0);
    let [low, high] = (body.len() as u16).to_le_bytes();
    [vec![kind, flags | 1, low, high], body].concat()
}

fn words(words: &[u32]) -> Vec<u8> {
    words.iter().flat_map(|word| word.to_le_bytes()).collect()
}

pub(crate) fn data(writer: Id, number: u32, payload: &[u8]) -> Vec<u8> {
    let ids = [&[0, 0, 16, 0, 0, 0, 0, 0], &writer[..]].concat();
    part(
        0x15,
        4,
        [ids, words(&[0, number]), payload.to_vec()].concat(),
    )
}

pub(crate) fn heartbeat(writer: Id, first: u32, last: u32, count: u32) -> Vec<u8> {
    let numbers = words(&[0, first, 0, last, count]);
    part(0x07, 2, [vec![0; 4], writer.to_vec(), numbers].concat())
}

/// Numbers from `base` on: how many, and the first word of their bits.
fn set(base: u32, (len, bits): (u32, u32)) -> Vec<u8> {
    let more = vec![bits; len.div_ceil(32) as usize];
    words(&[&[0, base, len], &more[..]].concat())
}

pub(crate) fn gap(writer: Id, start: u32, base: u32, bits: (u32, u32)) -> Vec<u8> {
    let numbers = [words(&[0, start]), set(base, bits)].concat();
    part(0x08, 0, [vec![0; 4], writer.to_vec(), numbers].concat())
}

pub(crate) fn acknack(reader: Id, writer: Id, base: u32, bits: (u32, u32), count: u32) -> Vec<u8> {
    let ids = [reader, writer].concat();
    part(0x06, 2, [ids, set(base, bits), words(&[count])].concat())
}

fn parameter(id: u16, value: &[u8]) -> Vec<u8> {
    let mut value = value.to_vec();
    value.resize(value.len().next_multiple_of(4), 0);
    let head = words(&[u32::from(id) | (value.len() as u32) << 16]);
    [head, value].concat()
}

fn list(parameters: &[Vec<u8>]) -> Vec<u8> {
    [vec![0, 3, 0, 0], parameters.concat(), words(&[1])].concat()
}

/// The announcement of a participant.
pub(crate) fn participant(name: GuidPrefix, at: NetworkAddress, lease: u32) -> Vec<u8> {
    let address = u32::from_le_bytes(at.address);
    let at = words(&[1, at.port.into(), 0, 0, 0, address]);
    let guid = [&name.0[..], &[0, 0, 1, 0xC1]].concat();
    let parameters = [
        parameter(0x50, &guid),
        parameter(0x31, &at),
        parameter(0x32, &at),
        parameter(0x02, &words(&[lease, 0])),
    ];
    data(PARTICIPANTS_WRITER, 1, &list(&parameters))
}

/// It has ended.
pub(crate) fn ends(name: GuidPrefix) -> Vec<u8> {
    let ids = [&[0, 0, 16, 0, 0, 0, 0, 0], &PARTICIPANTS_WRITER[..]].concat();
    let key = list(&[parameter(0x50, &[&name.0[..], &[0, 0, 1, 0xC1]].concat())]);
    part(0x15, 8, [ids, words(&[0, 1]), key].concat())
}

/// The announcement of an endpoint: its id, and the number of the sample that announces it.
pub(crate) fn endpoint(
    name: GuidPrefix,
    of: Id,
    (id, number): (Id, u32),
    it: &Endpoint,
) -> Vec<u8> {
    let text = |text: &str| {
        let len = words(&[text.len() as u32 + 1]);
        [&len, text.as_bytes(), &[0]].concat()
    };
    let parameters = [
        parameter(0x5A, &[&name.0[..], &id].concat()),
        parameter(0x05, &text(it.topic)),
        parameter(0x07, &text(it.type_name)),
        parameter(0x1A, &words(&[it.qos.reliability as u32, 0, 0])),
        parameter(0x1D, &words(&[it.qos.durability as u32])),
    ];
    data(of, number, &list(&parameters))
}

/// Changes a datagram: the first of all is 0.
type Change = dyn FnMut(usize, &mut Vec<u8>);

/// Node 0 is the controller, node 1 the SoC.
pub(crate) struct World {
    pub(crate) now: Instant,
    pub(crate) mcu: Mcu,
    pub(crate) soc: Soc,
    under_way: Vec<(usize, Vec<u8>)>,
    /// Nothing arrives at this node.
    pub(crate) is_cut: [bool; 2],
    /// What the controller has sent.
    pub(crate) sent: Vec<(Recipient, Vec<u8>)>,
    /// What it has heard, while there is a `change`: that is told how many were before.
    pub(crate) heard: Vec<Vec<u8>>,
    pub(crate) change: Option<Box<Change>>,
    pub(crate) written: u32,
    /// What arrived at each node.
    pub(crate) taken: [Vec<u32>; 2],
}

impl World {
    /// Both have not heard of each other, and do not.
    pub(crate) fn alone() -> Self {
        Self {
            now: START,
            mcu: Mcu::new(MCU, place(0), &OUTPUTS, &INPUTS),
            soc: Soc::new(SOC, place(1), &INPUTS, &OUTPUTS),
            under_way: vec![],
            is_cut: [true; 2],
            sent: vec![],
            heard: vec![],
            change: None,
            written: 0,
            taken: [vec![], vec![]],
        }
    }

    /// Both have found each other, and have sent nothing.
    pub(crate) fn unwritten() -> Self {
        let mut world = Self {
            is_cut: [false; 2],
            ..Self::alone()
        };
        world.run(2_000);
        world
    }

    pub(crate) fn new() -> Self {
        let mut world = Self::unwritten();
        assert!(world.works());
        world
    }

    fn carry(&mut self, from: usize, sent: Sent) {
        for (to, bytes) in &sent.0 {
            let arrives = match *to {
                Recipient::Everyone => true,
                Recipient::One(at) => at == place(1 - from),
            };
            if arrives && !self.is_cut[1 - from] {
                self.under_way.push((1 - from, bytes.clone()));
            }
        }
        if from == 0 {
            self.sent.extend(sent.0);
        }
    }

    /// The controller hears a datagram.
    pub(crate) fn hear(&mut self, bytes: &[u8]) {
        let mut sent = Sent::default();
        self.mcu.hear(self.now, bytes, &mut sent);
        self.carry(0, sent);
    }

    /// It hears these parts in the name of the SoC.
    pub(crate) fn forge(&mut self, parts: &[Vec<u8>]) {
        self.hear(&message(SOC, parts));
    }

    pub(crate) fn run(&mut self, ms: u64) {
        for _ in 0..ms {
            self.step();
        }
    }

    fn step(&mut self) {
        self.now += Duration::from_ms(1);
        for (node, mut bytes) in std::mem::take(&mut self.under_way) {
            if node == 0 {
                if let Some(change) = &mut self.change {
                    change(self.heard.len(), &mut bytes);
                    self.heard.push(bytes.clone());
                }
                self.hear(&bytes);
            } else {
                let mut sent = Sent::default();
                self.soc.hear(self.now, &bytes, &mut sent);
                self.carry(1, sent);
            }
        }
        let mut sent = [Sent::default(), Sent::default()];
        self.mcu.poll(self.now, &mut sent[0]);
        self.soc.poll(self.now, &mut sent[1]);
        for (node, sent) in sent.into_iter().enumerate() {
            self.carry(node, sent);
        }
        let number = |payload: &[u8]| payload.try_into().map_or(0, u32::from_le_bytes);
        while let Some(sample) = self.mcu.take(0) {
            self.taken[0].push(number(sample.payload()));
        }
        while let Some(sample) = self.soc.take(0) {
            self.taken[1].push(number(sample.payload()));
        }
    }

    /// Both publish a sample.
    pub(crate) fn write(&mut self) {
        self.written += 1;
        let sample = self.written.to_le_bytes();
        let mut sent = [Sent::default(), Sent::default()];
        self.mcu.write(0, &sample, &mut sent[0]).unwrap();
        self.soc.write(0, &sample, &mut sent[1]).unwrap();
        for (node, sent) in sent.into_iter().enumerate() {
            self.carry(node, sent);
        }
    }

    /// Publishes for a second. Returns whether both hear the last half of it.
    pub(crate) fn works(&mut self) -> bool {
        for _ in 0..50 {
            self.write();
            self.run(20);
        }
        let last: Vec<u32> = (self.written - 24..=self.written).collect();
        self.taken.iter().all(|taken| taken.ends_with(&last))
    }
}
