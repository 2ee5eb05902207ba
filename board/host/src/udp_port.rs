//! The Ethernet port of core 0: UDP sockets of its process.

use std::io;
use std::sync::{Mutex, MutexGuard, PoisonError};

use tandem_board::{
    Channel, CoreId, Datagram, HardwareFault, Identity, Instant, Network, NetworkAddress,
    NetworkFull, Recipient,
};
use tandem_board_udp::UdpPlace;

use crate::backplane::Backplane;
use crate::clock;
use crate::stamped_udp::StampedUdp;

/// How many datagrams one call discards at most while the cable is cut.
const DISCARDED_AT_ONCE: usize = 64;

/// The Ethernet port of a system. It is connected on core 0 of a run with a domain, unless the
/// sockets could not be opened.
///
/// Each call looks whether the cable is cut: what arrives while core 0 does not poll is only
/// discarded if it polls before the repair.
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
    udp: StampedUdp,
    sent: Mutex<Option<Instant>>,
}

impl End {
    fn open(place: UdpPlace, channel: Channel) -> io::Result<Self> {
        Ok(Self {
            udp: StampedUdp::open(place, channel)?,
            sent: Mutex::default(),
        })
    }

    fn sent(&self) -> MutexGuard<'_, Option<Instant>> {
        self.sent.lock().unwrap_or_else(PoisonError::into_inner)
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
        let sent = match self.is_cut() {
            true => clock::now(),
            false => end.udp.send(to, bytes)?,
        };
        *end.sent() = Some(sent);
        Ok(())
    }

    fn sent_at(&self, channel: Channel) -> Option<Instant> {
        *self.end(channel)?.sent()
    }

    fn try_receive(&self, channel: Channel, bytes: &mut [u8]) -> Option<Datagram> {
        let end = self.end(channel)?;
        for _ in 0..DISCARDED_AT_ONCE {
            let datagram = end.udp.receive(bytes)?;
            if !self.is_cut() {
                return Some(datagram);
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backplane::tests::ScratchRun;
    use std::net::Ipv4Addr;
    use tandem_board::{Duration, Generation, SystemId};

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
