//! Reading of messages. All bytes are another participant's allegations.

use super::{Cursor, EntityId, GuidPrefix, Parameters, Sequence, SequenceSet, pid};

/// Kinds of submessages.
pub(super) mod kind {
    pub(crate) const PAD: u8 = 0x01;
    pub(crate) const ACKNACK: u8 = 0x06;
    pub(crate) const HEARTBEAT: u8 = 0x07;
    pub(crate) const GAP: u8 = 0x08;
    pub(crate) const INFO_TIMESTAMP: u8 = 0x09;
    pub(crate) const INFO_DESTINATION: u8 = 0x0E;
    pub(crate) const DATA: u8 = 0x15;
}

/// Flags of submessages. The first one is in each of them.
pub(super) mod flag {
    pub(crate) const LITTLE_ENDIAN: u8 = 0x01;
    /// HEARTBEAT, ACKNACK: no answer is asked for.
    pub(crate) const FINAL: u8 = 0x02;
    /// DATA: parameters stand before the payload.
    pub(crate) const INLINE_QOS: u8 = 0x02;
    /// DATA: the payload is a sample.
    pub(crate) const SAMPLE: u8 = 0x04;
    /// DATA: the payload is a key.
    pub(crate) const KEY: u8 = 0x08;
}

/// A sample, or the end of one.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Data<'m> {
    pub(crate) reader: EntityId,
    pub(crate) writer: EntityId,
    pub(crate) sequence: Sequence,
    /// The parameters before the payload.
    pub(crate) inline: &'m [u8],
    pub(crate) is_little: bool,
    /// The payload is the key of what has ended, and no sample.
    pub(crate) is_key: bool,
    /// Representation and body.
    pub(crate) payload: &'m [u8],
}

impl Data<'_> {
    /// Returns whether it says that what it is about has ended.
    pub(crate) fn ends(&self) -> bool {
        let inline = Parameters::new(Cursor::new(self.inline, self.is_little));
        // The status is big-endian in each message: the last byte holds the flags.
        let status = inline.find(pid::STATUS).and_then(|mut it| it.value.array());
        self.is_key || status.is_some_and(|[_, _, _, flags]: [u8; 4]| flags & 3 != 0)
    }
}

/// What a writer has.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Heartbeat {
    pub(crate) reader: EntityId,
    pub(crate) writer: EntityId,
    pub(crate) first: Sequence,
    /// One less than `first` if it has none.
    pub(crate) last: Sequence,
    pub(crate) count: u32,
    /// It asks for no answer of who has all.
    pub(crate) is_final: bool,
}

/// What a reader has, and what it asks for.
#[derive(Clone, Copy, Debug)]
pub(crate) struct AckNack {
    pub(crate) reader: EntityId,
    pub(crate) writer: EntityId,
    /// It has all below the base; the numbers in the set it asks for.
    pub(crate) set: SequenceSet,
    pub(crate) count: u32,
}

/// What a writer will not send.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Gap {
    pub(crate) reader: EntityId,
    pub(crate) writer: EntityId,
    pub(crate) start: Sequence,
    /// All from `start` to below the base, and the numbers in the set.
    pub(crate) set: SequenceSet,
}

/// A part of a message.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Submessage<'m> {
    Data(Data<'m>),
    Heartbeat(Heartbeat),
    AckNack(AckNack),
    Gap(Gap),
    /// What follows is for this participant; for all if it is 0.
    Destination(GuidPrefix),
    /// What this participant does not need.
    Other,
}

/// The parts of a message.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Submessages<'m> {
    rest: Cursor<'m>,
}

impl<'m> Submessages<'m> {
    /// Returns the sender and the parts; `None` if these are no bytes of RTPS 2.
    pub(crate) fn of(datagram: &'m [u8]) -> Option<(GuidPrefix, Self)> {
        let mut rest = Cursor::new(datagram, true);
        if rest.take(4)? != b"RTPS" || rest.u8()? != 2 {
            return None;
        }
        let (_minor, _vendor) = (rest.u8()?, rest.u16()?);
        Some((GuidPrefix(rest.array()?), Self { rest }))
    }
}

impl<'m> Iterator for Submessages<'m> {
    type Item = Submessage<'m>;

    /// Ends at the first part that is not complete: what follows it cannot be found.
    fn next(&mut self) -> Option<Submessage<'m>> {
        let (kind, flags) = (self.rest.u8()?, self.rest.u8()?);
        self.rest.set_little(flags & flag::LITTLE_ENDIAN != 0);
        let len = usize::from(self.rest.u16()?);
        let to_the_end = len == 0 && !matches!(kind, kind::PAD | kind::INFO_TIMESTAMP);
        let len = if to_the_end {
            self.rest.rest().len()
        } else {
            len
        };
        let body = Cursor::new(self.rest.take(len)?, self.rest.is_little());
        decode(kind, flags, body)
    }
}

fn decode(kind: u8, flags: u8, mut body: Cursor<'_>) -> Option<Submessage<'_>> {
    let is_final = flags & flag::FINAL != 0;
    Some(match kind {
        kind::DATA => Submessage::Data(data(flags, body)?),
        kind::HEARTBEAT => {
            let heartbeat = Heartbeat {
                reader: body.entity()?,
                writer: body.entity()?,
                first: body.sequence()?,
                last: body.sequence()?,
                count: body.u32()?,
                is_final,
            };
            let is_range = heartbeat.first > 0 && heartbeat.last + 1 >= heartbeat.first;
            is_range.then_some(Submessage::Heartbeat(heartbeat))?
        }
        kind::ACKNACK => Submessage::AckNack(AckNack {
            reader: body.entity()?,
            writer: body.entity()?,
            set: body.set()?,
            count: body.u32()?,
        }),
        kind::GAP => Submessage::Gap(Gap {
            reader: body.entity()?,
            writer: body.entity()?,
            start: body.sequence().filter(|start| *start > 0)?,
            set: body.set()?,
        }),
        kind::INFO_DESTINATION => Submessage::Destination(GuidPrefix(body.array()?)),
        _ => Submessage::Other,
    })
}

fn data(flags: u8, mut body: Cursor<'_>) -> Option<Data<'_>> {
    let (_extra, to_inline) = (body.u16()?, usize::from(body.u16()?));
    let reader = body.entity()?;
    let writer = body.entity()?;
    let sequence = body.sequence().filter(|number| *number > 0)?;
    // Counted from behind its own field, of which 16 bytes are read.
    body.take(to_inline.checked_sub(16)?)?;
    let inline = if flags & flag::INLINE_QOS == 0 {
        &[]
    } else {
        let whole = body.rest();
        let mut parameters = Parameters::new(body);
        parameters.by_ref().for_each(drop);
        let behind = parameters.end()?;
        body = behind;
        let len = whole.len().saturating_sub(behind.rest().len());
        whole.get(..len).unwrap_or_default()
    };
    let has_payload = flags & (flag::SAMPLE | flag::KEY) != 0;
    Some(Data {
        reader,
        writer,
        sequence,
        inline,
        is_little: body.is_little(),
        is_key: flags & flag::SAMPLE == 0,
        payload: if has_payload { body.rest() } else { &[] },
    })
}
