//! gPTP (IEEE 802.1AS) and the end-to-end delay of IEEE 1588: two-step, static roles, sans-IO. S-2
//!
//! A [`Slave`] follows one master and makes [`Sample`](crate::Sample)s. A [`Master`] gives the time
//! that its caller has. There is no election of a master (BMCA): the roles are configured.

mod codec;
mod delay;
mod master;
mod slave;
#[cfg(test)]
mod tests;

use tandem_board::{Duration, Instant};

pub use master::{Master, MasterSettings};
pub use slave::{Followed, Slave, SlaveCounts, SlaveStatus};

/// The EUI-64 of a clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ClockId(pub [u8; 8]);

/// A port of a clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PortIdentity {
    /// The clock.
    pub clock: ClockId,
    /// Number of the port, from 1.
    pub port: u16,
}

impl PortIdentity {
    /// Returns port 1 of the clock that is named by a MAC address.
    #[must_use]
    pub const fn from_mac([a, b, c, d, e, f]: [u8; 6]) -> Self {
        let clock = ClockId([a, b, c, 0xFF, 0xFE, d, e, f]);
        Self { clock, port: 1 }
    }
}

/// How the delay of the link is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DelayMechanism {
    /// 802.1AS: both ends of a link ask each other, with the ratio of their rates.
    Peer,
    /// The slave asks its master: ((t4 − t3) + (t2 − t1)) / 2.
    EndToEnd,
}

/// What both ends must agree on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PtpProfile {
    /// The major sdoId (transportSpecific), 0 to 15: 1 in 802.1AS.
    pub sdo: u8,
    /// The domain.
    pub domain: u8,
    /// How the delay is measured.
    pub delay: DelayMechanism,
}

impl PtpProfile {
    /// 802.1AS in domain 0.
    pub const GPTP: Self = Self {
        sdo: 1,
        domain: 0,
        delay: DelayMechanism::Peer,
    };
    /// IEEE 1588 in domain 0 with the end-to-end delay.
    pub const END_TO_END: Self = Self {
        sdo: 0,
        domain: 0,
        delay: DelayMechanism::EndToEnd,
    };
}

/// What a master says of its grandmaster. IEEE 1588-2019, 7.6
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Claims {
    /// The time is TAI. Otherwise only the master knows its origin.
    pub is_ptp_timescale: bool,
    /// clockClass: 6 follows a primary reference, 248 none.
    pub class: u8,
    /// clockAccuracy: 0x20 is 25 ns, 0x31 more than 10 s, 0xFE unknown.
    pub accuracy: u8,
    /// priority1; the lower wins an election, in which this crate takes no part.
    pub priority: u8,
}

impl Default for Claims {
    /// A clock that follows nothing.
    fn default() -> Self {
        Self {
            is_ptp_timescale: false,
            class: 248,
            accuracy: 0xFE,
            priority: 128,
        }
    }
}

/// How a slave works. Start from [`SlaveSettings::new`].
#[derive(Clone, Copy, Debug)]
pub struct SlaveSettings {
    /// The own port.
    pub identity: PortIdentity,
    /// What it has in common with its master.
    pub profile: PtpProfile,
    /// The only clock to follow; `None` follows the first that is heard.
    pub master: Option<ClockId>,
    /// What is true of a master that sends no Announce, as with a static configuration; `None`
    /// waits for its Announce.
    pub unannounced: Option<Claims>,
    /// A master without Sync and Follow_Up for this time is given up.
    pub time_out: Duration,
    /// Period of the requests for the delay.
    pub ask_every: Duration,
    /// A longer delay is refused: the link is not what it should be.
    pub max_delay: Duration,
    /// How much one stamp errs by.
    pub stamp_error: Duration,
}

impl SlaveSettings {
    /// Settings for stamps in software: ask each second, time-out 3 s, delay up to 1 ms, stamps
    /// that err by 10 µs.
    #[must_use]
    pub const fn new(identity: PortIdentity, profile: PtpProfile) -> Self {
        Self {
            identity,
            profile,
            master: None,
            unannounced: None,
            time_out: Duration::from_ms(3_000),
            ask_every: Duration::from_ms(1_000),
            // 800 ns, as 802.1AS has it for copper, is below any delay that software measures.
            max_delay: Duration::from_ms(1),
            stamp_error: Duration::from_us(10),
        }
    }
}

/// Names an event message: one whose time of sending its sender must learn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EventId {
    kind: u8,
    sequence: u16,
}

impl EventId {
    /// Returns the id of a message that was given to a [`TimeOutlet`]; `None` if it is no event.
    #[must_use]
    pub fn of(message: &[u8]) -> Option<Self> {
        codec::event(message)
    }
}

/// What a slave or a master wants sent.
pub trait TimeOutlet {
    /// Sends a message to all on the link. One that cannot be sent is lost. With an `event`, the
    /// caller passes the time when the message left to `on_sent`, as soon as it knows it.
    fn send(&mut self, message: &[u8], event: Option<EventId>);
}

/// Why a slave has no samples. A later variant is nearer to a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Why {
    /// No master was heard since the start, or for the time-out.
    Silent,
    /// Bytes were no message of PTP version 2.
    Malformed,
    /// Messages have another major sdoId: one end is 802.1AS, the other one IEEE 1588.
    OtherProfile,
    /// Messages are of another domain.
    OtherDomain,
    /// Another master than the configured one was heard.
    OtherMaster,
    /// Sync was heard, but no Announce.
    NoAnnounce,
    /// The master's time scale (flag PTP_TIMESCALE) is not the one that is wanted.
    OtherScale,
    /// The followed port announces another grandmaster. After the time-out it is followed.
    OtherGrandmaster,
    /// The master sends Sync without the two-step flag.
    OneStep,
    /// No Sync has its Follow_Up yet.
    NoFollowUp,
    /// The board does not tell when requests left.
    NoStamp,
    /// Requests for the delay are not answered: the other end may use the other mechanism.
    NoAnswer,
    /// More than one port answers requests for the peer delay. 802.1AS, 11.2.17
    ManyPeers,
    /// The clocks' rates differ by more than 200 ppm: a stamp is wrong, or a clock has jumped.
    WildRate,
    /// The measured delay is negative.
    NegativeDelay,
    /// The measured delay is above `max_delay` of the settings.
    DelayAboveThreshold,
}

impl core::fmt::Display for Why {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Silent => "no master is heard",
            Self::Malformed => "bytes are no message of PTP version 2",
            Self::OtherProfile => "messages have another major sdoId",
            Self::OtherDomain => "messages are of another domain",
            Self::OtherMaster => "another master than the configured one is heard",
            Self::NoAnnounce => "Sync is heard, but no Announce",
            Self::OtherScale => "the time scale of the master is not the one that is wanted",
            Self::OtherGrandmaster => "the followed port announces another grandmaster",
            Self::OneStep => "the master sends Sync without the two-step flag",
            Self::NoFollowUp => "no Sync has its Follow_Up yet",
            Self::NoStamp => "the board does not tell when requests left",
            Self::NoAnswer => "requests for the delay are not answered",
            Self::ManyPeers => "more than one port answers requests for the peer delay",
            Self::WildRate => "the rates of the clocks differ by more than 200 ppm",
            Self::NegativeDelay => "the measured delay is negative",
            Self::DelayAboveThreshold => "the measured delay is above the largest permitted one",
        })
    }
}

impl core::error::Error for Why {}

/// Returns the next time of a period that is due; it does not catch up with what was missed.
fn next(due: Instant, every: Duration, now: Instant) -> Instant {
    (due + every).max(now + Duration::from_ns(every.as_ns() / 2))
}
