//! Writing of messages.

use super::submessage::{flag, kind};
use super::{AckNack, EntityId, Gap, Guid, GuidPrefix, Heartbeat, ParameterWriter, Sequence};
use super::{SequenceSet, pid};

/// Bytes of the longest message that is written.
const LONGEST: usize = 320;
/// RTPS 2.3, and the number of a vendor without a number.
const HEAD: [u8; 8] = [b'R', b'T', b'P', b'S', 2, 3, 0, 0];

/// Where the sample of a DATA comes from, and for whom it is.
#[derive(Clone, Copy, Debug)]
pub(crate) struct DataTo {
    pub(crate) reader: EntityId,
    pub(crate) writer: EntityId,
    pub(crate) sequence: Sequence,
}

/// A message that is being written. All numbers are little-endian, each part has a length that is a
/// multiple of four. What does not fit makes the whole message void.
pub(crate) struct Message<'m> {
    bytes: &'m mut [u8],
    len: usize,
}

/// The room for a message.
pub(crate) const ROOM: [u8; LONGEST] = [0; LONGEST];

impl<'m> Message<'m> {
    /// Begins a message of this participant to one other, or to all.
    pub(crate) fn new(bytes: &'m mut [u8], from: GuidPrefix, to: Option<GuidPrefix>) -> Self {
        let mut message = Self { bytes, len: 0 };
        message.put(&HEAD);
        message.put(&from.0);
        if let Some(to) = to {
            message.part(kind::INFO_DESTINATION, 0, |part| part.put(&to.0));
        }
        message
    }

    pub(super) fn put(&mut self, bytes: &[u8]) {
        let end = self.len.saturating_add(bytes.len());
        if let Some(place) = self.bytes.get_mut(self.len..end) {
            place.copy_from_slice(bytes);
        }
        self.len = end;
    }

    fn part(&mut self, kind: u8, flags: u8, write: impl FnOnce(&mut Self)) {
        self.put(&[kind, flags | flag::LITTLE_ENDIAN, 0, 0]);
        let begin = self.len;
        write(self);
        let padding = (self.len - begin).next_multiple_of(4) - (self.len - begin);
        self.put(&[0; 3][..padding]);
        let len = (self.len - begin) as u16;
        if let Some(place) = self.bytes.get_mut(begin - 2..begin) {
            place.copy_from_slice(&len.to_le_bytes());
        }
    }

    fn sequence(&mut self, number: Sequence) {
        self.put(&((number >> 32) as u32).to_le_bytes());
        self.put(&(number as u32).to_le_bytes());
    }

    fn set(&mut self, set: SequenceSet) {
        self.sequence(set.base);
        self.put(&u32::from(set.len).to_le_bytes());
        if set.len > 0 {
            self.put(&set.bits.to_le_bytes());
        }
    }

    fn data_head(&mut self, to: DataTo) {
        // No flags, and 16 bytes to the payload.
        self.put(&[0, 0, 16, 0]);
        self.put(&to.reader.0);
        self.put(&to.writer.0);
        self.sequence(to.sequence);
    }

    pub(crate) fn data(&mut self, to: DataTo, payload: &[u8]) {
        self.part(kind::DATA, flag::SAMPLE, |part| {
            part.data_head(to);
            part.put(payload);
        });
    }

    /// Writes a sample that is a list of parameters.
    pub(crate) fn data_list(
        &mut self,
        to: DataTo,
        write: impl FnOnce(&mut ParameterWriter<'_, '_>),
    ) {
        self.part(kind::DATA, flag::SAMPLE, |part| {
            part.data_head(to);
            part.put(&[0, 3, 0, 0]);
            write(&mut ParameterWriter { message: part });
            part.put(&[pid::SENTINEL as u8, 0, 0, 0]);
        });
    }

    /// Says that the participant or endpoint of this GUID has ended.
    pub(crate) fn ends(&mut self, to: DataTo, id: u16, guid: Guid) {
        self.part(kind::DATA, flag::INLINE_QOS | flag::KEY, |part| {
            part.data_head(to);
            let mut inline = ParameterWriter { message: part };
            // Disposed and unregistered.
            inline.bytes(pid::STATUS, &[0, 0, 0, 3]);
            part.put(&[pid::SENTINEL as u8, 0, 0, 0]);
            part.put(&[0, 3, 0, 0]);
            ParameterWriter { message: part }.guid(id, guid);
            part.put(&[pid::SENTINEL as u8, 0, 0, 0]);
        });
    }

    pub(crate) fn heartbeat(&mut self, heartbeat: Heartbeat) {
        let flags = if heartbeat.is_final { flag::FINAL } else { 0 };
        self.part(kind::HEARTBEAT, flags, |part| {
            part.put(&heartbeat.reader.0);
            part.put(&heartbeat.writer.0);
            part.sequence(heartbeat.first);
            part.sequence(heartbeat.last);
            part.put(&heartbeat.count.to_le_bytes());
        });
    }

    /// A final one: it asks for no heartbeat.
    pub(crate) fn acknack(&mut self, acknack: AckNack) {
        self.part(kind::ACKNACK, flag::FINAL, |part| {
            part.put(&acknack.reader.0);
            part.put(&acknack.writer.0);
            part.set(acknack.set);
            part.put(&acknack.count.to_le_bytes());
        });
    }

    pub(crate) fn gap(&mut self, gap: Gap) {
        self.part(kind::GAP, 0, |part| {
            part.put(&gap.reader.0);
            part.put(&gap.writer.0);
            part.sequence(gap.start);
            part.set(gap.set);
        });
    }

    /// Returns the message; `None` if it did not fit.
    pub(crate) fn finish(self) -> Option<&'m [u8]> {
        self.bytes.get(..self.len)
    }
}
