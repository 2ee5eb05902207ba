//! Parameter lists: what a participant and its endpoints announce. (RTPS 9.4.2.11, 9.6.3)

use super::{Cursor, EntityId, Guid, GuidPrefix, Locator};

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
    #[inline(never)]
    pub fn guid(mut self) -> Option<Guid> {
        Some(Guid {
            prefix: GuidPrefix(self.value.array()?),
            entity: EntityId(self.value.array()?),
        })
    }

    /// A locator of IPv4; `None` for others.
    pub(crate) fn locator(mut self) -> Option<Locator> {
        let (kind, port) = (self.value.u32()?, self.value.u32()?);
        let address: [u8; 16] = self.value.array()?;
        let [.., a, b, c, d] = address;
        let port = u16::try_from(port).ok().filter(|port| *port > 0)?;
        (kind == UDP_V4).then_some(Locator {
            address: [a, b, c, d],
            port,
        })
    }

    /// Returns its text.
    pub fn text(mut self) -> Option<&'m str> {
        let len = self.value.u32()? as usize;
        let (_zero, text) = self.value.take(len)?.split_last()?;
        core::str::from_utf8(text).ok()
    }

    /// Returns its number, or the first of them.
    #[inline(never)]
    pub fn number(mut self) -> Option<u32> {
        self.value.u32()
    }

    /// Returns the second of its numbers.
    pub fn second(mut self) -> Option<u32> {
        let _first = self.value.u32()?;
        self.value.u32()
    }

    /// Returns whether it is this text.
    #[inline(never)]
    pub(crate) fn is(mut self, text: &str) -> bool {
        let len = self.value.u32().unwrap_or(0) as usize;
        let bytes = self.value.take(len).and_then(|bytes| bytes.split_last());
        bytes == Some((&0, text.as_bytes()))
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
        let (head, body) = payload.split_at_checked(4)?;
        match head {
            [0, 2, ..] => Some(Self::new(Cursor::new(body, false))),
            [0, 3, ..] => Some(Self::new(Cursor::new(body, true))),
            _ => None,
        }
    }

    /// Returns what stands behind the list; `None` if it has not ended as it must.
    pub(crate) fn end(self) -> Option<Cursor<'m>> {
        self.ended.then_some(self.rest)
    }

    /// Returns the first one with this number.
    #[inline(never)]
    pub fn find(mut self, id: u16) -> Option<Parameter<'m>> {
        Iterator::find(&mut self, |parameter| parameter.id == id)
    }
}

impl<'m> Iterator for Parameters<'m> {
    type Item = Parameter<'m>;

    #[inline(never)]
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
        let value = Cursor::new(value, self.rest.is_little());
        let id = id & !pid::MUST_UNDERSTAND;
        Some(Parameter { id, value })
    }
}
