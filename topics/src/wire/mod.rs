//! RTPS 2.5 on the wire: messages, submessages, parameter lists. (OMG formal/2022-04-01, chapter 9)

mod cursor;
mod message;
mod parameters;
mod submessage;

pub(crate) use cursor::Cursor;
pub(crate) use message::{DataTo, Message};
use parameters::UDP_V4;
pub use parameters::{Parameter, Parameters, pid};
pub(crate) use submessage::{AckNack, Data, Gap, Heartbeat, Submessage, Submessages};

/// Twelve bytes that name a participant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(align(4))]
pub struct GuidPrefix(pub [u8; 12]);

impl GuidPrefix {
    /// The name of an endpoint of this participant.
    pub(crate) const fn guid(self, entity: EntityId) -> Guid {
        Guid {
            prefix: self,
            entity,
        }
    }
}

/// Four bytes that name an endpoint of a participant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(align(4))]
pub struct EntityId(pub [u8; 4]);

impl EntityId {
    /// All readers that match the writer.
    pub(crate) const UNKNOWN: Self = Self([0; 4]);
    pub(crate) const PARTICIPANT: Self = Self([0, 0, 1, 0xC1]);
    /// The writer of announcements of participants.
    pub const SPDP_WRITER: Self = Self([0, 1, 0, 0xC2]);
    pub(crate) const SPDP_READER: Self = Self([0, 1, 0, 0xC7]);
    /// The writer of announcements of writers.
    pub const PUBLICATIONS_WRITER: Self = Self([0, 0, 3, 0xC2]);
    pub(crate) const PUBLICATIONS_READER: Self = Self([0, 0, 3, 0xC7]);
    /// The writer of announcements of readers.
    pub const SUBSCRIPTIONS_WRITER: Self = Self([0, 0, 4, 0xC2]);
    pub(crate) const SUBSCRIPTIONS_READER: Self = Self([0, 0, 4, 0xC7]);

    /// The id of our writer of this index, of a topic without a key.
    pub(crate) const fn writer(index: usize) -> Self {
        Self([0, 0, index as u8 + 1, 0x03])
    }

    /// The id of our reader of this index, of a topic without a key.
    pub(crate) const fn reader(index: usize) -> Self {
        Self([0, 1, index as u8 + 1, 0x04])
    }
}

/// The name of an endpoint in the whole domain.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Guid {
    /// Its participant.
    pub prefix: GuidPrefix,
    /// Which endpoint of it.
    pub entity: EntityId,
}

impl Guid {
    /// Returns whether it is this endpoint; any one of the participant for `None`.
    pub(crate) fn is_of(self, prefix: GuidPrefix, entity: Option<EntityId>) -> bool {
        self.prefix == prefix && entity.is_none_or(|entity| entity == self.entity)
    }
}

/// A UDP port of an IPv4 address.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(align(4))]
pub struct Locator {
    /// IPv4 address.
    pub address: [u8; 4],
    /// UDP port.
    pub port: u16,
}

/// The number of a sample of its writer; the first is 1. It has 64 bits on the wire; a writer that
/// uses more than 32 of them is not heard.
pub(crate) type Sequence = u32;

/// A message is not overtaken by more than this many of its kind.
pub(crate) const OVERTAKEN: u32 = 32;

/// Returns whether a count has risen. An older message that arrives late has a slightly lower one;
/// one that is far lower shows that the count before was wrong.
pub(crate) fn has_risen(count: u32, last: Option<u32>) -> bool {
    last.is_none_or(|last| last.wrapping_sub(count) >= OVERTAKEN)
}

/// A set of sample numbers from `base` on: bit `n` of the first word, from the most significant
/// one, stands for `base + n`. Sets of others may have 256 numbers; what stands beyond 32 is left
/// for the next time that they send it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct SequenceSet {
    pub(crate) base: Sequence,
    pub(crate) bits: u32,
    pub(crate) len: u8,
}

impl SequenceSet {
    /// An empty set.
    pub(crate) const fn empty(base: Sequence) -> Self {
        Self {
            base,
            bits: 0,
            len: 0,
        }
    }

    /// The first 32 numbers.
    pub(crate) const FIRST: Self = Self {
        base: 1,
        bits: u32::MAX,
        len: 32,
    };

    /// Adds a number that is at most 31 above the base.
    pub(crate) fn insert(&mut self, number: Sequence) {
        let offset = number.wrapping_sub(self.base);
        if offset < 32 {
            self.bits |= 1 << (31 - offset);
            self.len = self.len.max(offset as u8 + 1);
        }
    }
}

impl Iterator for SequenceSet {
    type Item = Sequence;

    /// Takes the lowest number out.
    fn next(&mut self) -> Option<Sequence> {
        while self.len > 0 {
            let (number, is_in) = (self.base, self.bits & 1 << 31 != 0);
            self.base = self.base.saturating_add(1);
            self.bits <<= 1;
            self.len -= 1;
            if is_in {
                return Some(number);
            }
        }
        None
    }
}
