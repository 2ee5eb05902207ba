//! Reading of numbers, and of parameter lists: what a participant and its endpoints announce. (RTPS
//! 9.4.2.11, 9.6.3)

use super::{Ends, EntityId, Guid, GuidPrefix, Sequence, SequenceSet};
use tandem_board::NetworkAddress;

/// Reads numbers from bytes. Each method returns `None` if the bytes end before.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cursor<'m> {
    pub(super) bytes: &'m [u8],
    pub(super) is_little: bool,
}

impl<'m> Cursor<'m> {
    pub(crate) const fn new(bytes: &'m [u8], is_little: bool) -> Self {
        Self { bytes, is_little }
    }

    pub(crate) fn take(&mut self, len: usize) -> Option<&'m [u8]> {
        let (head, rest) = self.bytes.split_at_checked(len)?;
        self.bytes = rest;
        Some(head)
    }

    pub(crate) fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let mut array = [0; N];
        self.read(&mut array).then_some(array)
    }

    #[inline(never)]
    fn read(&mut self, into: &mut [u8]) -> bool {
        let bytes = self.take(into.len());
        for (to, from) in into.iter_mut().zip(bytes.unwrap_or_default()) {
            *to = *from;
        }
        bytes.is_some()
    }

    /// The bytes of a number, little-endian.
    fn number<const N: usize>(&mut self) -> Option<[u8; N]> {
        let mut bytes = self.array()?;
        if !self.is_little {
            bytes.reverse();
        }
        Some(bytes)
    }

    pub(crate) fn u16(&mut self) -> Option<u16> {
        self.number().map(u16::from_le_bytes)
    }

    pub(crate) fn u32(&mut self) -> Option<u32> {
        self.number().map(u32::from_le_bytes)
    }

    pub(super) fn ends(&mut self) -> Option<Ends> {
        let (reader, writer) = (EntityId(self.array()?), EntityId(self.array()?));
        Some(Ends { reader, writer })
    }

    /// A number of a sample, or one less than the first.
    pub(super) fn sequence(&mut self) -> Option<Sequence> {
        let (high, low) = (self.u32()?, self.u32()?);
        (high == 0 && low < u32::MAX).then_some(low)
    }

    pub(super) fn set(&mut self) -> Option<SequenceSet> {
        let base = self.sequence().filter(|base| *base > 0)?;
        let len = self.u32().filter(|len| *len <= 256)?;
        let bits = if len == 0 { 0 } else { self.u32()? };
        for _ in 1..len.div_ceil(32) {
            self.u32()?;
        }
        let bits = bits & !u32::MAX.unbounded_shr(len);
        Some(SequenceSet { base, bits })
    }
}

/// Numbers of parameters.
pub mod pid {
    #![allow(missing_docs, reason = "the names of RTPS 9.6.3")]
    pub(crate) const SENTINEL: u16 = 0x01;
    pub(crate) const LEASE: u16 = 0x02;
    pub const TOPIC_NAME: u16 = 0x05;
    pub const TYPE_NAME: u16 = 0x07;
    pub(crate) const PROTOCOL_VERSION: u16 = 0x15;
    pub(crate) const VENDOR: u16 = 0x16;
    pub const RELIABILITY: u16 = 0x1A;
    pub const LIVELINESS: u16 = 0x1B;
    pub const DURABILITY: u16 = 0x1D;
    pub const OWNERSHIP: u16 = 0x1F;
    pub const DEADLINE: u16 = 0x23;
    pub const PARTITION: u16 = 0x29;
    pub(crate) const DEFAULT_LOCATOR: u16 = 0x31;
    pub(crate) const METATRAFFIC_LOCATOR: u16 = 0x32;
    pub const HISTORY: u16 = 0x40;
    pub(crate) const PARTICIPANT_GUID: u16 = 0x50;
    pub(crate) const BUILTIN_ENDPOINTS: u16 = 0x58;
    pub const ENDPOINT_GUID: u16 = 0x5A;
    pub(crate) const STATUS: u16 = 0x71;
    pub const REPRESENTATION: u16 = 0x73;
    /// Who does not know such a parameter must not use the list.
    pub(crate) const MUST_UNDERSTAND: u16 = 0x4000;
}

/// A kind of locator: UDP over IPv4.
pub(super) const UDP_V4: u32 = 1;

/// One parameter.
#[derive(Clone, Copy, Debug)]
pub struct Parameter<'m> {
    pub(crate) id: u16,
    pub(crate) value: Cursor<'m>,
}

impl<'m> Parameter<'m> {
    /// Returns the name that it has.
    pub fn guid(mut self) -> Option<Guid> {
        Some(Guid {
            prefix: GuidPrefix(self.value.array()?),
            entity: EntityId(self.value.array()?),
        })
    }

    /// A locator of IPv4; `None` for others.
    pub(crate) fn locator(mut self) -> Option<NetworkAddress> {
        let (kind, port) = (self.value.u32()?, self.value.u32()?);
        let [.., a, b, c, d]: [u8; 16] = self.value.array()?;
        let port = u16::try_from(port).ok().filter(|port| *port > 0)?;
        let address = [a, b, c, d];
        (kind == UDP_V4).then_some(NetworkAddress { address, port })
    }

    /// Returns its text.
    pub fn text(self) -> Option<&'m str> {
        core::str::from_utf8(self.bytes()?).ok()
    }

    /// Returns the bytes of its text, which ends with a zero.
    pub(crate) fn bytes(mut self) -> Option<&'m [u8]> {
        let len = self.value.u32()? as usize;
        self.value.take(len)?.strip_suffix(&[0])
    }

    /// Returns its number at this place, from 0 on.
    pub fn number(mut self, place: usize) -> Option<u32> {
        self.value.take(4 * place)?;
        self.value.u32()
    }
}

/// The parameters of a list, up to its end or to the first one that is not complete.
#[derive(Clone, Copy, Debug)]
pub struct Parameters<'m> {
    rest: Cursor<'m>,
    ended: bool,
}

impl<'m> Parameters<'m> {
    pub(crate) const fn new(rest: Cursor<'m>) -> Self {
        Self { rest, ended: false }
    }

    /// Returns the list in a payload; `None` if the payload has another representation.
    pub(crate) fn of_payload(payload: &'m [u8]) -> Option<Self> {
        match payload {
            [0, 2, _, _, body @ ..] => Some(Self::new(Cursor::new(body, false))),
            [0, 3, _, _, body @ ..] => Some(Self::new(Cursor::new(body, true))),
            _ => None,
        }
    }

    /// Returns what stands behind the list; `None` if it has not ended as it must.
    pub(crate) fn end(self) -> Option<Cursor<'m>> {
        self.ended.then_some(self.rest)
    }

    /// Returns the first one with this number.
    pub fn find(mut self, id: u16) -> Option<Parameter<'m>> {
        Iterator::find(&mut self, |parameter| parameter.id == id)
    }
}

impl<'m> Iterator for Parameters<'m> {
    type Item = Parameter<'m>;

    fn next(&mut self) -> Option<Parameter<'m>> {
        if self.ended {
            return None;
        }
        let (id, len) = (self.rest.u16()?, self.rest.u16()?);
        if id == pid::SENTINEL {
            self.ended = true;
            return None;
        }
        // The next one is aligned.
        let value = self.rest.take(len.into()).filter(|_| len % 4 == 0)?;
        let value = Cursor::new(value, self.rest.is_little);
        let id = id & !pid::MUST_UNDERSTAND;
        Some(Parameter { id, value })
    }
}
