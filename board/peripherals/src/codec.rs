//! Encoding of frames, datagrams, services and trace records in memory that processors share.
//!
//! The unit is the 32-bit word. The words come from another processor, so decoding returns a
//! checked type or an error.

use tandem_board::{CanFrame, CanId, CoreAddress, Instant, Received, TraceRecord};

/// Words of a frame: time (2), id, kind, data (16).
pub const FRAME_WORDS: usize = 20;
/// Largest content of a datagram of the link, in words.
pub const DATAGRAM_MAX_WORDS: usize = 64;
/// Words of a datagram: length, content.
pub const DATAGRAM_WORDS: usize = 1 + DATAGRAM_MAX_WORDS;
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
