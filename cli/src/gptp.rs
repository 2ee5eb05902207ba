//! The ends of gPTP beside a run's controller: the grandmaster, and the slave of the SoC. S-2
//!
//! Both have the clock of the machine, CLOCK_MONOTONIC, as each core of the run has. So an offset
//! that a slave finds is its own error. Nothing here sets a clock.

use std::io;

use tandem_board::{Channel, Instant, Recipient};
use tandem_board_host::{StampedUdp, clock};
use tandem_board_udp::UdpPlace;
use tandem_cores::core0::TimeSource;
use tandem_record::log::{ClockSample, ClockState, SocTime};
use tandem_timesync::gptp::{
    Claims, EventId, Master, MasterSettings, PortIdentity, PtpProfile, Slave, SlaveSettings,
    TimeOutlet,
};
use tandem_timesync::{Arbitrary, BaseConfig, GlobalTime, Heard, MasterQuality, Scale, TimeBase};

/// Exponent of the period of Sync, s: 125 ms, as IEEE 802.1AS has it.
const SYNC: i8 = -3;
/// Longer than any message that is read, bytes.
const LONGEST: usize = 128;

/// The channel, as an end sends on it.
struct Port {
    udp: StampedUdp,
    /// When event messages left, until the end is told.
    sent: Vec<(EventId, Instant)>,
}

impl Port {
    fn open(place: UdpPlace) -> io::Result<Self> {
        Ok(Self {
            udp: StampedUdp::open(place, Channel::Time)?,
            sent: vec![],
        })
    }
}

impl TimeOutlet for Port {
    fn send(&mut self, message: &[u8], event: Option<EventId>) {
        let sent = self.udp.send(Recipient::Everyone, message);
        self.sent.extend(event.zip(sent.ok()));
    }
}

/// Returns an identity that differs from those of other processes of the machine.
fn identity() -> PortIdentity {
    let [_, a, b, c] = std::process::id().to_be_bytes();
    // A MAC address that is locally administered.
    PortIdentity::from_mac([0x02, 0x67, 0x6D, a, b, c])
}

/// A grandmaster. Its time is that of the machine's monotonic clock and a constant, so it never
/// leaps.
pub(crate) struct Grandmaster<S: Scale> {
    master: Master<S>,
    port: Port,
    ahead_ns: u64,
}

impl<S: Scale> Grandmaster<S> {
    /// Opens its port. Its time is `ahead_ns` later than the monotonic clock.
    ///
    /// # Errors
    /// As [`StampedUdp::open`].
    pub(crate) fn open(place: UdpPlace, ahead_ns: u64) -> io::Result<Self> {
        let settings = MasterSettings {
            identity: identity(),
            profile: PtpProfile::END_TO_END,
            claims: Claims::default(),
            sync_exponent: SYNC,
        };
        Ok(Self {
            master: Master::new(settings),
            port: Port::open(place)?,
            ahead_ns,
        })
    }

    /// Returns how many messages of other masters it has heard; the count wraps.
    pub(crate) const fn others(&self) -> u32 {
        self.master.others
    }

    /// Sends what is due, and answers what arrives until then, or until `latest`.
    pub(crate) fn turn(&mut self, latest: Instant) {
        let Self {
            master,
            port,
            ahead_ns,
        } = self;
        let ahead_ns = *ahead_ns;
        let global = |at: Instant| Some(GlobalTime::from_ns(at.as_ns() + ahead_ns));
        let due = master.poll(clock::now(), global, port);
        tell_sent(master, port, global);
        port.udp.wait(due.min(latest));
        let mut bytes = [0; LONGEST];
        while let Some(it) = port.udp.receive(&mut bytes) {
            master.on_message(it.at, &bytes[..it.len], global, port);
        }
        tell_sent(master, port, global);
    }
}

fn tell_sent<S: Scale>(
    master: &mut Master<S>,
    port: &mut Port,
    global: impl Copy + Fn(Instant) -> Option<GlobalTime<S>>,
) {
    while let Some((event, at)) = port.sent.pop() {
        master.on_sent(event, at, global, port);
    }
}

/// Returns the nearest number that a record holds.
fn clamped(ns: i64) -> i32 {
    ns.clamp(i32::MIN.into(), i32::MAX.into()) as i32
}

/// The time of a process that follows the grandmaster.
pub(crate) struct Follower {
    slave: Slave<Arbitrary>,
    base: TimeBase<Arbitrary>,
    port: Port,
    sample: Option<ClockSample>,
}

impl Follower {
    /// Opens its port.
    ///
    /// # Errors
    /// As [`StampedUdp::open`].
    pub(crate) fn open(place: UdpPlace) -> io::Result<Self> {
        let settings = SlaveSettings::new(identity(), PtpProfile::END_TO_END);
        Ok(Self {
            slave: Slave::new(settings),
            base: TimeBase::new(BaseConfig::GPTP),
            port: Port::open(place)?,
            sample: None,
        })
    }

    /// Does what is due, and hears what has arrived. Never waits.
    pub(crate) fn turn(&mut self) {
        let Self {
            slave,
            base,
            port,
            sample: newest,
        } = self;
        slave.poll(clock::now(), port);
        let mut bytes = [0; LONGEST];
        loop {
            while let Some((event, at)) = port.sent.pop() {
                slave.on_sent(event, at, port);
            }
            let Some(it) = port.udp.receive(&mut bytes) else {
                return;
            };
            let Some(sample) = slave.on_message(it.at, &bytes[..it.len], port) else {
                continue;
            };
            let now = clock::now();
            if base.on_sample(now, sample, MasterQuality::default()) != Heard::Refused {
                let delay = slave.status().delay.unwrap_or_default();
                *newest = Some(ClockSample {
                    at_ns: now.as_ns(),
                    source: TimeSource::Grandmaster as u8,
                    offset_ns: clamped(base.offset_ns()),
                    delay_ns: u32::try_from(delay.as_ns()).unwrap_or(u32::MAX),
                    error_ns: u32::try_from(sample.error.as_ns()).unwrap_or(u32::MAX),
                });
            }
        }
    }

    /// Returns the state of its time.
    pub(crate) fn state(&self) -> SocTime {
        let now = clock::now();
        let conversion = self.base.conversion();
        let state = conversion.map(|it| ClockState {
            at_ns: now.as_ns(),
            source: TimeSource::Grandmaster as u8,
            status: it.status_at(now).bits(),
            ahead_ns: it.at(now).as_ns().wrapping_sub(now.as_ns()) as u32,
            rate_ppb: it.rate_ppb(),
        });
        let why = self.slave.status().why.map_or(0, |why| why as u8 + 1);
        SocTime {
            at_ns: now.as_ns(),
            state,
            sample: self.sample,
            why,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::clamped;

    /// S-5: an offset of seconds keeps its sign.
    #[test]
    fn an_offset_keeps_its_sign() {
        let offsets = [-5_000_000_000, -7, 0, 7, 5_000_000_000];
        assert_eq!(offsets.map(clamped), [i32::MIN, -7, 0, 7, i32::MAX]);
    }
}
