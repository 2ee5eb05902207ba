//! The Ethernet port of core 0: UDP sockets of its process.

use std::io;
use std::net::UdpSocket;
use std::os::fd::AsRawFd as _;
use std::sync::{Mutex, MutexGuard, PoisonError};

use rustix::time::{ClockId, Timespec, clock_gettime};
use tandem_board::{
    Channel, CoreId, Datagram, Duration, HardwareFault, Identity, Instant, Network, NetworkAddress,
    NetworkFull, Recipient,
};
use tandem_board_udp::{UdpChannel, UdpPlace};

use crate::backplane::Backplane;
use crate::clock;

/// How many datagrams one call discards at most while the cable is cut.
const DISCARDED_AT_ONCE: usize = 64;
/// Reads the time at which the kernel received the datagram that was last read from a socket, and
/// makes the kernel note these times. (Linux: asm-generic/sockios.h)
const SIOCGSTAMPNS: libc::Ioctl = 0x8907;

/// The Ethernet port of a system. It is connected on core 0 of a run with a domain, unless the
/// sockets could not be opened.
///
/// The time of sending is that of the call. The time of receiving is the kernel's, translated from
/// its real-time clock, or that of the call if the kernel has noted none. Each call looks whether
/// the cable is cut: what arrives while core 0 does not poll is only discarded if it polls before
/// the repair.
#[derive(Debug)]
pub struct HostNetwork {
    backplane: Backplane,
    of: Identity,
    ends: Option<[End; Channel::ALL.len()]>,
    error: Option<io::Error>,
}

/// A system's end of a channel.
#[derive(Debug)]
struct End {
    udp: UdpChannel,
    times: Mutex<Times>,
}

#[derive(Debug, Default)]
struct Times {
    sent: Option<Instant>,
    /// The time of the newest datagram of each socket.
    received: [Instant; 2],
}

impl End {
    fn open(place: UdpPlace, channel: Channel) -> io::Result<Self> {
        let udp = UdpChannel::open(place, channel)?;
        for socket in udp.sockets() {
            received_at(socket);
        }
        Ok(Self {
            udp,
            times: Mutex::default(),
        })
    }

    fn times(&self) -> MutexGuard<'_, Times> {
        self.times.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl HostNetwork {
    pub(crate) fn open(backplane: Backplane, of: Identity, place: Option<UdpPlace>) -> Self {
        let place = place.filter(|_| of.core == CoreId::CONTROL);
        let open = |place| -> io::Result<_> {
            let [topics, time] = Channel::ALL.map(|channel| End::open(place, channel));
            Ok([topics?, time?])
        };
        let (ends, error) = match place.map(open) {
            None => (None, None),
            Some(Ok(ends)) => (Some(ends), None),
            Some(Err(error)) => (None, Some(error)),
        };
        Self {
            backplane,
            of,
            ends,
            error,
        }
    }

    /// Returns why the port is not connected although the run has a domain. The core drives without
    /// it.
    #[must_use]
    pub const fn error(&self) -> Option<&io::Error> {
        self.error.as_ref()
    }

    fn end(&self, channel: Channel) -> Option<&End> {
        Some(&self.ends.as_ref()?[channel.index()])
    }

    fn is_cut(&self) -> bool {
        let faults = self.backplane.faults(self.of.system);
        faults.has(HardwareFault::Network)
    }
}

impl Network for HostNetwork {
    fn address(&self, channel: Channel) -> Option<NetworkAddress> {
        Some(self.end(channel)?.udp.address())
    }

    fn try_send(&self, channel: Channel, to: Recipient, bytes: &[u8]) -> Result<(), NetworkFull> {
        let most = Self::MAX_BYTES;
        assert!(bytes.len() <= most, "a datagram has at most {most} bytes");
        let Some(end) = self.end(channel) else {
            return Ok(());
        };
        // Before the call: on the loopback interface the datagram has arrived when it returns.
        let sent = clock::now();
        if !self.is_cut() {
            end.udp.send(to, bytes)?;
        }
        end.times().sent = Some(sent);
        Ok(())
    }

    fn sent_at(&self, channel: Channel) -> Option<Instant> {
        self.end(channel)?.times().sent
    }

    fn try_receive(&self, channel: Channel, bytes: &mut [u8]) -> Option<Datagram> {
        let end = self.end(channel)?;
        for _ in 0..DISCARDED_AT_ONCE {
            let heard = end.udp.receive(bytes)?;
            if self.is_cut() {
                continue;
            }
            let noted = received_at(end.udp.sockets()[heard.socket]);
            let now = clock::now();
            let mut times = end.times();
            let last = &mut times.received[heard.socket];
            // The kernel's real-time clock may have been set since.
            *last = noted.unwrap_or(now).max(*last).min(now);
            return Some(Datagram {
                len: heard.len,
                from: heard.from,
                at: *last,
            });
        }
        None
    }
}

/// Returns when the kernel received the datagram that was last read from this socket, on the
/// board's clock; `None` if the kernel does not know.
fn received_at(socket: &UdpSocket) -> Option<Instant> {
    let mut at = libc::timespec {
        tv_sec: 0,
        tv_nsec: 0,
    };
    // SAFETY: the request writes one timespec, which outlives the call.
    let result = unsafe { libc::ioctl(socket.as_raw_fd(), SIOCGSTAMPNS, &raw mut at) };
    if result != 0 {
        return None;
    }
    let (now, real) = both_clocks()?;
    let ns = |seconds: i64, ns: i64| i128::from(seconds) * 1_000_000_000 + i128::from(ns);
    let age = ns(real.tv_sec, real.tv_nsec) - ns(at.tv_sec, at.tv_nsec);
    let age = u64::try_from(age.max(0)).ok()?;
    Some(Instant::from_ns(now.as_ns().saturating_sub(age)))
}

/// Reads the board's clock and the kernel's real-time clock within 5 µs; `None` if the process was
/// interrupted each time.
fn both_clocks() -> Option<(Instant, Timespec)> {
    (0..8).find_map(|_| {
        let now = clock::now();
        let real = clock_gettime(ClockId::Realtime);
        (clock::now().since(now) < Duration::from_us(5)).then_some((now, real))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backplane::tests::ScratchRun;
    use std::net::Ipv4Addr;
    use tandem_board::{Generation, SystemId};

    const CHANNEL: Channel = Channel::Time;

    fn port(backplane: Backplane, core: CoreId, place: UdpPlace) -> HostNetwork {
        let of = Identity {
            system: SystemId::A,
            core,
            generation: Generation(1),
        };
        HostNetwork::open(backplane, of, Some(place))
    }

    /// S-2: the kernel notes when a datagram arrives, however late the core reads it.
    #[test]
    fn the_time_of_receiving_is_not_that_of_reading() {
        let (_run, backplane) = ScratchRun::create();
        // Addresses of this test alone.
        let place = UdpPlace::new(229, Ipv4Addr::new(127, 77, 2, 1)).unwrap();
        let [a, b] = [(); 2].map(|()| port(backplane, CoreId::CONTROL, place));
        let to_b = Recipient::One(b.address(CHANNEL).unwrap());
        // The kernel begins to note times a moment after the first socket has asked for them.
        let is_noted = |_| {
            a.try_send(CHANNEL, to_b, &[1]).unwrap();
            let sent = a.sent_at(CHANNEL).unwrap();
            let after = clock::now();
            clock::sleep_until(after + Duration::from_ms(5));
            let received = b.try_receive(CHANNEL, &mut [0; 4]).unwrap();
            assert!(sent <= received.at, "{sent:?} {received:?}");
            assert_eq!(Some(received.from), a.address(CHANNEL));
            received.at <= after
        };
        assert!((0..100).any(is_noted), "the core reads 5 ms later");
    }

    #[test]
    fn a_port_that_cannot_be_opened_tells_why_and_other_cores_have_none() {
        let (_run, backplane) = ScratchRun::create();
        let elsewhere = UdpPlace::new(229, Ipv4Addr::new(203, 0, 113, 1)).unwrap();
        let network = port(backplane, CoreId::CONTROL, elsewhere);
        assert!(network.error().is_some());
        assert_eq!(network.address(CHANNEL), None);
        assert_eq!(network.try_send(CHANNEL, Recipient::Everyone, &[1]), Ok(()));
        let other = port(backplane, CoreId::PLANNING, elsewhere);
        assert!(other.error().is_none() && other.address(CHANNEL).is_none());
    }
}
