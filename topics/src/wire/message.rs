//! Writing of messages.

use super::submessage::{flag, kind};
use super::{AckNack, EntityId, Gap, Guid, GuidPrefix, Heartbeat, Locator, Sequence, SequenceSet};
use super::{UDP_V4, pid};

/// Bytes of the longest message that is written.
const LONGEST: usize = 320;
/// RTPS 2.3, and the number of a vendor without a number.
const HEAD: [u8; 8] = [b'R', b'T', b'P', b'S', 2, 3, 0, 0];
/// The representation of a list of parameters.
const LIST: [u8; 4] = [0, 3, 0, 0];

/// Where the sample of a DATA comes from, and for whom it is.
#[derive(Clone, Copy, Debug)]
pub(crate) struct DataTo {
    pub(crate) reader: EntityId,
    pub(crate) writer: EntityId,
    pub(crate) sequence: Sequence,
}

/// A message that is being written. All numbers are little-endian, each part has a length that is a
/// multiple of four. What does not fit makes the whole message void.
pub(crate) struct Message {
    bytes: [u8; LONGEST],
    len: usize,
    /// Where the part begins that is being written.
    part: usize,
}

impl Message {
    /// Begins a message of this participant to one other, or to all.
    pub(crate) fn new(from: GuidPrefix, to: Option<GuidPrefix>) -> Self {
        let mut message = Self {
            bytes: [0; LONGEST],
            len: 0,
            part: 0,
        };
        message.put(&HEAD);
        message.put(&from.0);
        if let Some(to) = to {
            message.begin(kind::INFO_DESTINATION, 0);
            message.put(&to.0);
            message.end();
        }
        message
    }

    #[inline(never)]
    fn put(&mut self, bytes: &[u8]) {
        let end = self.len.saturating_add(bytes.len());
        if let Some(place) = self.bytes.get_mut(self.len..end) {
            for (to, from) in place.iter_mut().zip(bytes) {
                *to = *from;
            }
        }
        self.len = end;
    }

    fn number(&mut self, number: u32) {
        self.put(&number.to_le_bytes());
    }

    #[inline(never)]
    fn begin(&mut self, kind: u8, flags: u8) {
        self.put(&[kind, flags | flag::LITTLE_ENDIAN, 0, 0]);
        self.part = self.len;
    }

    /// Ends a part: pads it with the zeros of the room, and fills its length in.
    #[inline(never)]
    fn end(&mut self) {
        self.len = self.len.next_multiple_of(4);
        let len = (self.len - self.part) as u16;
        if let Some(place) = self.bytes.get_mut(self.part - 2..self.part) {
            place.copy_from_slice(&len.to_le_bytes());
        }
    }

    #[inline(never)]
    fn ends_of(&mut self, reader: EntityId, writer: EntityId, first: Sequence) {
        self.put(&reader.0);
        self.put(&writer.0);
        self.number(0);
        self.number(first);
    }

    fn begin_data(&mut self, flags: u8, to: DataTo) {
        self.begin(kind::DATA, flags);
        // No flags, and 16 bytes to the payload.
        self.put(&[0, 0, 16, 0]);
        self.ends_of(to.reader, to.writer, to.sequence);
    }

    pub(crate) fn data(&mut self, to: DataTo, payload: &[u8]) {
        self.begin_data(flag::SAMPLE, to);
        self.put(payload);
        self.end();
    }

    /// Begins a sample that is a list of parameters; [`end_list`](Self::end_list) ends it.
    pub(crate) fn begin_list(&mut self, to: DataTo) {
        self.begin_data(flag::SAMPLE, to);
        self.put(&LIST);
    }

    pub(crate) fn end_list(&mut self) {
        self.number(pid::SENTINEL.into());
        self.end();
    }

    /// Says that the participant of this GUID has ended.
    pub(crate) fn ends(&mut self, to: DataTo, guid: Guid) {
        self.begin_data(flag::INLINE_QOS | flag::KEY, to);
        // Disposed and unregistered; big-endian.
        self.words(pid::STATUS, &[0x0300_0000]);
        self.number(pid::SENTINEL.into());
        self.put(&LIST);
        self.guid(pid::PARTICIPANT_GUID, guid);
        self.end_list();
    }

    pub(crate) fn heartbeat(&mut self, heartbeat: Heartbeat) {
        let flags = if heartbeat.is_final { flag::FINAL } else { 0 };
        self.begin(kind::HEARTBEAT, flags);
        self.ends_of(heartbeat.reader, heartbeat.writer, heartbeat.first);
        self.number(0);
        self.number(heartbeat.last);
        self.number(heartbeat.count);
        self.end();
    }

    /// A final one: it asks for no heartbeat.
    pub(crate) fn acknack(&mut self, acknack: AckNack) {
        self.begin(kind::ACKNACK, flag::FINAL);
        self.ends_of(acknack.reader, acknack.writer, acknack.set.base);
        self.bits(acknack.set);
        self.number(acknack.count);
        self.end();
    }

    pub(crate) fn gap(&mut self, gap: Gap) {
        self.begin(kind::GAP, 0);
        self.ends_of(gap.reader, gap.writer, gap.start);
        self.number(0);
        self.number(gap.set.base);
        self.bits(gap.set);
        self.end();
    }

    fn bits(&mut self, set: SequenceSet) {
        self.number(set.len.into());
        if set.len > 0 {
            self.number(set.bits);
        }
    }

    fn parameter(&mut self, id: u16, len: usize) {
        self.number(u32::from(id) | (len.next_multiple_of(4) as u32) << 16);
    }

    /// Writes a parameter of numbers of 32 bits.
    #[inline(never)]
    pub(crate) fn words(&mut self, id: u16, words: &[u32]) {
        self.parameter(id, 4 * words.len());
        for word in words {
            self.number(*word);
        }
    }

    pub(crate) fn guid(&mut self, id: u16, guid: Guid) {
        self.parameter(id, 16);
        self.put(&guid.prefix.0);
        self.put(&guid.entity.0);
    }

    pub(crate) fn text(&mut self, id: u16, text: &str) {
        // With a zero at its end, which the room has.
        let len = text.len() + 1;
        self.parameter(id, 4 + len);
        self.number(len as u32);
        self.put(text.as_bytes());
        self.len += len.next_multiple_of(4) - text.len();
    }

    pub(crate) fn locator(&mut self, id: u16, locator: Locator) {
        let address = u32::from_le_bytes(locator.address);
        self.words(id, &[UDP_V4, locator.port.into(), 0, 0, 0, address]);
    }

    /// Returns the message; `None` if it did not fit.
    pub(crate) fn finish(&self) -> Option<&[u8]> {
        self.bytes.get(..self.len)
    }
}
