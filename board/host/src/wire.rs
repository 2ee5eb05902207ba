//! How frames, services and trace records stand in the rings, as words.
//!
//! What is read here was written by another process: it is decoded into checked types or refused.

use tandem_board::{CanFrame, CanId, CoreId, Instant, Received, SystemId, TraceRecord};

/// Time (2), id, flags, data (16).
pub(crate) const FRAME_WORDS: usize = 20;
/// Most words of a datagram on the data link.
pub(crate) const LINK_MAX_WORDS: usize = 64;
/// Length, words.
pub(crate) const LINK_WORDS: usize = 1 + LINK_MAX_WORDS;
/// Time (2), answer.
pub(crate) const SERVICE_WORDS: usize = 3;
/// Time (2), record (4).
pub(crate) const TRACE_WORDS: usize = 6;

const LEN: u32 = 0x7F;
const FD: u32 = 1 << 8;
const EXTENDED: u32 = 1 << 9;
const ORIGIN_AT: u32 = 16;
const REACHES_AT: u32 = 24;

/// Who sent a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Origin {
    /// A core of the controller.
    Core(SystemId, CoreId),
    /// A node of the vehicle.
    Vehicle,
}

/// A frame in a ring.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Wired {
    pub(crate) received: Received,
    pub(crate) origin: Origin,
    /// Which systems' CAN connections were sound when it was on the bus, by their index.
    pub(crate) reaches: [bool; 2],
}

impl Wired {
    pub(crate) fn encode(&self) -> [u32; FRAME_WORDS] {
        let frame = &self.received.frame;
        let mut words = [0; FRAME_WORDS];
        [words[0], words[1]] = self.received.at.to_words();
        let (id, extended) = match frame.id() {
            CanId::Standard(id) => (u32::from(id), 0),
            CanId::Extended(id) => (id, EXTENDED),
        };
        let origin = match self.origin {
            Origin::Core(system, core) => (system.index() * CoreId::COUNT + core.index()) as u32,
            Origin::Vehicle => 7,
        };
        let reaches = u32::from(self.reaches[0]) | u32::from(self.reaches[1]) << 1;
        words[2] = id;
        words[3] = frame.data().len() as u32
            | if frame.is_fd() { FD } else { 0 }
            | extended
            | origin << ORIGIN_AT
            | reaches << REACHES_AT;
        for (word, bytes) in words[4..].iter_mut().zip(frame.data().chunks(4)) {
            let mut four = [0; 4];
            four[..bytes.len()].copy_from_slice(bytes);
            *word = u32::from_le_bytes(four);
        }
        words
    }

    /// `None` if the words are no frame that a bus can carry.
    pub(crate) fn decode(words: &[u32; FRAME_WORDS]) -> Option<Self> {
        let at = Instant::from_words([words[0], words[1]]);
        let (id, flags) = (words[2], words[3]);
        let id = if flags & EXTENDED == 0 {
            CanId::Standard(u16::try_from(id).ok()?)
        } else {
            CanId::Extended(id)
        };
        let mut bytes = [0; 64];
        for (four, word) in bytes.chunks_exact_mut(4).zip(&words[4..]) {
            four.copy_from_slice(&word.to_le_bytes());
        }
        let data = bytes.get(..(flags & LEN) as usize)?;
        let frame = CanFrame::new(id, flags & FD != 0, data).ok()?;
        let origin = match (flags >> ORIGIN_AT) & 7 {
            7 => Origin::Vehicle,
            n => Origin::Core(
                SystemId::from_index(n as usize / CoreId::COUNT)?,
                CoreId::new((n as usize % CoreId::COUNT) as u8)?,
            ),
        };
        let reaches = flags >> REACHES_AT;
        let reaches = [reaches & 1 != 0, reaches & 2 != 0];
        Some(Self {
            received: Received { frame, at },
            origin,
            reaches,
        })
    }
}

/// A trace record with its time.
pub(crate) fn encode_trace(at: Instant, record: TraceRecord) -> [u32; TRACE_WORDS] {
    let [low, high] = at.to_words();
    let [a, b, c, d] = record;
    [low, high, a, b, c, d]
}

pub(crate) fn decode_trace(words: [u32; TRACE_WORDS]) -> (Instant, TraceRecord) {
    let [low, high, a, b, c, d] = words;
    (Instant::from_words([low, high]), [a, b, c, d])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wired(id: CanId, fd: bool, length: u8) -> Wired {
        let data: Vec<u8> = (1..=length).collect();
        Wired {
            received: Received {
                frame: CanFrame::new(id, fd, &data).unwrap(),
                at: Instant::from_ns(0x1234_5678_9ABC_DEF0),
            },
            origin: Origin::Core(SystemId::B, CoreId::PLANNING),
            reaches: [false, true],
        }
    }

    #[test]
    fn every_frame_comes_back_as_it_was() {
        for id in [
            CanId::Standard(0),
            CanId::Standard(0x7FF),
            CanId::Extended(0x1FFF_FFFF),
        ] {
            for (fd, length) in [(false, 0), (false, 8), (true, 5), (true, 12), (true, 64)] {
                let frame = wired(id, fd, length);
                assert_eq!(Wired::decode(&frame.encode()), Some(frame));
            }
        }
    }

    #[test]
    fn every_origin_comes_back() {
        for system in SystemId::ALL {
            for core in CoreId::ALL {
                let origin = Origin::Core(system, core);
                let frame = Wired {
                    origin,
                    ..wired(CanId::Standard(1), false, 1)
                };
                assert_eq!(Wired::decode(&frame.encode()).unwrap().origin, origin);
            }
        }
    }

    #[test]
    fn what_is_no_frame_is_refused() {
        let good = wired(CanId::Standard(1), false, 8).encode();
        let with = |index: usize, value: u32| {
            let mut words = good;
            words[index] = value;
            Wired::decode(&words)
        };
        assert_eq!(with(2, 0x800), None, "id");
        assert_eq!(with(2, 0x1_0001), None, "id");
        assert_eq!(with(2, u32::MAX), None, "id");
        assert_eq!(with(3, 9), None, "classic frame of 9 bytes");
        assert_eq!(with(3, FD | 9), None, "no FD length");
        assert_eq!(with(3, FD | 65), None, "too long");
        assert_eq!(with(3, 6 << ORIGIN_AT), None, "no such core");
    }

    proptest::proptest! {
        #[test]
        fn any_words_decode_without_panic(words: [u32; FRAME_WORDS]) {
            if let Some(frame) = Wired::decode(&words) {
                proptest::prop_assert_eq!(Wired::decode(&frame.encode()), Some(frame));
            }
        }
    }
}
