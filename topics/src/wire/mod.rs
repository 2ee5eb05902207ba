//! RTPS 2.5 on the wire: messages, submessages, parameter lists. (OMG formal/2022-04-01, chapter 9)

mod message;
mod parameters;
mod submessage;

pub use message::Outlet;
pub(crate) use message::{Message, Peer};
use parameters::{Cursor, UDP_V4};
pub use parameters::{Parameter, Parameters, pid};
pub(crate) use submessage::{Data, Heartbeat, Part, Submessage, submessages};

/// Twelve bytes that name a participant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(align(4))]
pub struct GuidPrefix(pub [u8; 12]);

impl GuidPrefix {
    /// The name of an endpoint of this participant.
    pub(crate) const fn guid(self, entity: EntityId) -> Guid {
        let prefix = self;
        Guid { prefix, entity }
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
    /// The writer of announcements of writers.
    pub const PUBLICATIONS_WRITER: Self = Self([0, 0, 3, 0xC2]);
    /// The writer of announcements of readers.
    pub const SUBSCRIPTIONS_WRITER: Self = Self([0, 0, 4, 0xC2]);

    /// The id of our writer of this index, of a topic without a key.
    pub(crate) const fn writer(index: usize) -> Self {
        Self([0, 0, index as u8 + 1, 0x03])
    }

    /// The id of our reader of this index, of a topic without a key.
    pub(crate) const fn reader(index: usize) -> Self {
        Self([0, 1, index as u8 + 1, 0x04])
    }
}

/// The two ends of a submessage.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ends {
    pub(crate) reader: EntityId,
    pub(crate) writer: EntityId,
}

impl Ends {
    /// From a writer of discovery to its readers.
    pub(crate) const fn of_discovery(writer: EntityId) -> Self {
        let [a, b, c, _] = writer.0;
        let reader = EntityId([a, b, c, 0xC7]);
        Self { reader, writer }
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

/// The number of a sample of its writer; the first is 1. It has 64 bits on the wire; a writer that
/// uses more than 32 of them is not heard.
pub(crate) type Sequence = u32;

/// A message is not overtaken by more than this many of its kind.
pub(crate) const OVERTAKEN: u32 = 32;

/// Notes a count. Returns whether it has risen: an older message that arrives late has a slightly
/// lower one; one that is far lower shows that the count before was wrong.
pub(crate) fn rises(last: &mut Option<u32>, count: u32) -> bool {
    let rises = last.is_none_or(|last| last.wrapping_sub(count) >= OVERTAKEN);
    *last = if rises { Some(count) } else { *last };
    rises
}

/// A set of sample numbers from `base` on: bit `n`, from the most significant one, stands for
/// `base + n`. Sets of others may have 256 numbers; what stands beyond 32 is left for the next time
/// that they send it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct SequenceSet {
    pub(crate) base: Sequence,
    pub(crate) bits: u32,
}

impl SequenceSet {
    /// The first 32 numbers.
    pub(crate) const FIRST: Self = Self {
        base: 1,
        bits: u32::MAX,
    };

    /// Returns its numbers, in their order.
    pub(crate) fn numbers(self) -> impl Iterator<Item = Sequence> {
        let offsets = (0..u32::BITS).filter(move |at| self.bits << at >> 31 != 0);
        offsets.map(move |at| self.base.saturating_add(at))
    }
}
