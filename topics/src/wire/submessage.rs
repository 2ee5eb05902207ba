//! Reading of messages. All bytes are another participant's allegations.

use super::{Cursor, Ends, GuidPrefix, Parameters, Sequence, SequenceSet, pid};

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
    pub(crate) sequence: Sequence,
    /// The payload is a sample, and not the key of what has ended.
    pub(crate) is_sample: bool,
    /// What it is about has ended.
    pub(crate) ends: bool,
    /// Representation and body.
    pub(crate) payload: &'m [u8],
}

/// What a writer has.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Heartbeat {
    pub(crate) first: Sequence,
    /// One less than `first` if it has none.
    pub(crate) last: Sequence,
    pub(crate) count: u32,
    /// It asks for no answer of who has all.
    pub(crate) is_final: bool,
}

/// What goes from a writer to readers, or back.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Part<'m> {
    Data(Data<'m>),
    Heartbeat(Heartbeat),
    /// A reader has all below the base of the set, and asks for the numbers in it; with a count.
    AckNack(SequenceSet, u32),
    /// A writer will not send all from a number to below the base of the set, and those in the set.
    Gap(Sequence, SequenceSet),
}

/// A submessage.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Submessage<'m> {
    Between(Ends, Part<'m>),
    /// What follows is for this participant; for all if it is 0.
    Destination(GuidPrefix),
    /// What this participant does not need.
    Other,
}

/// Returns the sender of a message and its parts; `None` if these are no bytes of RTPS 2. The parts
/// end at the first one that is not complete: what follows it cannot be found.
pub(crate) fn submessages(
    datagram: &[u8],
) -> Option<(GuidPrefix, impl Iterator<Item = Submessage<'_>>)> {
    let mut rest = Cursor::new(datagram, true);
    let [head @ .., _minor, _vendor, _]: [u8; 8] = rest.array()?;
    if head != *b"RTPS\x02" {
        return None;
    }
    let from = GuidPrefix(rest.array()?);
    Some((from, core::iter::from_fn(move || next(&mut rest))))
}

fn next<'m>(rest: &mut Cursor<'m>) -> Option<Submessage<'m>> {
    let [kind, flags] = rest.array()?;
    rest.is_little = flags & flag::LITTLE_ENDIAN != 0;
    let len = match rest.u16()? {
        0 if !matches!(kind, kind::PAD | kind::INFO_TIMESTAMP) => rest.bytes.len(),
        len => len.into(),
    };
    let mut body = Cursor::new(rest.take(len)?, rest.is_little);
    Some(match kind {
        kind::INFO_DESTINATION => Submessage::Destination(GuidPrefix(body.array()?)),
        kind::DATA => {
            let (_extra, to_inline) = (body.u16()?, body.u16()?);
            Submessage::Between(body.ends()?, Part::Data(data(flags, to_inline, body)?))
        }
        kind::HEARTBEAT => Submessage::Between(body.ends()?, heartbeat(flags, body)?),
        kind::ACKNACK => Submessage::Between(body.ends()?, Part::AckNack(body.set()?, body.u32()?)),
        kind::GAP => {
            let ends = body.ends()?;
            let start = body.sequence().filter(|start| *start > 0)?;
            Submessage::Between(ends, Part::Gap(start, body.set()?))
        }
        _ => Submessage::Other,
    })
}

fn heartbeat(flags: u8, mut body: Cursor<'_>) -> Option<Part<'_>> {
    let heartbeat = Heartbeat {
        first: body.sequence()?,
        last: body.sequence()?,
        count: body.u32()?,
        is_final: flags & flag::FINAL != 0,
    };
    let is_range = heartbeat.first > 0 && heartbeat.last + 1 >= heartbeat.first;
    is_range.then_some(Part::Heartbeat(heartbeat))
}

fn data(flags: u8, to_inline: u16, mut body: Cursor<'_>) -> Option<Data<'_>> {
    let sequence = body.sequence().filter(|number| *number > 0)?;
    // Counted from behind its own field, of which 16 bytes are read.
    body.take(usize::from(to_inline).checked_sub(16)?)?;
    let is_sample = flags & flag::SAMPLE != 0;
    let mut ends = !is_sample;
    if flags & flag::INLINE_QOS != 0 {
        let mut list = Parameters::new(body);
        for mut parameter in list.by_ref().filter(|it| it.id == pid::STATUS) {
            // The status is big-endian in each message: the last byte holds the flags.
            let status: Option<[u8; 4]> = parameter.value.array();
            ends |= status.is_some_and(|[.., flags]| flags & 3 != 0);
        }
        body = list.end()?;
    }
    let has_payload = flags & (flag::SAMPLE | flag::KEY) != 0;
    Some(Data {
        sequence,
        is_sample,
        ends,
        payload: if has_payload { body.bytes } else { &[] },
    })
}
