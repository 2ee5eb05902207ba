//! Time over CAN in AUTOSAR's layout: SYNC tells a second, and the follow-up (FUP) which time it
//! really was when SYNC was on the bus. S-4
//!
//! | byte | SYNC | FUP |
//! |---|---|---|
//! | 0 | 0x10, with CRC 0x20 | 0x18, with CRC 0x28 |
//! | 1 | CRC; user byte 1 without | CRC; user byte 2 without |
//! | 2 | domain, high nibble; sequence counter, low nibble | the same |
//! | 3 | user byte 0 | bit 2 SGW; bits 1 and 0 OVS, seconds to add; others reserved |
//! | 4..8 | seconds, low 32 bits, big-endian | nanoseconds, below 10⁹, big-endian |
//!
//! The CRC is CRC-8H2F over bytes 2 to 7 and then the data id, the entry of a list of 16 at the
//! sequence counter. The slave's time at its stamp of SYNC is seconds + OVS + nanoseconds.
//!
//! Source: AUTOSAR CP R20-11, *Specification of Time Synchronization over CAN* (document 674). Its
//! text was not at hand. Layout and CRC were compared with two implementations: TIER IV's driver of
//! the radar SRR520 and iSOFT's CanTSyn. CRC and use of the list give AUTOSAR's published values
//! (see the tests). Periods, time-outs and lists are configuration there, and constants here.
//!
//! SYNC and FUP of a system share a CAN id, and each system has an own one: a bus carries no two
//! senders of one id, and a slave must know whose frame it is.
//!
//! Stricter than AUTOSAR: a SYNC that arrives twice is dropped, not taken at its first time. CAN
//! repeats a frame whose last bit was disturbed, which some receivers have accepted before: their
//! stamp is then a frame earlier than the sender's. And a sample must follow from those before it
//! (`continuity.rs`): a corrupted frame has a right CRC once in 256 times. What passes all
//! the same is at most 0.2 ms wrong, or 1 ms after a second without samples.

use crate::continuity::{Continuity, Verdict};
use crate::{GlobalTime, Sample, Scale};
use crc::{CRC_8_AUTOSAR, Crc};
use tandem_board::{Duration, Instant, SystemId};

/// The only time domain, 0, in the high nibble.
const DOMAIN: u8 = 0x00;
/// From one SYNC to the next.
const PERIOD: Duration = Duration::from_ms(100);
/// From SYNC on the bus to its FUP: a receiver with one buffer an id fetches SYNC in this time.
const DEBOUNCE: Duration = Duration::from_ms(5);
/// The longest time from SYNC to its FUP, at a slave.
const FOLLOW_UP_TIMEOUT: Duration = Duration::from_ms(50);
/// A master is silent if it sends no SYNC for this time: three in a row are lost.
const SILENCE: Duration = Duration::from_ms(350);
/// The longest step of the sequence counter between two SYNC of a master that is not silent.
const MAX_JUMP: u8 = 3;
/// What the stamps of a frame at two controllers may differ by: a bit at 500 kbit/s.
const RESOLUTION: Duration = Duration::from_us(2);
/// What the stamps of two frames may differ by besides that: latencies of the interrupt.
const STAMP_NOISE: Duration = Duration::from_us(100);

const SECOND_NS: u64 = 1_000_000_000;
/// SGW: the master's time is that of a gateway, not of the master of the whole network.
const TO_GATEWAY: u8 = 0b100;
const OVERFLOW: u8 = 0b11;
/// CRC-8H2F is called AUTOSAR in the catalogue of CRCs.
const CRC: Crc<u8> = Crc::<u8>::new(&CRC_8_AUTOSAR);

/// A frame of time synchronisation: 8 bytes, under the id of its system.
pub type CanTimeFrame = [u8; 8];

/// Which frames a slave accepts: `CanTSynRxCrcValidated` of AUTOSAR.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CanTimeCrc {
    /// With a right CRC only.
    Validated,
    /// Without CRC only.
    NotValidated,
    /// With a right CRC, and without.
    Optional,
    /// All.
    Ignored,
}

/// What a frame says. SYNC: `flags` is user byte 0, `value` seconds. FUP: SGW and OVS, nanoseconds.
#[derive(Clone, Copy, Debug)]
struct Message {
    is_follow_up: bool,
    is_secured: bool,
    counter: u8,
    flags: u8,
    value: u32,
}

impl Message {
    fn encode(self, from: SystemId) -> CanTimeFrame {
        let [a, b, c, d] = self.value.to_be_bytes();
        let kind = if self.is_secured { 0x20 } else { 0x10 };
        let kind = kind | u8::from(self.is_follow_up) << 3;
        let mut frame = [kind, 0, DOMAIN | self.counter, self.flags, a, b, c, d];
        if self.is_secured {
            frame[1] = checksum(from, &frame);
        }
        frame
    }

    fn decode(from: SystemId, crc: CanTimeCrc, bytes: &[u8]) -> Result<Self, CanTimeRefusal> {
        let Ok(frame) = CanTimeFrame::try_from(bytes) else {
            return Err(CanTimeRefusal::Layout);
        };
        let [
            kind @ (0x10 | 0x18 | 0x20 | 0x28),
            sum,
            place,
            flags,
            value @ ..,
        ] = frame
        else {
            return Err(CanTimeRefusal::Layout);
        };
        let is_secured = kind & 0x20 != 0;
        let is_right = sum == checksum(from, &frame);
        let is_accepted = match crc {
            CanTimeCrc::Validated => is_secured && is_right,
            CanTimeCrc::NotValidated => !is_secured,
            CanTimeCrc::Optional => !is_secured || is_right,
            CanTimeCrc::Ignored => true,
        };
        if !is_accepted {
            return Err(CanTimeRefusal::Crc);
        }
        if place & 0xF0 != DOMAIN {
            return Err(CanTimeRefusal::Domain);
        }
        Ok(Self {
            is_follow_up: kind & 0x08 != 0,
            is_secured,
            counter: place & 0x0F,
            flags,
            value: u32::from_be_bytes(value),
        })
    }
}

/// Returns the CRC of a frame. The lists of data ids: 0..16 for SYNC of A, 16..32 for FUP of A,
/// 32..48 for SYNC of B, 48..64 for FUP of B. All differ, so a frame under a wrong id, kind or
/// counter has a wrong CRC.
fn checksum(from: SystemId, frame: &CanTimeFrame) -> u8 {
    let data_id = (from.index() as u8) << 5 | (frame[0] & 0x08) << 1 | frame[2] & 0x0F;
    let mut digest = CRC.digest();
    digest.update(&frame[2..]);
    digest.update(&[data_id]);
    digest.finalize()
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    Idle,
    /// SYNC with these seconds was given to the caller at this time.
    Handed(u32, Instant),
    /// SYNC was on the bus. The FUP is due.
    OnBus(CanTimeFrame, Instant),
}

/// The sender of SYNC and FUP.
#[derive(Clone, Copy, Debug)]
pub struct CanTimeMaster {
    system: SystemId,
    is_secured: bool,
    counter: u8,
    due: Instant,
    phase: Phase,
}

impl CanTimeMaster {
    /// Makes a master whose first SYNC is due at `now`. `is_secured`: with a CRC.
    #[must_use]
    pub const fn new(system: SystemId, is_secured: bool, now: Instant) -> Self {
        Self {
            system,
            is_secured,
            counter: 0x0F,
            due: now,
            phase: Phase::Idle,
        }
    }

    /// Returns when [`CanTimeMaster::poll`] has something to do.
    #[must_use]
    pub fn due(&self) -> Instant {
        match self.phase {
            Phase::OnBus(_, due) => due.min(self.due),
            _ => self.due,
        }
    }

    /// Returns the frame to send now. `time`: global time at `now`. In seconds that need more than
    /// 32 bits, from the year 2106 on in TAI, it sends nothing.
    pub fn poll<S: Scale>(&mut self, now: Instant, time: GlobalTime<S>) -> Option<CanTimeFrame> {
        if now >= self.due {
            self.due = now + PERIOD;
            self.phase = Phase::Idle;
            self.counter = (self.counter + 1) & 0x0F;
            let seconds = u32::try_from(time.as_ns() / SECOND_NS).ok()?;
            self.phase = Phase::Handed(seconds, now);
            return Some(self.message(false, 0, seconds));
        }
        match self.phase {
            Phase::OnBus(follow_up, due) if now >= due => {
                self.phase = Phase::Idle;
                Some(follow_up)
            }
            _ => None,
        }
    }

    /// Takes when the newest frame of [`CanTimeMaster::poll`] was on the bus. `at`: the
    /// controller's stamp; `time`: global time then; `is_to_gateway`: that time comes from a
    /// gateway. Call it as soon as there is a stamp; more calls are harmless. If the time has leapt
    /// since `poll`, SYNC has no FUP.
    pub fn on_sent<S: Scale>(&mut self, at: Instant, time: GlobalTime<S>, is_to_gateway: bool) {
        let Phase::Handed(seconds, handed) = self.phase else {
            return;
        };
        if at < handed {
            return;
        }
        self.phase = Phase::Idle;
        let begin = u64::from(seconds) * SECOND_NS;
        let Some(since) = time.as_ns().checked_sub(begin) else {
            return;
        };
        let (overflow, ns) = (since / SECOND_NS, since % SECOND_NS);
        if overflow <= OVERFLOW.into() {
            let gateway = if is_to_gateway { TO_GATEWAY } else { 0 };
            let follow_up = self.message(true, gateway | overflow as u8, ns as u32);
            self.phase = Phase::OnBus(follow_up, at + DEBOUNCE);
        }
    }

    fn message(&self, is_follow_up: bool, flags: u8, value: u32) -> CanTimeFrame {
        let (is_secured, counter) = (self.is_secured, self.counter);
        let message = Message {
            is_follow_up,
            is_secured,
            counter,
            flags,
            value,
        };
        message.encode(self.system)
    }
}

/// What a slave learns from SYNC and FUP.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CanTime<S: Scale> {
    /// The time of SYNC on both clocks.
    pub sample: Sample<S>,
    /// Who sent it.
    pub from: SystemId,
    /// The master's time is that of a gateway.
    pub is_to_gateway: bool,
}

/// Why a frame is not used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CanTimeRefusal {
    /// Its length or its type is not one of time synchronisation.
    Layout,
    /// Its CRC is wrong, or missing, or unwanted.
    Crc,
    /// It is of another time domain.
    Domain,
    /// The slave follows the other system, which is not silent.
    OtherMaster,
    /// A SYNC whose counter has jumped. The next one is judged against it.
    Counter,
    /// A SYNC with the counter of the last one. Neither of the two is used.
    Doubled,
    /// A FUP whose SYNC was not received, or is used.
    NoSync,
    /// A FUP too long after its SYNC.
    Late,
    /// A FUP with a second of nanoseconds or more.
    Range,
    /// The first samples are not given on.
    Learning,
    /// The global time is this much later than the samples before say, ns.
    OutOfLine(i64),
}

impl core::fmt::Display for CanTimeRefusal {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let text = match self {
            Self::Layout => "its length or type is not one of time synchronisation",
            Self::Crc => "its CRC is wrong, missing or unwanted",
            Self::Domain => "it is of another time domain",
            Self::OtherMaster => "the other system is followed",
            Self::Counter => "its counter has jumped",
            Self::Doubled => "its counter is that of the last SYNC",
            Self::NoSync => "it has no SYNC",
            Self::Late => "it came too long after its SYNC",
            Self::Range => "its nanoseconds are a second or more",
            Self::Learning => "the first samples are not given on",
            Self::OutOfLine(ns) => return write!(f, "its time is {ns} ns later than expected"),
        };
        f.write_str(text)
    }
}

impl core::error::Error for CanTimeRefusal {}

/// The receiver of SYNC and FUP.
#[derive(Clone, Copy, Debug)]
pub struct CanTimeSlave<S: Scale> {
    crc: CanTimeCrc,
    /// The master, when its last SYNC came, and with which counter.
    followed: Option<(SystemId, Instant, u8)>,
    /// The last SYNC, until its FUP.
    sync: Option<Message>,
    line: Continuity<S, ()>,
}

impl<S: Scale> CanTimeSlave<S> {
    /// Makes a slave that follows the first master that it hears.
    #[must_use]
    pub const fn new(crc: CanTimeCrc) -> Self {
        Self {
            crc,
            followed: None,
            sync: None,
            line: Continuity::NEW,
        }
    }

    /// Takes a frame with the id of system `from`. `at`: the controller's stamp. Returns `None` for
    /// a SYNC that waits for its FUP.
    ///
    /// # Errors
    /// [`CanTimeRefusal`]: the frame is not used.
    pub fn receive(
        &mut self,
        from: SystemId,
        at: Instant,
        bytes: &[u8],
    ) -> Result<Option<CanTime<S>>, CanTimeRefusal> {
        let message = Message::decode(from, self.crc, bytes)?;
        let speaks = |heard| at >= heard && at.since(heard) <= SILENCE;
        self.followed = self.followed.filter(|&(_, heard, _)| speaks(heard));
        if self.followed.is_some_and(|(master, ..)| master != from) {
            return Err(CanTimeRefusal::OtherMaster);
        }
        if message.is_follow_up {
            return self.follow_up(from, at, message).map(Some);
        }
        let last = self.followed.replace((from, at, message.counter));
        let jump = last.map_or(1, |(.., last)| message.counter.wrapping_sub(last) & 0x0F);
        self.sync = (1..=MAX_JUMP).contains(&jump).then_some(message);
        match jump {
            0 => Err(CanTimeRefusal::Doubled),
            1..=MAX_JUMP => Ok(None),
            _ => Err(CanTimeRefusal::Counter),
        }
    }

    fn follow_up(
        &mut self,
        from: SystemId,
        at: Instant,
        message: Message,
    ) -> Result<CanTime<S>, CanTimeRefusal> {
        let belongs = |sync: &Message| {
            (sync.counter, sync.is_secured) == (message.counter, message.is_secured)
        };
        let (Some(sync), Some((_, heard, _))) = (self.sync.filter(belongs), self.followed) else {
            return Err(CanTimeRefusal::NoSync);
        };
        self.sync = None;
        if at.since(heard) > FOLLOW_UP_TIMEOUT {
            return Err(CanTimeRefusal::Late);
        }
        let ns = u64::from(message.value);
        if ns >= SECOND_NS {
            return Err(CanTimeRefusal::Range);
        }
        let seconds = u64::from(sync.value) + u64::from(message.flags & OVERFLOW);
        let sample = Sample {
            local: heard,
            global: GlobalTime::from_ns(seconds * SECOND_NS + ns),
            error: RESOLUTION,
        };
        let is_to_gateway = message.flags & TO_GATEWAY != 0;
        match self.line.judge(sample, (), STAMP_NOISE, true) {
            Verdict::InLine => Ok(CanTime {
                sample,
                from,
                is_to_gateway,
            }),
            Verdict::Learning => Err(CanTimeRefusal::Learning),
            Verdict::Out(by) => Err(CanTimeRefusal::OutOfLine(by)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Arbitrary;
    use proptest::prelude::*;

    type Time = GlobalTime<Arbitrary>;
    const MS: u64 = 1_000_000;

    fn at(ms: u64) -> Instant {
        Instant::from_ns(MS * ms)
    }

    /// S-4: the vectors of AUTOSAR's CRC library, and of E2E profile 2 with data ids 1 to 16 and
    /// counter 1, which puts its list to use in the same way.
    #[test]
    fn crc_8h2f_of_published_vectors() {
        assert_eq!(CRC.checksum(&[0; 4]), 0x12);
        assert_eq!(CRC.checksum(&[0xF2, 0x01, 0x83]), 0xC2);
        assert_eq!(CRC.checksum(&[0x0F, 0xAA, 0x00, 0x55]), 0xC6);
        assert_eq!(CRC.checksum(&[1, 0, 0, 0, 0, 0, 0, 2]), 0x1B);
    }

    /// S-4: FUP has SGW, the seconds since that of SYNC and the nanoseconds, and keeps a distance.
    /// If the time has leapt, here by 3.1 s forwards or 0.901 s back, there is none.
    #[test]
    fn a_master_follows_up_the_time_on_the_bus() {
        let mut master = CanTimeMaster::new(SystemId::B, false, at(100));
        for (n, on_bus_ms, is_to_gateway, expected) in [
            (
                0,
                5_901,
                false,
                Some([0x18, 0, 0, 0b000, 0x35, 0xB4, 0x2B, 0x40]),
            ),
            (
                1,
                8_999,
                true,
                Some([0x18, 0, 1, 0b111, 0x3B, 0x8B, 0x87, 0xC0]),
            ),
            (2, 9_000, true, None),
            (3, 4_999, true, None),
        ] {
            let (now, time) = (at(100 * n + 100), Time::from_ns(on_bus_ms * MS));
            assert_eq!(master.poll(Instant::from_ns(now.as_ns() - 1), time), None);
            let sync = master.poll(now, Time::from_ns(5_900 * MS)).unwrap();
            assert_eq!(sync, [0x10, 0, n as u8, 0, 0, 0, 0, 5]);
            master.on_sent(Instant::from_ns(now.as_ns() - 1), time, false);
            assert_eq!(master.due(), at(100 * n + 200));
            master.on_sent(now, time, is_to_gateway);
            let due = expected.map_or(at(100 * n + 200), |_| at(100 * n + 105));
            assert_eq!(master.due(), due);
            assert_eq!(master.poll(Instant::from_ns(due.as_ns() - 1), time), None);
            assert_eq!(expected.and_then(|_| master.poll(due, time)), expected);
            assert_eq!(master.due(), at(100 * n + 200));
        }
    }

    /// S-4: 32 bits hold the seconds up to the year 2106; counters wrap after 15.
    #[test]
    fn a_master_ends_with_its_seconds() {
        let mut master = CanTimeMaster::new(SystemId::A, true, at(0));
        let last = Time::from_ns((SECOND_NS << 32) - 1);
        let mut poll = |n: u64| master.poll(at(100 * n), last);
        assert!((0..17u64).all(|n| poll(n).is_some_and(|sync| sync[2] == n as u8 & 0x0F)));
        assert_eq!(master.poll(at(1_700), last.moved(1)), None);
    }

    proptest! {
        /// S-4: any bytes at any time are taken or refused, and never cause a panic.
        #[test]
        fn any_bytes_are_allowed(
            frames in prop::collection::vec(
                (any::<bool>(), any::<u64>(), prop::collection::vec(any::<u8>(), 6..10),
                 prop::sample::select(&[0x10, 0x18, 0x20, 0x28, 0x44][..])), 9),
        ) {
            let mut slave = CanTimeSlave::<Arbitrary>::new(CanTimeCrc::Ignored);
            for (is_b, ns, mut bytes, kind) in frames {
                let from = if is_b { SystemId::B } else { SystemId::A };
                bytes[0] = kind;
                bytes[2] &= 0x0F;
                let _ = slave.receive(from, Instant::from_ns(ns), &bytes);
            }
        }
    }
}
