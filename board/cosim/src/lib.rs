//! The protocol between an emulated machine and the world outside it, as words.
//!
//! Once in each period of virtual time, the machine writes a [`Report`], stops its clock and waits
//! for the answer. Both messages are a fixed header followed by [`Item`]s. The host's side is
//! `tandem-board-qemu`; the machine's side is the emulated peripherals of a bare-metal board.
//!
//! ```text
//! machine → world   MAGIC, words, now (2), lamps, powered, trace records lost, items …
//! world → machine   MAGIC, words, items …
//! ```
#![no_std]
#![forbid(unsafe_code)]

use tandem_board::{
    Channel, CoreAddress, HardwareFault, HardwareFaults, Instant, NetworkAddress, RoleLamp,
    SystemId,
};
use tandem_peripherals::codec::{
    DATAGRAM_MAX_WORDS, DATAGRAM_WORDS, FRAME_WORDS, PACKET_WORDS, TRACE_WORDS, encode_datagram,
    packet_words,
};

/// Virtual time from one exchange to the next, ns.
pub const PERIOD_NS: u64 = 1_000_000;
/// Maximum length of a message, in words: it fits into a pipe, so a write never blocks.
pub const MAX_WORDS: usize = 8_192;
/// Maximum length of an item, in words.
pub const ITEM_WORDS: usize = 1 + DATAGRAM_WORDS;

/// "TXCH", little-endian.
pub const MAGIC: u32 = 0x4843_5854;
/// Index of the first item of a report.
pub const REPORT_WORDS: usize = 7;
/// Index of the first item of an answer.
pub const ANSWER_WORDS: usize = 2;

/// An event or a command in a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Item {
    /// A frame on the bus: the words of a [`tandem_peripherals::codec::BusFrame`].
    Frame([u32; FRAME_WORDS]),
    /// A core's trace record, with its time.
    Trace {
        /// The core.
        from: CoreAddress,
        /// The words that [`tandem_peripherals::codec::encode_trace`] returns.
        words: [u32; TRACE_WORDS],
    },
    /// Edges on a line to a system.
    Edges {
        /// The receiving system.
        to: SystemId,
        /// The line's index ([`tandem_board::Line::index`]).
        line: usize,
        /// 0 rising, 1 falling.
        edge: usize,
        /// Number of edges.
        count: u32,
        /// When the last one was sent. Only the time line has this time.
        at: Instant,
    },
    /// A datagram on the link to a system.
    Datagram {
        /// The receiving system.
        to: SystemId,
        /// The words that [`tandem_peripherals::codec::encode_datagram`] returns.
        words: [u32; DATAGRAM_WORDS],
    },
    /// The level line of a system that runs outside the machine.
    Level {
        /// The system.
        of: SystemId,
        /// Whether the line is high.
        high: bool,
    },
    /// The battery feed of a system that runs in the machine.
    Feed {
        /// The system.
        of: SystemId,
        /// Whether the battery is connected.
        on: bool,
    },
    /// A hardware fault of a system that runs in the machine.
    Fault {
        /// The system.
        of: SystemId,
        /// The fault.
        fault: HardwareFault,
        /// Whether the fault is injected; otherwise it is repaired.
        present: bool,
    },
    /// The run has ended: the machine exits.
    End,
    /// Core 0 of a system in the machine takes an exception.
    Crash {
        /// The system.
        of: SystemId,
    },
    /// A core of a system in the machine overwrites the whole LMU.
    Scribble {
        /// The system.
        of: SystemId,
        /// Determines the words.
        seed: u32,
    },
    /// Core 0 of a system in the machine stops until the next reset.
    Hang {
        /// The system.
        of: SystemId,
    },
    /// Cuts or restores the level line of a system in the machine.
    CutLevel {
        /// The system.
        of: SystemId,
        /// Whether the line is cut; otherwise it is restored.
        cut: bool,
    },
    /// Delays the next item.
    Later {
        /// The delay, less than [`PERIOD_NS`].
        us: u32,
    },
    /// Connects a channel of a system in the machine to the network.
    Connect {
        /// The system.
        of: SystemId,
        /// The channel.
        channel: Channel,
        /// Where the system hears.
        at: NetworkAddress,
    },
    /// A part of a datagram of the Ethernet that a system in the machine has sent or receives. The
    /// other parts follow: see [`packet_parts`].
    Packet {
        /// The system.
        of: SystemId,
        /// Whether this is the first part.
        is_first: bool,
        /// The words that [`tandem_peripherals::codec::encode_datagram`] returns.
        words: [u32; DATAGRAM_WORDS],
    },
}

/// Splits a datagram of the Ethernet, as words of a [`tandem_peripherals::codec::PacketHead`].
pub fn packet_parts(of: SystemId, words: &[u32]) -> impl Iterator<Item = Item> {
    let parts = words.chunks(DATAGRAM_MAX_WORDS).enumerate();
    parts.map(move |(index, part)| Item::Packet {
        of,
        is_first: index == 0,
        words: encode_datagram(part),
    })
}

/// Items that a datagram of the Ethernet consists of, at most.
pub const PACKET_PARTS: usize = PACKET_WORDS.div_ceil(DATAGRAM_MAX_WORDS);

/// Puts a datagram of the Ethernet together.
#[derive(Clone, Debug)]
pub struct Assembly {
    words: [u32; PACKET_WORDS],
    len: usize,
}

impl Default for Assembly {
    fn default() -> Self {
        Self::new()
    }
}

impl Assembly {
    /// Makes one without parts.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            words: [0; PACKET_WORDS],
            len: 0,
        }
    }

    /// Adds a part, the words of [`Item::Packet`]. Returns the datagram when it is whole. One that
    /// lacks a part is dropped.
    pub fn add(&mut self, is_first: bool, part: &[u32; DATAGRAM_WORDS]) -> Option<&[u32]> {
        if is_first {
            self.len = 0;
        } else if self.len == 0 {
            return None;
        }
        let part = part[1..].get(..part[0] as usize)?;
        let Some(room) = self.words[self.len..].get_mut(..part.len()) else {
            self.len = 0;
            return None;
        };
        room.copy_from_slice(part);
        self.len += part.len();
        let whole = packet_words(self.words[0]);
        if self.len < whole {
            return None;
        }
        let is_whole = core::mem::take(&mut self.len) == whole;
        is_whole.then_some(&self.words[..whole])
    }
}

/// The message cannot be decoded: the other side has another version.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Malformed;

impl Item {
    /// Writes the item; returns the number of words, at most [`ITEM_WORDS`].
    pub fn encode(&self, into: &mut [u32; ITEM_WORDS]) -> usize {
        let head = |kind: u32, a: usize, b: usize, c: usize| {
            kind | (a as u32) << 8 | (b as u32) << 16 | (c as u32) << 24
        };
        let mut put = |head: u32, words: &[u32]| {
            into[0] = head;
            into[1..=words.len()].copy_from_slice(words);
            1 + words.len()
        };
        match self {
            Self::Frame(words) => put(head(1, 0, 0, 0), words),
            Self::Trace { from, words } => put(head(2, from.index(), 0, 0), words),
            Self::Edges {
                to,
                line,
                edge,
                count,
                at,
            } => {
                let [low, high] = at.to_words();
                put(head(3, to.index(), *line, *edge), &[*count, low, high])
            }
            Self::Datagram { to, words } => {
                let len = words[0] as usize;
                put(head(4, to.index(), len, 0), &words[1..=len])
            }
            Self::Level { of, high } => put(head(5, of.index(), usize::from(*high), 0), &[]),
            Self::Feed { of, on } => put(head(6, of.index(), usize::from(*on), 0), &[]),
            Self::End => put(head(7, 0, 0, 0), &[]),
            Self::Fault { of, fault, present } => {
                let fault = HardwareFaults::bit(*fault).trailing_zeros() as usize;
                put(head(8, of.index(), fault, usize::from(*present)), &[])
            }
            Self::Crash { of } => put(head(9, of.index(), 0, 0), &[]),
            Self::Scribble { of, seed } => put(head(10, of.index(), 0, 0), &[*seed]),
            Self::Hang { of } => put(head(11, of.index(), 0, 0), &[]),
            Self::CutLevel { of, cut } => put(head(12, of.index(), usize::from(*cut), 0), &[]),
            Self::Later { us } => put(head(13, 0, 0, 0), &[*us]),
            Self::Connect { of, channel, at } => {
                let address = u32::from_le_bytes(at.address);
                let head = head(14, of.index(), channel.index(), 0);
                put(head, &[address, at.port.into()])
            }
            Self::Packet {
                of,
                is_first,
                words,
            } => {
                let len = words[0] as usize;
                let head = head(15, of.index(), len, usize::from(*is_first));
                put(head, &words[1..=len])
            }
        }
    }

    /// Decodes the item at the front of `words` and removes it.
    ///
    /// # Errors
    /// [`Malformed`] if `words` does not start with an item.
    pub fn decode(words: &mut &[u32]) -> Result<Self, Malformed> {
        let (&head, mut rest) = words.split_first().ok_or(Malformed)?;
        let [kind, a, b, c] = head.to_le_bytes().map(usize::from);
        let system = SystemId::from_index(a).ok_or(Malformed);
        let item = match kind {
            1 => Self::Frame(take(&mut rest)?),
            2 => Self::Trace {
                from: CoreAddress::from_index(a).ok_or(Malformed)?,
                words: take(&mut rest)?,
            },
            3 => {
                let [count, low, high] = take(&mut rest)?;
                Self::Edges {
                    to: system?,
                    line: b,
                    edge: c,
                    count,
                    at: Instant::from_words([low, high]),
                }
            }
            4 => Self::Datagram {
                to: system?,
                words: take_datagram(&mut rest, b)?,
            },
            5 => Self::Level {
                of: system?,
                high: b != 0,
            },
            6 => Self::Feed {
                of: system?,
                on: b != 0,
            },
            7 => Self::End,
            8 => Self::Fault {
                of: system?,
                fault: *HardwareFault::ALL.get(b).ok_or(Malformed)?,
                present: c != 0,
            },
            9 => Self::Crash { of: system? },
            10 => Self::Scribble {
                of: system?,
                seed: take::<1>(&mut rest)?[0],
            },
            11 => Self::Hang { of: system? },
            12 => Self::CutLevel {
                of: system?,
                cut: b != 0,
            },
            13 => Self::Later {
                us: take::<1>(&mut rest)?[0],
            },
            14 => {
                let [address, port] = take(&mut rest)?;
                Self::Connect {
                    of: system?,
                    channel: Channel::from_index(b).ok_or(Malformed)?,
                    at: NetworkAddress {
                        address: address.to_le_bytes(),
                        port: u16::try_from(port).map_err(|_| Malformed)?,
                    },
                }
            }
            15 => Self::Packet {
                of: system?,
                is_first: c != 0,
                words: take_datagram(&mut rest, b)?,
            },
            _ => return Err(Malformed),
        };
        *words = rest;
        Ok(item)
    }
}

fn take<const N: usize>(words: &mut &[u32]) -> Result<[u32; N], Malformed> {
    let (first, rest) = words.split_first_chunk().ok_or(Malformed)?;
    *words = rest;
    Ok(*first)
}

fn take_datagram(words: &mut &[u32], len: usize) -> Result<[u32; DATAGRAM_WORDS], Malformed> {
    let content = words.split_off(..len).ok_or(Malformed)?;
    if len > DATAGRAM_MAX_WORDS {
        return Err(Malformed);
    }
    Ok(encode_datagram(content))
}

/// The header of a machine's message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Report {
    /// The machine's clock.
    pub now: Instant,
    /// The roles that A and B show.
    pub lamps: [RoleLamp; 2],
    /// Whether A and B have power and are out of reset.
    pub powered: [bool; 2],
    /// Trace records lost so far; wraps around.
    pub lost: u32,
}

impl Report {
    /// Encodes the header of a message of `words` words.
    #[must_use]
    pub fn encode(&self, words: usize) -> [u32; REPORT_WORDS] {
        let [low, high] = self.now.to_words();
        let lamps = self.lamps[0].code() | self.lamps[1].code() << 8;
        let powered = u32::from(self.powered[0]) | u32::from(self.powered[1]) << 1;
        [MAGIC, words as u32, low, high, lamps, powered, self.lost]
    }

    /// The inverse of [`Report::encode`].
    ///
    /// # Errors
    /// [`Malformed`] if the words are not a report's header.
    pub fn decode(words: &[u32]) -> Result<Self, Malformed> {
        let (head, _) = words.split_first_chunk::<REPORT_WORDS>().ok_or(Malformed)?;
        let [magic, _, low, high, lamps, powered, lost] = *head;
        if magic != MAGIC {
            return Err(Malformed);
        }
        let lamp = |code| RoleLamp::from_code(code).ok_or(Malformed);
        Ok(Self {
            now: Instant::from_words([low, high]),
            lamps: [lamp(lamps & 0xFF)?, lamp(lamps >> 8)?],
            powered: [powered & 1 != 0, powered & 2 != 0],
            lost,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_item_survives_the_way() {
        let items = [
            Item::Frame([0xA5A5_5A5A; FRAME_WORDS]),
            Item::Trace {
                from: CoreAddress::B1,
                words: [9; TRACE_WORDS],
            },
            Item::Edges {
                to: SystemId::B,
                line: 2,
                edge: 1,
                count: 77,
                at: Instant::from_ns(3 << 40 | 5),
            },
            Item::Datagram {
                to: SystemId::A,
                words: encode_datagram(&[1, 2, 3]),
            },
            Item::Level {
                of: SystemId::B,
                high: true,
            },
            Item::Feed {
                of: SystemId::A,
                on: false,
            },
            Item::Fault {
                of: SystemId::B,
                fault: HardwareFault::Overvoltage,
                present: true,
            },
            Item::End,
            Item::Crash { of: SystemId::B },
            Item::Scribble {
                of: SystemId::A,
                seed: 7,
            },
            Item::Hang { of: SystemId::B },
            Item::CutLevel {
                of: SystemId::A,
                cut: true,
            },
            Item::Later { us: 999 },
            Item::Connect {
                of: SystemId::B,
                channel: Channel::Time,
                at: NetworkAddress {
                    address: [127, 0, 0, 1],
                    port: 7_410,
                },
            },
            Item::Packet {
                of: SystemId::B,
                is_first: true,
                words: encode_datagram(&[4; DATAGRAM_MAX_WORDS]),
            },
        ];
        for item in items {
            let mut buffer = [0; ITEM_WORDS];
            let len = item.encode(&mut buffer);
            let mut left = &buffer[..len];
            assert_eq!(Item::decode(&mut left), Ok(item));
            assert!(left.is_empty());
            assert_eq!(Item::decode(&mut &buffer[..len - 1]), Err(Malformed));
        }
    }

    #[test]
    fn what_is_no_item_is_refused() {
        for head in [
            0,
            16,
            8 | 8 << 16,
            9 | 2 << 8,
            2 | 6 << 8,
            3 | 2 << 8,
            4 | 2 << 8,
            4 | 65 << 16,
            14 | 2 << 16,
            15 | 65 << 16,
        ] {
            let mut words = [0; ITEM_WORDS];
            words[0] = head;
            assert_eq!(Item::decode(&mut &words[..]), Err(Malformed), "{head:#x}");
        }
    }

    #[test]
    fn a_packet_is_put_together_or_dropped() {
        use tandem_board::Recipient;
        use tandem_peripherals::codec::{PACKET_MAX_BYTES, PacketHead};
        let head = PacketHead {
            channel: Channel::Topics,
            peer: Recipient::Everyone,
            at: Instant::ORIGIN,
        };
        let mut assembly = Assembly::new();
        for len in [0, 1, 236, 237, PACKET_MAX_BYTES] {
            let mut words = [0; PACKET_WORDS];
            let count = head.encode(&[7; PACKET_MAX_BYTES][..len], &mut words);
            let words = &words[..count];
            for lost in 0..=PACKET_PARTS {
                let mut whole = false;
                let mut parts = 0;
                for (index, item) in packet_parts(SystemId::A, words).enumerate() {
                    parts += 1;
                    if let (
                        Item::Packet {
                            is_first,
                            words: part,
                            ..
                        },
                        false,
                    ) = (item, index == lost)
                        && let Some(put) = assembly.add(is_first, &part)
                    {
                        assert_eq!(put, words);
                        whole = true;
                    }
                }
                assert_eq!(whole, lost >= parts, "{len} bytes without part {lost}");
            }
        }
    }

    #[test]
    fn a_report_survives_the_way() {
        let report = Report {
            now: Instant::from_ns(0x1_2345_6789),
            lamps: [RoleLamp::Standby, RoleLamp::Master],
            powered: [false, true],
            lost: 8,
        };
        assert_eq!(Report::decode(&report.encode(40)), Ok(report));
        assert_eq!(Report::decode(&[0; 40]), Err(Malformed));
    }
}
