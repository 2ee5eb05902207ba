//! Encoding of frames, datagrams, services and trace records in memory that processors share.
//!
//! The unit is the 32-bit word. The words come from another processor, so decoding returns a
//! checked type or an error.

use tandem_board::{
    CanFrame, CanId, Channel, CoreAddress, Instant, NetworkAddress, Received, Recipient,
    TraceRecord,
};

/// Words of a frame: time (2), id, kind, data (16).
pub const FRAME_WORDS: usize = 20;
/// Largest content of a datagram of the link, in words.
pub const DATAGRAM_MAX_WORDS: usize = 64;
/// Words of a datagram: length, content.
pub const DATAGRAM_WORDS: usize = 1 + DATAGRAM_MAX_WORDS;
/// Largest content of a datagram of the Ethernet, in bytes.
pub const PACKET_MAX_BYTES: usize = 1_472;
/// Words of a datagram of the Ethernet at most: kind, address, port, time (2), content.
pub const PACKET_WORDS: usize = PACKET_HEAD_WORDS + PACKET_MAX_BYTES / 4;
const PACKET_HEAD_WORDS: usize = 5;
/// Words of a watchdog service: time (2), answer.
pub const SERVICE_WORDS: usize = 3;
/// Words of a trace record: time (2), record (4).
pub const TRACE_WORDS: usize = 6;

/// Fields of a frame's kind.
const LEN: u32 = 0x7F;
const FD: u32 = 1 << 8;
const EXTENDED: u32 = 1 << 9;
const SENDER_AT: u32 = 16;
const SENDER: u32 = 0x7 << SENDER_AT;
const REACH_AT: u32 = 24;
/// The code of a sender that is not a core.
const VEHICLE: u32 = 7;

/// The sender of a frame on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sender {
    /// A core of the controller.
    Core(CoreAddress),
    /// A node of the vehicle.
    Vehicle,
}

/// A set of cores, one bit for each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Reach(pub u8);

impl Reach {
    /// No core.
    pub const NONE: Self = Self(0);
    /// Every core of both systems.
    pub const ALL: Self = Self((1 << CoreAddress::COUNT) - 1);

    /// Returns whether this core is in the set.
    #[must_use]
    pub const fn has(self, core: CoreAddress) -> bool {
        self.0 >> core.index() & 1 == 1
    }

    /// Adds a core.
    pub const fn add(&mut self, core: CoreAddress) {
        self.0 |= 1 << core.index();
    }
}

/// A frame on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BusFrame {
    /// The frame, and the time at which it was on the bus.
    pub received: Received,
    /// The sender.
    pub sender: Sender,
    /// The cores that receive it.
    pub reach: Reach,
}

impl BusFrame {
    /// Encodes the frame as words.
    #[must_use]
    pub fn encode(&self) -> [u32; FRAME_WORDS] {
        let frame = &self.received.frame;
        let mut words = [0; FRAME_WORDS];
        let (id, extended) = match frame.id() {
            CanId::Standard(id) => (u32::from(id), 0),
            CanId::Extended(id) => (id, EXTENDED),
        };
        let fd = if frame.is_fd() { FD } else { 0 };
        let reach = u32::from(self.reach.0);
        words[2] = id;
        words[3] = frame.data().len() as u32 | fd | extended | reach << REACH_AT;
        set_time(&mut words, self.received.at);
        set_sender(&mut words, self.sender);
        for (word, bytes) in words[4..].iter_mut().zip(frame.data().chunks(4)) {
            let mut four = [0; 4];
            four[..bytes.len()].copy_from_slice(bytes);
            *word = u32::from_le_bytes(four);
        }
        words
    }

    /// The inverse of [`BusFrame::encode`]; `None` if a bus cannot carry such a frame.
    #[must_use]
    pub fn decode(words: &[u32; FRAME_WORDS]) -> Option<Self> {
        let (id, kind) = (words[2], words[3]);
        let id = match kind & EXTENDED {
            0 => CanId::Standard(u16::try_from(id).ok()?),
            _ => CanId::Extended(id),
        };
        let mut bytes = [0; 64];
        for (four, word) in bytes.chunks_exact_mut(4).zip(&words[4..]) {
            four.copy_from_slice(&word.to_le_bytes());
        }
        let data = bytes.get(..(kind & LEN) as usize)?;
        let sender = match (kind & SENDER) >> SENDER_AT {
            VEHICLE => Sender::Vehicle,
            index => Sender::Core(CoreAddress::from_index(index as usize)?),
        };
        Some(Self {
            received: Received {
                frame: CanFrame::new(id, kind & FD != 0, data).ok()?,
                at: Instant::from_words([words[0], words[1]]),
            },
            sender,
            reach: Reach((kind >> REACH_AT) as u8 & Reach::ALL.0),
        })
    }
}

/// Writes the time at which an encoded frame is on the bus into the frame.
pub const fn set_time(words: &mut [u32; FRAME_WORDS], at: Instant) {
    [words[0], words[1]] = at.to_words();
}

/// Writes the sender into an encoded frame.
pub const fn set_sender(words: &mut [u32; FRAME_WORDS], sender: Sender) {
    let index = match sender {
        Sender::Core(address) => address.index() as u32,
        Sender::Vehicle => VEHICLE,
    };
    words[3] = words[3] & !SENDER | index << SENDER_AT;
}

/// Encodes a datagram as words.
///
/// # Panics
/// If it is longer than [`DATAGRAM_MAX_WORDS`].
#[must_use]
pub fn encode_datagram(content: &[u32]) -> [u32; DATAGRAM_WORDS] {
    assert!(
        content.len() <= DATAGRAM_MAX_WORDS,
        "a datagram has at most {DATAGRAM_MAX_WORDS} words, not {}",
        content.len()
    );
    let mut words = [0; DATAGRAM_WORDS];
    words[0] = content.len() as u32;
    words[1..=content.len()].copy_from_slice(content);
    words
}

/// Copies the content of an encoded datagram and returns its length in words. Cuts off content that
/// does not fit into `into`.
pub fn decode_datagram(words: &[u32; DATAGRAM_WORDS], into: &mut [u32]) -> usize {
    let len = (words[0] as usize).min(DATAGRAM_MAX_WORDS).min(into.len());
    into[..len].copy_from_slice(&words[1..=len]);
    len
}

/// A datagram of the Ethernet without its content.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PacketHead {
    /// The channel.
    pub channel: Channel,
    /// Who gets a datagram that is sent, or who has sent one that was received.
    pub peer: Recipient,
    /// When it was sent or received.
    pub at: Instant,
}

/// In the kind of a datagram of the Ethernet, whose lower half is its length in bytes: the peer is
/// everyone.
const EVERYONE: u32 = 1 << 16;
const CHANNEL_AT: u32 = 24;

impl PacketHead {
    /// Encodes the datagram with this content as words, and returns their number.
    ///
    /// # Panics
    /// If the content is longer than [`PACKET_MAX_BYTES`].
    pub fn encode(&self, content: &[u8], into: &mut [u32; PACKET_WORDS]) -> usize {
        let len = content.len();
        assert!(
            len <= PACKET_MAX_BYTES,
            "a datagram has at most {PACKET_MAX_BYTES} bytes, not {len}"
        );
        let (at, everyone) = match self.peer {
            Recipient::Everyone => (NetworkAddress::default(), EVERYONE),
            Recipient::One(at) => (at, 0),
        };
        into[0] = len as u32 | everyone | (self.channel.index() as u32) << CHANNEL_AT;
        into[1] = u32::from_le_bytes(at.address);
        into[2] = at.port.into();
        [into[3], into[4]] = self.at.to_words();
        for (word, bytes) in into[PACKET_HEAD_WORDS..].iter_mut().zip(content.chunks(4)) {
            let mut four = [0; 4];
            four[..bytes.len()].copy_from_slice(bytes);
            *word = u32::from_le_bytes(four);
        }
        packet_words(into[0])
    }

    /// Decodes a datagram, and returns its head and how many bytes of its content were copied into
    /// `into`: what does not fit is cut off. `None` if the words are no datagram.
    #[must_use]
    pub fn decode(words: &[u32], into: &mut [u8]) -> Option<(Self, usize)> {
        let (head, content) = words.split_first_chunk::<PACKET_HEAD_WORDS>()?;
        let [kind, address, port, low, high] = *head;
        let len = (kind & 0xFFFF) as usize;
        if len > PACKET_MAX_BYTES || content.len() < len.div_ceil(4) {
            return None;
        }
        let one = NetworkAddress {
            address: address.to_le_bytes(),
            port: u16::try_from(port).ok()?,
        };
        let peer = match kind & EVERYONE {
            0 => Recipient::One(one),
            _ => Recipient::Everyone,
        };
        let len = len.min(into.len());
        for (bytes, word) in into[..len].chunks_mut(4).zip(content) {
            bytes.copy_from_slice(&word.to_le_bytes()[..bytes.len()]);
        }
        let head = Self {
            channel: Channel::from_index((kind >> CHANNEL_AT) as usize)?,
            peer,
            at: Instant::from_words([low, high]),
        };
        Some((head, len))
    }
}

/// Returns the number of words of an encoded datagram of the Ethernet, from its first word; at most
/// [`PACKET_WORDS`].
#[must_use]
pub fn packet_words(first: u32) -> usize {
    let bytes = (first & 0xFFFF) as usize;
    PACKET_HEAD_WORDS + bytes.min(PACKET_MAX_BYTES).div_ceil(4)
}

/// Encodes a service of the watchdog as words: its time and its answer.
#[must_use]
pub fn encode_service(at: Instant, answer: u8) -> [u32; SERVICE_WORDS] {
    let [low, high] = at.to_words();
    [low, high, answer.into()]
}

/// The inverse of [`encode_service`]; the answer is `None` if the word is not a byte.
#[must_use]
pub fn decode_service([low, high, answer]: [u32; SERVICE_WORDS]) -> (Instant, Option<u8>) {
    let at = Instant::from_words([low, high]);
    (at, u8::try_from(answer).ok())
}

/// Encodes a trace record and its time as words.
#[must_use]
pub const fn encode_trace(at: Instant, record: TraceRecord) -> [u32; TRACE_WORDS] {
    let [low, high] = at.to_words();
    let [a, b, c, d] = record;
    [low, high, a, b, c, d]
}

/// The inverse of [`encode_trace`].
#[must_use]
pub const fn decode_trace(words: [u32; TRACE_WORDS]) -> (Instant, TraceRecord) {
    let [low, high, a, b, c, d] = words;
    (Instant::from_words([low, high]), [a, b, c, d])
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    fn frame(id: CanId, fd: bool, len: u8) -> BusFrame {
        let data: Vec<u8> = (1..=len).collect();
        BusFrame {
            received: Received {
                frame: CanFrame::new(id, fd, &data).unwrap(),
                at: Instant::from_ns(0x1234_5678_9ABC_DEF0),
            },
            sender: Sender::Core(CoreAddress::B2),
            reach: Reach(0b111_000),
        }
    }

    #[test]
    fn every_frame_comes_back_as_it_was() {
        for id in [
            CanId::Standard(0),
            CanId::Standard(0x7FF),
            CanId::Extended(0x1FFF_FFFF),
        ] {
            for (fd, len) in [(false, 0), (false, 8), (true, 5), (true, 12), (true, 64)] {
                let frame = frame(id, fd, len);
                assert_eq!(BusFrame::decode(&frame.encode()), Some(frame));
            }
        }
    }

    #[test]
    fn the_bus_knows_time_and_sender() {
        let senders = CoreAddress::ALL.map(Sender::Core);
        for sender in senders.into_iter().chain([Sender::Vehicle]) {
            let sent = frame(CanId::Standard(1), true, 12);
            let mut words = sent.encode();
            let at = Instant::from_ns(5 << 32);
            set_time(&mut words, at);
            set_sender(&mut words, sender);
            let frame = sent.received.frame;
            let expected = BusFrame {
                received: Received { frame, at },
                sender,
                ..sent
            };
            assert_eq!(BusFrame::decode(&words), Some(expected));
        }
    }

    #[test]
    fn what_is_no_frame_is_refused() {
        let good = frame(CanId::Standard(1), false, 8).encode();
        let with = |index: usize, value: u32| {
            let mut words = good;
            words[index] = value;
            BusFrame::decode(&words)
        };
        assert_eq!(with(2, 0x800), None, "id");
        assert_eq!(with(2, 0x1_0001), None, "id");
        assert_eq!(with(2, u32::MAX), None, "id");
        assert_eq!(with(3, 9), None, "classic frame of 9 bytes");
        assert_eq!(with(3, FD | 9), None, "no FD length");
        assert_eq!(with(3, FD | 65), None, "too long");
        assert_eq!(with(3, 6 << SENDER_AT), None, "no such core");
    }

    #[test]
    fn a_datagram_has_the_length_it_says_and_no_more_than_there_is() {
        let mut into = [0; 2 * DATAGRAM_MAX_WORDS];
        let words = encode_datagram(&[7, 8, 9]);
        assert_eq!(decode_datagram(&words, &mut into), 3);
        assert_eq!(into[..4], [7, 8, 9, 0]);
        assert_eq!(decode_datagram(&words, &mut [0; 2]), 2, "cut off");
        let mut lies = words;
        lies[0] = u32::MAX;
        assert_eq!(decode_datagram(&lies, &mut into), DATAGRAM_MAX_WORDS);
        assert_eq!(decode_datagram(&encode_datagram(&[]), &mut into), 0);
    }

    #[test]
    fn a_packet_comes_back_as_it_was_and_no_other_words_are_one() {
        let content: Vec<u8> = (0..PACKET_MAX_BYTES).map(|index| index as u8).collect();
        let one = Recipient::One(NetworkAddress {
            address: [10, 0, 0, 1],
            port: 65_535,
        });
        for (channel, peer) in [(Channel::Topics, one), (Channel::Time, Recipient::Everyone)] {
            for len in [0, 1, 4, 7, PACKET_MAX_BYTES] {
                let at = Instant::from_ns(0x1234_5678_9ABC_DEF0);
                let head = PacketHead { channel, peer, at };
                let mut words = [0; PACKET_WORDS];
                let count = head.encode(&content[..len], &mut words);
                assert_eq!(count, packet_words(words[0]));
                let mut into = [0; PACKET_MAX_BYTES];
                let decoded = PacketHead::decode(&words[..count], &mut into);
                assert_eq!(decoded, Some((head, len)));
                assert_eq!(into[..len], content[..len]);
                let short = PacketHead::decode(&words[..count], &mut [0; 3]);
                assert_eq!(short, Some((head, len.min(3))), "cut off");
                assert_eq!(PacketHead::decode(&words[..count - 1], &mut into), None);
                for (index, wrong) in [(0, 1_473), (0, 2 << CHANNEL_AT), (2, 65_536)] {
                    let mut words = words;
                    words[index] = wrong;
                    assert_eq!(PacketHead::decode(&words, &mut into), None);
                }
            }
        }
    }

    #[test]
    fn services_and_records_come_back_as_they_were() {
        let at = Instant::from_ns(0x1_2345_6789);
        assert_eq!(decode_service(encode_service(at, 0xA5)), (at, Some(0xA5)));
        assert_eq!(decode_service([0, 0, 256]), (Instant::ORIGIN, None));
        let record = [1, 2, 3, u32::MAX];
        assert_eq!(decode_trace(encode_trace(at, record)), (at, record));
    }

    proptest::proptest! {
        #[test]
        fn any_words_decode_without_panic(words: [u32; FRAME_WORDS]) {
            if let Some(frame) = BusFrame::decode(&words) {
                proptest::prop_assert_eq!(BusFrame::decode(&frame.encode()), Some(frame));
            }
        }
    }
}
