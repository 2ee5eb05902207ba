//! A reliable writer: its last samples, and the readers that it serves. (RTPS 8.4.9)

use crate::qos::{Counts, Fit, Qos};
use crate::wire::{EntityId, Guid, GuidPrefix, Heartbeat, Sequence, SequenceSet, rises};

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

/// Why a sample was not published.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WriteError {
    /// It has more bytes than the participant has room for.
    TooLong,
    /// The writer has used all its numbers, 2³² − 2: seven weeks at 1 kHz. A participant with a new
    /// name can go on.
    Ended,
}

impl core::fmt::Display for WriteError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::TooLong => "the sample is longer than the room for it",
            Self::Ended => "the writer has used all its numbers",
        })
    }
}

impl core::error::Error for WriteError {}

#[derive(Clone, Debug)]
pub(crate) struct Writer<const DEPTH: usize, const BYTES: usize> {
    /// Length and bytes of each.
    samples: [(u8, [u8; BYTES]); DEPTH],
    depth: u32,
    /// The number of the newest one; 0 before the first.
    pub(crate) last: Sequence,
    heartbeats: u32,
    pub(crate) readers: [Option<RemoteReader>; READERS],
    pub(crate) counts: Counts,
}

impl<const DEPTH: usize, const BYTES: usize> Writer<DEPTH, BYTES> {
    pub(crate) fn new(qos: Qos) -> Self {
        Self {
            samples: [(0, [0; BYTES]); DEPTH],
            depth: qos.depth_within(DEPTH),
            last: 0,
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
        let number = self.last + 1;
        let place = number.checked_rem(self.depth).unwrap_or(0);
        let place = self.samples.get_mut(place as usize);
        let (of, bytes) = place.ok_or(WriteError::TooLong)?;
        let bytes = bytes.get_mut(..sample.len());
        bytes.ok_or(WriteError::TooLong)?.copy_from_slice(sample);
        *of = len;
        self.last = number;
        Ok(number)
    }

    /// The number of the oldest sample that it has.
    pub(crate) fn first(&self) -> Sequence {
        (self.last + 1).saturating_sub(self.depth).max(1)
    }

    /// Returns a sample, if it is kept.
    pub(crate) fn sample(&self, number: Sequence) -> Option<&[u8]> {
        let is_kept = (self.first()..=self.last).contains(&number);
        let place = number.checked_rem(self.depth).filter(|_| is_kept)?;
        let (len, bytes) = self.samples.get(place as usize)?;
        bytes.get(..usize::from(*len))
    }

    pub(crate) fn heartbeat(&mut self, is_final: bool) -> Heartbeat {
        self.heartbeats = self.heartbeats.wrapping_add(1);
        Heartbeat {
            first: self.first(),
            last: self.last,
            count: self.heartbeats,
            is_final,
        }
    }

    /// Gives a reader that fits a place. Returns `false` if none is free.
    pub(crate) fn on_reader(&mut self, guid: Guid, fit: Fit) -> bool {
        if self.readers.iter().flatten().any(|one| one.guid == guid) {
            return true;
        }
        let needs = match fit.with_history {
            true => self.first(),
            false => self.last + 1,
        };
        let Some(place) = self.readers.iter_mut().find(|place| place.is_none()) else {
            self.counts.refused = self.counts.refused.wrapping_add(1);
            return false;
        };
        *place = Some(RemoteReader {
            guid,
            is_reliable: fit.is_reliable,
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

    /// Notes what a reader has. Returns the oldest sample that it may get, if it is a reader that
    /// the writer serves, and its ACKNACK a new one.
    pub(crate) fn on_ack(&mut self, of: Guid, set: SequenceSet, count: u32) -> Option<Sequence> {
        let (first, last) = (self.first(), self.last);
        let mut readers = self.readers.iter_mut().flatten();
        let reader = readers.find(|reader| reader.guid == of)?;
        if set.base > last + 1 || !rises(&mut reader.count, count) {
            return None;
        }
        reader.needs = reader.needs.max(set.base);
        for number in set.numbers() {
            if number < first && number >= reader.told {
                reader.told = number + 1;
                self.counts.lost = self.counts.lost.wrapping_add(1);
            }
        }
        Some(reader.needs.max(first))
    }
}
