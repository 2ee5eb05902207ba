//! Fuzz target for messages of RTPS. The second reader is the one of dust_dds.

use std::sync::LazyLock;

use dust_dds::rtps_messages::overall_structure::{RtpsMessageRead, RtpsSubmessageReadKind};
use tandem_board::{Instant, NetworkAddress, Recipient};
use tandem_topics::{
    CanFrame, Durability, Endpoint, EntityId, GuidPrefix, Outlet, Participant, Qos, Reliability,
    TopicType,
};

/// The name under which the datagrams of the corpus were heard.
const OWN: GuidPrefix = GuidPrefix(*b"tandem-fuzz!");
const RELIABLE: Qos = Qos {
    reliability: Reliability::Reliable,
    durability: Durability::TransientLocal,
    depth: 3,
};
const CAN: Endpoint = Endpoint {
    topic: "vehicle_can",
    type_name: CanFrame::TYPE_NAME,
    qos: RELIABLE,
};
static OUTPUTS: [Endpoint; 1] = [CAN];
/// The first takes what arrives, so that a simple rule says what it takes. The other one repairs
/// losses.
static INPUTS: [Endpoint; 2] = [
    Endpoint {
        qos: Qos {
            reliability: Reliability::BestEffort,
            durability: Durability::Volatile,
            depth: 32,
        },
        ..CAN
    },
    CAN,
];
const TAKES_ALL: usize = 0;
/// The longest sample that a reader has room for, bytes.
const ROOM: usize = 255;
const NOW: Instant = Instant::from_ns(5_000_000_000);

/// Kind, flags and body.
type Part<'m> = (u8, u8, &'m [u8]);

/// The kind of a part that asks for fragments.
const NACK_FRAGMENTS: u8 = 0x12;

type Heard = Participant<1, 2, 32, ROOM, ROOM>;

/// Asserts that each message that leaves is one that the second reader reads to its end.
struct Checked;

impl Outlet for Checked {
    fn send(&mut self, _: Recipient, message: &[u8]) {
        let read = RtpsMessageRead::try_from(message).expect("a message");
        let parts = read.submessages();
        let (chain, is_whole) = chain(message);
        assert!(is_whole && parts.len() == chain.len());
        for part in parts {
            if let RtpsSubmessageReadKind::AckNack(acknack) = part {
                assert!(acknack.reader_sn_state().base() > 0);
            }
        }
    }
}

/// A participant that knows the participants of the corpus.
static KNOWS_ALL: LazyLock<Heard> = LazyLock::new(|| {
    let at = NetworkAddress {
        address: [127, 0, 0, 1],
        port: 7_410,
    };
    let mut participant = Heard::new(OWN, at, &OUTPUTS, &INPUTS);
    let target = crate::target("rtps").expect("this target");
    for (path, datagram) in target.corpus().expect("its corpus") {
        if path.display().to_string().contains("announcement") {
            participant.hear(NOW, &datagram, &mut Checked);
        }
    }
    assert_eq!(participant.readers_of(0), 1, "the reader of the corpus");
    participant
});

/// Returns the parts of a message, and whether the last one is whole. A
/// length of 0 reaches to the end, except in parts that may be empty.
fn chain(message: &[u8]) -> (Vec<Part<'_>>, bool) {
    chain_of(message, |kind| !matches!(kind, 0x01 | 0x09))
}

/// `is_open`: a length of 0 reaches to the end in parts of this kind.
fn chain_of(message: &[u8], is_open: impl Fn(u8) -> bool) -> (Vec<Part<'_>>, bool) {
    let mut rest = message.get(20..).unwrap_or_default();
    let mut parts = Vec::new();
    while let Some((&[kind, flags, low, high], behind)) = rest.split_first_chunk() {
        let len = match flags & 1 {
            1 => u16::from_le_bytes([low, high]),
            _ => u16::from_be_bytes([low, high]),
        };
        let len = match len {
            0 if is_open(kind) => behind.len(),
            len => len.into(),
        };
        let (body, behind) = behind.split_at_checked(len).unwrap_or((behind, &[]));
        parts.push((kind, flags, body));
        if body.len() < len {
            return (parts, false);
        }
        rest = behind;
    }
    (parts, rest.is_empty())
}

/// Returns whether all parts are ones whose content both readers judge alike: samples, times,
/// destinations and padding, each as long as its fixed members. RTPS 2.5, 8.3.4.1: what follows an
/// invalid part is invalid; the second reader goes on behind it.
fn is_plain(message: &[u8], parts: &[RtpsSubmessageReadKind]) -> bool {
    let (chain, is_whole) = chain(message);
    let is_long_enough = |&(kind, flags, body): &Part<'_>| match (kind, body) {
        (0x01, _) => true,
        (0x09, _) => body.len() >= if flags & 2 == 0 { 8 } else { 0 },
        (0x0E, _) => body.len() >= 12,
        // The payload does not begin within the fixed members; the number has 32 bits.
        (0x15, [_, _, a, b, _, _, _, _, _, _, _, _, number @ ..]) => {
            let is_little = flags & 1 == 1;
            let (begin, number) = match (is_little, number) {
                (true, &[0, 0, 0, 0, c, d, e, f, ..]) => ([*b, *a], [f, e, d, c]),
                (false, &[0, 0, 0, 0, c, d, e, f, ..]) => ([*a, *b], [c, d, e, f]),
                _ => return false,
            };
            let number = u32::from_be_bytes(number);
            u16::from_be_bytes(begin) >= 16 && (1..u32::MAX).contains(&number)
        }
        _ => false,
    };
    let is_of_version_2 = message[4] == 2;
    is_of_version_2 && is_whole && chain.len() == parts.len() && chain.iter().all(is_long_enough)
}

/// Returns whether the second reader may panic: it does so at a set of fragments that is too long.
/// With a length of 0, only its samples reach to the end, and only if they are right.
fn may_break_the_second(message: &[u8]) -> bool {
    let (parts, _) = chain_of(message, |kind| matches!(kind, 0x15 | 0x16));
    let is_open = |&(kind, _, body): &Part<'_>| {
        let begin = message.len() - body.len();
        matches!(kind, 0x15 | 0x16) && message.get(begin - 2..begin) == Some(&[0, 0])
    };
    let is_set = |byte: &u8| *byte == NACK_FRAGMENTS;
    let has_open = parts.last().is_some_and(is_open);
    parts.iter().any(|part| is_set(&part.0)) || has_open && message.iter().skip(20).any(is_set)
}

/// Returns the samples that the second reader finds for the reader that takes all, with their
/// numbers.
fn found(from: GuidPrefix, parts: &[RtpsSubmessageReadKind]) -> Vec<(i64, &[u8])> {
    let writer = KNOWS_ALL.writers_of(TAKES_ALL).next();
    let (mut is_ours, mut samples) = (true, Vec::new());
    for part in parts {
        match part {
            RtpsSubmessageReadKind::InfoDestination(to) => {
                is_ours = [OWN.0, [0; 12]].contains(&to.guid_prefix());
            }
            RtpsSubmessageReadKind::Data(data) if is_ours && data._data_flag() => {
                let id = |id: dust_dds::transport::types::EntityId| {
                    let [a, b, c] = id.entity_key();
                    EntityId([a, b, c, id.entity_kind()])
                };
                let is_for = [EntityId([0; 4]), EntityId([0, 1, 1, 4])];
                let is_from =
                    writer.is_some_and(|it| it.prefix == from && it.entity == id(data.writer_id()));
                if is_from && is_for.contains(&id(data.reader_id())) {
                    samples.push((data.writer_sn(), data.serialized_payload().as_ref()));
                }
            }
            _ => {}
        }
    }
    samples
}

/// Returns those of these samples that are taken: each is newer than the last one. A much older one
/// shows that numbers of before were wrong; what is not below it is dropped.
fn due<'m>(samples: &[(i64, &'m [u8])]) -> Vec<&'m [u8]> {
    let (mut last, mut due) = (0, Vec::new());
    for &(number, sample) in samples {
        let begins_again = last + 1 > number + 32;
        if begins_again {
            due.retain(|(before, _)| *before < number);
        }
        if number > last || begins_again {
            last = number;
            due.extend((sample.len() <= ROOM).then_some((number, sample)));
        }
    }
    due.into_iter().map(|(_, sample)| sample).collect()
}

/// Passes a datagram to a participant that knows its sender. What it takes must be what the second
/// reader finds, and what it answers must be messages for that one.
///
/// # Panics
/// If they differ.
pub(crate) fn rtps(datagram: &[u8]) -> bool {
    let mut participant = KNOWS_ALL.clone();
    participant.hear(NOW, datagram, &mut Checked);
    let is_rtps = participant.foreign == 0;
    participant.poll(NOW + tandem_board::Duration::from_ms(300), &mut Checked);
    let taken: Vec<Vec<u8>> = std::iter::from_fn(|| participant.take(TAKES_ALL))
        .map(|sample| sample.payload().to_vec())
        .collect();
    if may_break_the_second(datagram) {
        return is_rtps;
    }
    let Ok(read) = RtpsMessageRead::try_from(datagram) else {
        assert!(taken.is_empty());
        return false;
    };
    let parts = read.submessages();
    let found = found(GuidPrefix(read.header().guid_prefix()), parts);
    if is_plain(datagram, parts) {
        assert_eq!(taken, due(&found));
    }
    for sample in &taken {
        let is_found = found.iter().any(|(_, found)| found == sample);
        assert!(is_found, "not in the message: {sample:?}");
    }
    is_rtps
}
