//! Writing of messages.

use super::submessage::{flag, kind};
use super::{Ends, EntityId, GuidPrefix, Heartbeat, Sequence, SequenceSet};
use super::{UDP_V4, pid};
use tandem_board::{NetworkAddress, Recipient};

/// Bytes of the longest message that is written.
const LONGEST: usize = 320;
/// RTPS 2.3, and the number of a vendor without a number.
const HEAD: [u8; 8] = [b'R', b'T', b'P', b'S', 2, 3, 0, 0];
/// The representation of a list of parameters.
const LIST: [u8; 4] = [0, 3, 0, 0];

/// What a participant wants done.
pub trait Outlet {
    /// Sends a message; `Everyone` is the multicast address of the domain. One that cannot be sent
    /// is lost.
    fn send(&mut self, to: Recipient, message: &[u8]);
}

/// A participant, and a place where it hears.
pub(crate) type Peer = (GuidPrefix, NetworkAddress);

/// A message that is being written. All numbers are little-endian, each part has a length that is a
/// multiple of four. What does not fit makes the whole message void.
pub(crate) struct Message {
    from: GuidPrefix,
    to: Recipient,
    bytes: [u8; LONGEST],
    len: usize,
    /// Where the part begins that is being written.
    part: usize,
}

impl Message {
    /// Begins a message of this participant to one other, or to all.
    pub(crate) fn new(from: GuidPrefix, to: Option<Peer>) -> Self {
        let mut message = Self {
            from,
            to: to.map_or(Recipient::Everyone, |(_, at)| Recipient::One(at)),
            bytes: [0; LONGEST],
            len: 0,
            part: 0,
        };
        message.put(&HEAD);
        message.put(&from.0);
        if let Some((prefix, _)) = to {
            message.begin(kind::INFO_DESTINATION, 0);
            message.put(&prefix.0);
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

    #[inline(never)]
    fn numbers(&mut self, numbers: &[u32]) {
        for number in numbers {
            self.put(&number.to_le_bytes());
        }
    }

    #[inline(never)]
    fn begin(&mut self, kind: u8, flags: u8) {
        self.put(&[kind, flags | flag::LITTLE_ENDIAN, 0, 0]);
        self.part = self.len;
    }

    /// Ends a part: pads it with the zeros of the room, and fills its length in.
    #[inline(never)]
    fn end(&mut self) -> &mut Self {
        self.len = self.len.next_multiple_of(4);
        let len = (self.len - self.part) as u16;
        if let Some(place) = self.bytes.get_mut(self.part - 2..self.part) {
            place.copy_from_slice(&len.to_le_bytes());
        }
        self
    }

    /// Writes both ends and the number that stands behind them.
    fn ends(&mut self, ends: Ends, first: Sequence) {
        self.put(&ends.reader.0);
        self.put(&ends.writer.0);
        self.numbers(&[0, first]);
    }

    fn begin_data(&mut self, flags: u8, ends: Ends, sequence: Sequence) {
        self.begin(kind::DATA, flags);
        // No flags, and 16 bytes to the payload.
        self.put(&[0, 0, 16, 0]);
        self.ends(ends, sequence);
    }

    pub(crate) fn data(&mut self, ends: Ends, sequence: Sequence, payload: &[u8]) -> &mut Self {
        self.begin_data(flag::SAMPLE, ends, sequence);
        self.put(payload);
        self.end()
    }

    /// Begins a sample that is a list of parameters; [`end_list`](Self::end_list) ends it.
    pub(crate) fn begin_list(&mut self, ends: Ends, sequence: Sequence) {
        self.begin_data(flag::SAMPLE, ends, sequence);
        self.put(&LIST);
    }

    pub(crate) fn end_list(&mut self) -> &mut Self {
        self.numbers(&[pid::SENTINEL.into()]);
        self.end()
    }

    /// Says that this participant has ended.
    pub(crate) fn end_of_participant(&mut self) -> &mut Self {
        let ends = Ends::of_discovery(EntityId::SPDP_WRITER);
        self.begin_data(flag::INLINE_QOS | flag::KEY, ends, 1);
        // Disposed and unregistered; big-endian.
        self.words(pid::STATUS, &[0x0300_0000]);
        self.numbers(&[pid::SENTINEL.into()]);
        self.put(&LIST);
        self.guid(pid::PARTICIPANT_GUID, EntityId::PARTICIPANT);
        self.end_list()
    }

    pub(crate) fn heartbeat(&mut self, ends: Ends, heartbeat: Heartbeat) -> &mut Self {
        let flags = if heartbeat.is_final { flag::FINAL } else { 0 };
        self.begin(kind::HEARTBEAT, flags);
        self.ends(ends, heartbeat.first);
        self.numbers(&[0, heartbeat.last, heartbeat.count]);
        self.end()
    }

    /// A final one: it asks for no heartbeat.
    pub(crate) fn acknack(&mut self, ends: Ends, set: SequenceSet, count: u32) -> &mut Self {
        self.begin(kind::ACKNACK, flag::FINAL);
        self.ends(ends, set.base);
        match set.bits {
            0 => self.numbers(&[0, count]),
            bits => self.numbers(&[32, bits, count]),
        }
        self.end()
    }

    /// Says that the numbers from `start` to below `next` will not come.
    pub(crate) fn gap(&mut self, ends: Ends, start: Sequence, next: Sequence) -> &mut Self {
        self.begin(kind::GAP, 0);
        self.ends(ends, start);
        // An empty set from the next one on.
        self.numbers(&[0, next, 0]);
        self.end()
    }

    fn parameter(&mut self, id: u16, len: usize) {
        self.numbers(&[u32::from(id) | (len.next_multiple_of(4) as u32) << 16]);
    }

    /// Writes a parameter of numbers of 32 bits.
    #[inline(never)]
    pub(crate) fn words(&mut self, id: u16, words: &[u32]) {
        self.parameter(id, 4 * words.len());
        self.numbers(words);
    }

    /// Writes a parameter with the name of an endpoint of this participant.
    pub(crate) fn guid(&mut self, id: u16, entity: EntityId) {
        self.parameter(id, 16);
        let GuidPrefix(prefix) = self.from;
        self.put(&prefix);
        self.put(&entity.0);
    }

    pub(crate) fn text(&mut self, id: u16, text: &str) {
        // With a zero at its end, which the room has.
        let len = text.len() + 1;
        self.parameter(id, 4 + len);
        self.numbers(&[len as u32]);
        self.put(text.as_bytes());
        self.len += len.next_multiple_of(4) - text.len();
    }

    pub(crate) fn locator(&mut self, id: u16, locator: NetworkAddress) {
        let address = u32::from_le_bytes(locator.address);
        self.words(id, &[UDP_V4, locator.port.into(), 0, 0, 0, address]);
    }

    /// Sends the message, if it did fit.
    pub(crate) fn send(&self, out: &mut impl Outlet) {
        if let Some(message) = self.bytes.get(..self.len) {
            out.send(self.to, message);
        }
    }
}
