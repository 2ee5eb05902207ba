//! A reliable writer: its last samples, and the readers that it serves. (RTPS 8.4.9)

use crate::qos::Fit;
use crate::wire::{AckNack, EntityId, Guid, GuidPrefix, Heartbeat, Sequence, has_risen};
use crate::{Counts, Durability, Qos, Reliability};

/// How many readers of other participants one writer serves. D-4
pub const READERS: usize = 2;

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

/// Why a sample was not published.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WriteError {
    /// It has more bytes than the participant has room for.
    TooLong,
    /// The writer has used all its numbers, 2³² − 2: seven weeks at 1 kHz. A participant with a new
    /// name can go on.
    Ended,
}

#[derive(Clone, Debug)]
pub(crate) struct Writer<const DEPTH: usize, const BYTES: usize> {
    samples: [Slot<BYTES>; DEPTH],
    depth: u32,
    last: Sequence,
    /// The slot of that one.
    newest: u8,
    heartbeats: u32,
    pub(crate) readers: [Option<RemoteReader>; READERS],
    pub(crate) counts: Counts,
}

impl<const DEPTH: usize, const BYTES: usize> Writer<DEPTH, BYTES> {
    pub(crate) fn new(qos: Qos) -> Self {
        Self {
            samples: [Slot {
                len: 0,
                bytes: [0; BYTES],
            }; DEPTH],
            depth: qos.depth_within(DEPTH) as u32,
            last: 0,
            newest: 0,
            heartbeats: 0,
            readers: [None; READERS],
            counts: Counts::default(),
        }
    }

    /// Adds a sample, which has the next number.
    pub(crate) fn push(&mut self, sample: &[u8]) -> Result<Sequence, WriteError> {
        let len = u8::try_from(sample.len()).map_err(|_| WriteError::TooLong)?;
        if self.last >= Sequence::MAX - 1 {
            return Err(WriteError::Ended);
        }
        let newest = match self.newest + 1 {
            next if u32::from(next) < self.depth => next,
            _ => 0,
        };
        let slot = self.samples.get_mut(usize::from(newest));
        let slot = slot.ok_or(WriteError::TooLong)?;
        let place = slot.bytes.get_mut(..sample.len());
        place.ok_or(WriteError::TooLong)?.copy_from_slice(sample);
        slot.len = len;
        (self.newest, self.last) = (newest, self.last + 1);
        Ok(self.last)
    }

    /// The number of the oldest sample that it has.
    pub(crate) fn first(&self) -> Sequence {
        (self.last + 1).saturating_sub(self.depth).max(1)
    }

    /// The number of the newest one; 0 before the first.
    pub(crate) const fn last(&self) -> Sequence {
        self.last
    }

    /// Returns a sample, if it is kept.
    pub(crate) fn sample(&self, number: Sequence) -> Option<&[u8]> {
        let age = self.last.checked_sub(number);
        let age = age.filter(|age| *age < self.depth && number > 0)?;
        let newest = u32::from(self.newest);
        let place = newest.checked_sub(age).unwrap_or(newest + self.depth - age);
        let slot = self.samples.get(place as usize)?;
        slot.bytes.get(..slot.len.into())
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

    /// Gives a reader that fits a place. Returns `false` if none is free.
    pub(crate) fn on_reader(&mut self, guid: Guid, fit: Fit) -> bool {
        let (reliability, durability) = match fit {
            Fit::Stranger => return true,
            Fit::Incompatible => {
                self.counts.incompatible = self.counts.incompatible.wrapping_add(1);
                return true;
            }
            Fit::Fits(reliability, durability) => (reliability, durability),
        };
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
    pub(crate) fn remove(&mut self, prefix: GuidPrefix, entity: Option<EntityId>) {
        for place in &mut self.readers {
            let _gone = place.take_if(|reader| reader.guid.is_of(prefix, entity));
        }
    }

    /// Returns whether a reliable reader has not said that it has everything.
    pub(crate) fn is_awaited(&self) -> bool {
        let mut readers = self.readers.iter().flatten();
        readers.any(|reader| reader.is_reliable && reader.needs <= self.last)
    }

    /// Notes what a reader has. Returns the oldest sample that it may get, if it is a reader that
    /// the writer serves, and its ACKNACK a new one.
    pub(crate) fn on_acknack(&mut self, guid: Guid, acknack: &AckNack) -> Option<Sequence> {
        let (first, last) = (self.first(), self.last);
        let mut readers = self.readers.iter_mut().flatten();
        let reader = readers.find(|reader| reader.guid == guid)?;
        if !has_risen(acknack.count, reader.count) || acknack.set.base > last + 1 {
            return None;
        }
        reader.count = Some(acknack.count);
        reader.needs = reader.needs.max(acknack.set.base);
        for number in acknack.set {
            if number < first && number >= reader.told {
                reader.told = number + 1;
                self.counts.lost = self.counts.lost.wrapping_add(1);
            }
        }
        Some(reader.needs.max(first))
    }
}
