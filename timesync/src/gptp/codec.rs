//! Messages of PTP version 2 on the wire: IEEE 1588-2019, clause 13; IEEE 802.1AS-2020, clauses 10
//! and 11. All numbers are big-endian.

use super::{Claims, ClockId, DelayMechanism, EventId, PortIdentity, PtpProfile, TimeOutlet, Why};

/// The longest message that is sent: Follow_Up with its TLV.
const LONGEST: usize = 76;
const HEADER: usize = 34;
const TWO_STEP: u16 = 0x0200;
const PTP_TIMESCALE: u16 = 0x0008;
/// The TLV in a Follow_Up of 802.1AS: type, length, organisation, subtype; then rate and changes of
/// the grandmaster, of which a master of one hop knows none.
const FOLLOW_UP_TLV: [u8; 32] = {
    let mut tlv = [0; 32];
    (tlv[1], tlv[3], tlv[5], tlv[6], tlv[9]) = (3, 28, 0x80, 0xC2, 1);
    tlv
};
/// What an Announce of ours says last: no steps removed, an oscillator of its own.
const OWN_CLOCK: [u8; 3] = [0, 0, 0xA0];
const NS: u64 = 1_000_000_000;

/// What kind of message it is, and what this kind carries. Times are nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Body {
    Sync,
    DelayRequest,
    PeerRequest,
    /// t2 and the port that asked.
    PeerResponse(u64, PortIdentity),
    /// t1.
    FollowUp(u64),
    /// t4 and the port that asked.
    DelayResponse(u64, PortIdentity),
    /// t3 and the port that asked.
    PeerResponseFollowUp(u64, PortIdentity),
    /// The grandmaster, and what is said of it.
    Announce(ClockId, Claims),
    /// Signaling and management.
    Other,
}

/// A message of which header and body were checked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Message {
    pub(super) source: PortIdentity,
    pub(super) sequence: u16,
    pub(super) is_two_step: bool,
    /// 2^-16 ns.
    pub(super) correction: i64,
    pub(super) body: Body,
}

impl Message {
    /// Creates a message to be sent.
    pub(super) const fn new(source: PortIdentity, sequence: u16, body: Body) -> Self {
        Self {
            source,
            sequence,
            is_two_step: matches!(body, Body::Sync | Body::PeerResponse(..)),
            correction: 0,
            body,
        }
    }
}

/// What has not been read yet.
struct Reader<'m>(&'m [u8]);

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (first, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*first)
    }

    fn u16(&mut self) -> Option<u16> {
        self.take().map(u16::from_be_bytes)
    }

    fn port(&mut self) -> Option<PortIdentity> {
        let clock = ClockId(self.take()?);
        let port = self.u16()?;
        Some(PortIdentity { clock, port })
    }

    /// Reads 48 bits of seconds and 32 bits of nanoseconds; `None` after the year 2554.
    fn time(&mut self) -> Option<u64> {
        let high = u64::from(self.u16()?) << 32;
        let seconds = high | u64::from(u32::from_be_bytes(self.take()?));
        let ns = u64::from(u32::from_be_bytes(self.take()?));
        let whole = seconds.checked_mul(NS)?.checked_add(ns)?;
        (ns < NS).then_some(whole)
    }

    fn announce(&mut self, flags: u16) -> Option<Body> {
        let [.., priority, class, accuracy] = self.take::<16>()?;
        let [_, _, _] = self.take()?;
        let grandmaster = ClockId(self.take()?);
        let steps = self.u16()?;
        let [_] = self.take()?;
        let is_ptp_timescale = flags & PTP_TIMESCALE != 0;
        let claims = Claims {
            is_ptp_timescale,
            class,
            accuracy,
            priority,
        };
        // 255 steps: it went in a circle. IEEE 1588, 9.3.2.5
        (steps < 255).then_some(Body::Announce(grandmaster, claims))
    }
}

/// Reads a message. Bytes behind its length, such as the padding of a frame, are ignored.
///
/// # Errors
/// Says why it is not for a port of this profile.
pub(super) fn decode(bytes: &[u8], profile: PtpProfile) -> Result<Message, Why> {
    let mut head = Reader(bytes);
    let begin = |head: &mut Reader<'_>| {
        let [kind, version] = head.take()?;
        let len = head.u16()?;
        let [domain, _] = head.take()?;
        let content = bytes.get(HEADER..len.into())?;
        (version & 0xF == 2).then_some((kind, domain, content))
    };
    let (kind, domain, content) = begin(&mut head).ok_or(Why::Malformed)?;
    if kind >> 4 != profile.sdo {
        return Err(Why::OtherProfile);
    }
    if domain != profile.domain {
        return Err(Why::OtherDomain);
    }
    read(kind & 0xF, head, Reader(content)).ok_or(Why::Malformed)
}

fn read(kind: u8, mut head: Reader<'_>, mut content: Reader<'_>) -> Option<Message> {
    let flags = head.u16()?;
    let correction = i64::from_be_bytes(head.take()?);
    let [_, _, _, _] = head.take()?;
    let source = head.port()?;
    let sequence = head.u16()?;
    let body = match kind {
        0x0 => content.take::<10>().map(|_| Body::Sync)?,
        0x1 => content.take::<10>().map(|_| Body::DelayRequest)?,
        0x2 => content.take::<20>().map(|_| Body::PeerRequest)?,
        0x3 => Body::PeerResponse(content.time()?, content.port()?),
        0x8 => Body::FollowUp(content.time()?),
        0x9 => Body::DelayResponse(content.time()?, content.port()?),
        0xA => Body::PeerResponseFollowUp(content.time()?, content.port()?),
        0xB => content.announce(flags)?,
        _ => Body::Other,
    };
    let message = Message {
        source,
        sequence,
        is_two_step: flags & TWO_STEP != 0,
        correction,
        body,
    };
    // The largest number stands for a correction that is too large for it.
    (correction < i64::MAX).then_some(message)
}

/// Returns kind and sequence number of an event message.
pub(super) fn event(bytes: &[u8]) -> Option<EventId> {
    let [kind, ..] = Reader(bytes).take::<HEADER>()?;
    let sequence = Reader(bytes.get(30..)?).u16()?;
    let kind = kind & 0xF;
    (kind <= 3).then_some(EventId { kind, sequence })
}

/// A message that is being written.
struct Frame {
    bytes: [u8; LONGEST],
    len: usize,
}

impl Frame {
    fn put(&mut self, bytes: &[u8]) -> &mut Self {
        let places = self.bytes.iter_mut().skip(self.len);
        places.zip(bytes).for_each(|(place, byte)| *place = *byte);
        self.len += bytes.len();
        self
    }

    fn time(&mut self, ns: u64) -> &mut Self {
        let [_, _, seconds @ ..] = (ns / NS).to_be_bytes();
        self.put(&seconds).put(&((ns % NS) as u32).to_be_bytes())
    }

    fn port(&mut self, it: PortIdentity) -> &mut Self {
        self.put(&it.clock.0).put(&it.port.to_be_bytes())
    }
}

/// Sends a message. `interval`: the exponent of its period, s. Returns its id if it is an event.
pub(super) fn send(
    profile: PtpProfile,
    message: &Message,
    interval: i8,
    out: &mut impl TimeOutlet,
) -> Option<EventId> {
    let mut flags = if message.is_two_step { TWO_STEP } else { 0 };
    let (kind, len, control) = match message.body {
        Body::Sync | Body::Other => (0x0, 44, 0),
        Body::DelayRequest => (0x1, 44, 1),
        Body::PeerRequest => (0x2, 54, 5),
        Body::PeerResponse(..) => (0x3, 54, 5),
        Body::FollowUp(..) if profile.delay == DelayMechanism::Peer => (0x8, 76, 2),
        Body::FollowUp(..) => (0x8, 44, 2),
        Body::DelayResponse(..) => (0x9, 54, 3),
        Body::PeerResponseFollowUp(..) => (0xA, 54, 5),
        Body::Announce(_, claims) => {
            flags |= if claims.is_ptp_timescale {
                PTP_TIMESCALE
            } else {
                0
            };
            (0xB, 64, 5)
        }
    };
    let bytes = [0; LONGEST];
    let mut frame = Frame { bytes, len: 0 };
    frame
        .put(&[profile.sdo << 4 | kind, 2, 0, len, profile.domain, 0])
        .put(&flags.to_be_bytes())
        .put(&message.correction.to_be_bytes())
        .put(&[0; 4])
        .port(message.source)
        .put(&message.sequence.to_be_bytes())
        .put(&[control, interval as u8]);
    match &message.body {
        Body::Sync | Body::DelayRequest | Body::Other => frame.put(&[0; 10]),
        Body::PeerRequest => frame.put(&[0; 20]),
        Body::FollowUp(time) if len == 44 => frame.time(*time),
        Body::FollowUp(time) => frame.time(*time).put(&FOLLOW_UP_TLV),
        Body::PeerResponse(time, port)
        | Body::DelayResponse(time, port)
        | Body::PeerResponseFollowUp(time, port) => frame.time(*time).port(*port),
        Body::Announce(grandmaster, it) => frame
            .put(&[0; 13])
            .put(&[it.priority, it.class, it.accuracy, 0xFF, 0xFF, it.priority])
            .put(&grandmaster.0)
            .put(&OWN_CLOCK),
    };
    let bytes = frame.bytes.get(..frame.len).unwrap_or_default();
    let event = event(bytes);
    out.send(bytes, event);
    event
}

/// Rounds a correction to nanoseconds.
pub(super) const fn correction_ns(correction: i64) -> i64 {
    correction.saturating_add(1 << 15) >> 16
}
