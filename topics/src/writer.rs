//! A reliable writer: its last samples, and the readers that it serves. (RTPS 8.4.9)

use crate::wire::{AckNack, EntityId, Guid, Heartbeat, Sequence};
use crate::{Durability, Qos, Reliability};

/// How many readers of other participants one writer serves. D-4
pub const READERS: usize = 2;

/// Counts of a writer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WriterCounts {
    /// Samples that were sent once more.
    pub repaired: u32,
    /// Samples that a reader asked for after the writer had dropped them.
    pub lost: u32,
    /// Readers that were refused, because [`READERS`] have a place.
    pub refused: u32,
    /// Readers that ask for another quality of service.
    pub incompatible: u32,
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct RemoteReader {
    pub(crate) guid: Guid,
    pub(crate) is_reliable: bool,
    /// It has all below this number, or does not want them.
    pub(crate) needs: Sequence,
    /// The count of the last ACKNACK.
    count: Option<u32>,
    /// Losses below this number are counted.
    told: Sequence,
}

#[derive(Clone, Copy, Debug)]
struct Slot<const BYTES: usize> {
    len: u8,
    bytes: [u8; BYTES],
}

/// A sample that does not fit the room of a writer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooLong;

#[derive(Debug)]
pub(crate) struct Writer<const DEPTH: usize, const BYTES: usize> {
    samples: [Slot<BYTES>; DEPTH],
    depth: u64,
    last: Sequence,
    heartbeats: u32,
    pub(crate) readers: [Option<RemoteReader>; READERS],
    pub(crate) counts: WriterCounts,
}

impl<const DEPTH: usize, const BYTES: usize> Writer<DEPTH, BYTES> {
    pub(crate) const fn new(qos: Qos) -> Self {
        Self {
            samples: [Slot {
                len: 0,
                bytes: [0; BYTES],
            }; DEPTH],
            depth: qos.depth_within(DEPTH) as u64,
            last: 0,
            heartbeats: 0,
            readers: [None; READERS],
            counts: WriterCounts {
                repaired: 0,
                lost: 0,
                refused: 0,
                incompatible: 0,
            },
        }
    }

    /// Adds a sample, which has the next number.
    pub(crate) fn push(&mut self, sample: &[u8]) -> Result<Sequence, TooLong> {
        let len = u8::try_from(sample.len()).map_err(|_| TooLong)?;
        let number = self.last + 1;
        let slot = &mut self.samples[(number % self.depth) as usize];
        let place = slot.bytes.get_mut(..sample.len()).ok_or(TooLong)?;
        place.copy_from_slice(sample);
        slot.len = len;
        self.last = number;
        Ok(number)
    }

    /// The number of the oldest sample that it has.
    pub(crate) fn first(&self) -> Sequence {
        (self.last + 1).saturating_sub(self.depth).max(1)
    }

    /// The number of the newest one; 0 before the first.
    pub(crate) const fn last(&self) -> Sequence {
        self.last
    }

    pub(crate) fn sample(&self, number: Sequence) -> Option<&[u8]> {
        let is_kept = (self.first()..=self.last).contains(&number);
        let slot = &self.samples[(number % self.depth) as usize];
        is_kept.then(|| &slot.bytes[..slot.len.into()])
    }

    pub(crate) fn heartbeat(&mut self, own: EntityId, to: EntityId, is_final: bool) -> Heartbeat {
        self.heartbeats = self.heartbeats.wrapping_add(1);
        Heartbeat {
            reader: to,
            writer: own,
            first: self.first(),
            last: self.last,
            count: self.heartbeats,
            is_final,
        }
    }

    /// Gives a reader a place. Returns whether it has one.
    pub(crate) fn add(
        &mut self,
        guid: Guid,
        (reliability, durability): (Reliability, Durability),
    ) -> bool {
        if self.readers.iter().flatten().any(|one| one.guid == guid) {
            return true;
        }
        let needs = match durability {
            Durability::Volatile => self.last + 1,
            Durability::TransientLocal => self.first(),
        };
        let Some(place) = self.readers.iter_mut().find(|place| place.is_none()) else {
            self.counts.refused = self.counts.refused.wrapping_add(1);
            return false;
        };
        *place = Some(RemoteReader {
            guid,
            is_reliable: reliability == Reliability::Reliable,
            needs,
            count: None,
            told: needs,
        });
        true
    }

    /// Takes the places of these readers back.
    pub(crate) fn remove(&mut self, is_gone: impl Fn(Guid) -> bool) {
        for place in &mut self.readers {
            if place.is_some_and(|reader| is_gone(reader.guid)) {
                *place = None;
            }
        }
    }

    /// Returns whether a reliable reader has not said that it has everything.
    pub(crate) fn is_awaited(&self) -> bool {
        let mut readers = self.readers.iter().flatten();
        readers.any(|reader| reader.is_reliable && reader.needs <= self.last)
    }

    /// Notes what a reader has. Returns whether it is one that the writer serves, and its ACKNACK a
    /// new one.
    pub(crate) fn on_acknack(&mut self, guid: Guid, acknack: &AckNack) -> bool {
        let (first, last) = (self.first(), self.last);
        let Some(place) = self
            .readers
            .iter()
            .position(|reader| reader.is_some_and(|reader| reader.guid == guid))
        else {
            return false;
        };
        let Some(mut reader) = self.readers[place] else {
            return false;
        };
        let is_new = reader
            .count
            .is_none_or(|count| (acknack.count.wrapping_sub(count) as i32) > 0);
        if !is_new || acknack.set.base > last + 1 {
            return false;
        }
        reader.count = Some(acknack.count);
        reader.needs = reader.needs.max(acknack.set.base);
        for number in acknack.set.iter() {
            if number < first && number >= reader.told {
                reader.told = number + 1;
                self.counts.lost = self.counts.lost.wrapping_add(1);
            }
        }
        self.readers[place] = Some(reader);
        true
    }
}
