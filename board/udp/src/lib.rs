//! A station of a network on the host: UDP sockets for each channel of a board.
//!
//! Each station of the host uses it: the process of core 0, the bridge to emulated
//! machines, and a participant of DDS. The ports are those of RTPS; the channel for time has
//! further ones in the range of a domain.
#![forbid(unsafe_code)]

use nix::sys::socket::sockopt::Timestamping;
use nix::sys::socket::{
    ControlMessageOwned, MsgFlags, SockaddrIn, TimestampingFlag, Timestamps, recvmsg, setsockopt,
};
use socket2::{Domain, Protocol, SockRef, Socket, Type};
use std::fmt;
use std::io;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};
use std::os::fd::AsRawFd as _;
use std::str::FromStr;
use tandem_board::{Channel, NetworkAddress, NetworkFull, Recipient};

/// The last domain whose ports exist.
const LAST_DOMAIN: u16 = 230;
/// Ports of a domain begin here. (RTPS 9.6.1.1)
const PORTS: u16 = 7_400;
const PORTS_OF_A_DOMAIN: u16 = 250;
/// How many stations of an interface find each other without multicast.
const STATIONS: u16 = 10;
/// The port of a domain that no station has: it is bound as a claim.
const CLAIM: u16 = 238;

/// The group of a channel, and its ports in the range of a domain.
struct Layout {
    group: Ipv4Addr,
    /// The port of the group.
    everyone: u16,
    /// The port of the first station, and the distance from one to the next.
    first: u16,
    step: u16,
}

const fn layout(channel: Channel) -> Layout {
    match channel {
        // RTPS 9.6.1.4.1 and 9.6.1.1
        Channel::Topics => Layout {
            group: Ipv4Addr::new(239, 255, 0, 1),
            everyone: 0,
            first: 10,
            step: 2,
        },
        // The group of PTP (IEEE 1588, annex C). Its ports below 1024 need a right.
        Channel::Time => Layout {
            group: Ipv4Addr::new(224, 0, 1, 129),
            everyone: 239,
            first: 240,
            step: 1,
        },
    }
}

/// Where a station is: a domain (0 to 230), and an interface of this machine. Written as
/// `3@127.0.0.1`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UdpPlace {
    domain: u16,
    interface: Ipv4Addr,
}

/// The text is not a place, or the domain is beyond 230.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("a place is a domain from 0 to {LAST_DOMAIN} and an IPv4 address: 3@127.0.0.1")]
pub struct InvalidPlace;

impl UdpPlace {
    /// Makes a place.
    ///
    /// # Errors
    /// [`InvalidPlace`] if there is no such domain.
    pub const fn new(domain: u16, interface: Ipv4Addr) -> Result<Self, InvalidPlace> {
        if domain > LAST_DOMAIN {
            return Err(InvalidPlace);
        }
        Ok(Self { domain, interface })
    }

    /// Returns its domain.
    #[must_use]
    pub const fn domain(self) -> u16 {
        self.domain
    }

    /// Returns the address of its interface.
    #[must_use]
    pub const fn interface(self) -> Ipv4Addr {
        self.interface
    }

    /// Claims the place for one run of this machine, as long as the socket is open.
    ///
    /// # Errors
    /// [`io::ErrorKind::AddrInUse`] if it is claimed; others if the machine has no such interface.
    pub fn claim(self) -> io::Result<UdpSocket> {
        let port = PORTS + PORTS_OF_A_DOMAIN * self.domain + CLAIM;
        UdpSocket::bind(SocketAddrV4::new(self.interface, port))
    }
}

impl fmt::Display for UdpPlace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}@{}", self.domain, self.interface)
    }
}

impl FromStr for UdpPlace {
    type Err = InvalidPlace;

    fn from_str(text: &str) -> Result<Self, InvalidPlace> {
        let (domain, interface) = text.split_once('@').ok_or(InvalidPlace)?;
        let domain = domain.parse().map_err(|_| InvalidPlace)?;
        Self::new(domain, interface.parse().map_err(|_| InvalidPlace)?)
    }
}

/// The sockets of a station for one channel.
#[derive(Debug)]
pub struct UdpChannel {
    /// Where this station hears, and from where it sends.
    own: UdpSocket,
    /// Where all stations hear.
    group: UdpSocket,
    at: SocketAddrV4,
    everyone: Vec<SocketAddrV4>,
    channel: Channel,
}

/// A datagram that was received.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UdpHeard {
    /// How many bytes were copied.
    pub len: usize,
    /// Its sender.
    pub from: NetworkAddress,
    /// The index of its socket in [`UdpChannel::sockets`].
    pub socket: usize,
}

impl UdpChannel {
    /// Opens the sockets of the next free station of a place, and joins the group of the channel.
    ///
    /// # Errors
    /// No port is free, or the machine has no such interface.
    pub fn open(place: UdpPlace, channel: Channel) -> io::Result<Self> {
        let UdpPlace { domain, interface } = place;
        let layout = layout(channel);
        let base = PORTS + PORTS_OF_A_DOMAIN * domain;
        let all = SocketAddrV4::new(layout.group, base + layout.everyone);
        let group = shared(all.port())?;
        let has_group = group.join_multicast_v4(&layout.group, &interface).is_ok();
        let stations = (0..STATIONS).map(|index| base + layout.first + layout.step * index);
        let stations = stations.map(|port| SocketAddrV4::new(interface, port));
        let mut bound = Err(io::ErrorKind::AddrInUse.into());
        for at in stations.clone() {
            bound = UdpSocket::bind(at).map(|socket| (socket, at));
            if !matches!(&bound, Err(error) if error.kind() == io::ErrorKind::AddrInUse) {
                break;
            }
        }
        let (own, at) = bound?;
        own.set_nonblocking(true)?;
        let mut everyone = vec![];
        if has_group {
            SockRef::from(&own).set_multicast_if_v4(&interface)?;
            everyone.push(all);
        }
        // Others use no multicast on the loopback interface, although it works there.
        if interface.is_loopback() || !has_group {
            everyone.extend(stations.filter(|other| *other != at));
        }
        Ok(Self {
            own,
            group,
            at,
            everyone,
            channel,
        })
    }

    /// Returns where this station hears.
    #[must_use]
    pub const fn address(&self) -> NetworkAddress {
        address(self.at)
    }

    /// Returns the sockets on which datagrams arrive, to wait for them.
    #[must_use]
    pub const fn sockets(&self) -> [&UdpSocket; 2] {
        [&self.own, &self.group]
    }

    /// Sends a datagram; never blocks. One that cannot reach its recipient is lost.
    ///
    /// # Errors
    /// [`NetworkFull`] if the socket's buffer is full.
    pub fn send(&self, to: Recipient, bytes: &[u8]) -> Result<(), NetworkFull> {
        self.send_copies(to, |at| self.own.send_to(bytes, at))
    }

    /// As [`send`](Self::send). Returns when the first copy left, by the kernel's real-time clock:
    /// UTC since 1970, ns; `None` if the kernel does not tell at once.
    ///
    /// # Errors
    /// As [`send`](Self::send).
    pub fn send_stamped(&self, to: Recipient, bytes: &[u8]) -> Result<Option<u64>, NetworkFull> {
        let mut stamp = None;
        let mut is_first = true;
        self.send_copies(to, |at| {
            if !std::mem::replace(&mut is_first, false) {
                return self.own.send_to(bytes, at);
            }
            // A stamp that is late belongs to an earlier datagram.
            while self.left_at().is_some() {}
            let is_stamping = setsockopt(&self.own, Timestamping, &left_stamps()).is_ok();
            let sent = self.own.send_to(bytes, at);
            if is_stamping {
                stamp = self.left_at();
                // While it is set, the kernel does not note times of receiving.
                let _ = setsockopt(&self.own, Timestamping, &TimestampingFlag::empty());
            }
            sent
        })?;
        Ok(stamp)
    }

    /// Returns the next stamp of a datagram that has left, UTC since 1970, ns.
    fn left_at(&self) -> Option<u64> {
        let mut control = nix::cmsg_space!(Timestamps, [u8; 64]);
        let flags = MsgFlags::MSG_ERRQUEUE | MsgFlags::MSG_DONTWAIT;
        let fd = self.own.as_raw_fd();
        let told = recvmsg::<SockaddrIn>(fd, &mut [], Some(&mut control), flags).ok()?;
        told.cmsgs().ok()?.find_map(|it| match it {
            ControlMessageOwned::ScmTimestampsns(at) => {
                let seconds = u64::try_from(at.system.tv_sec()).ok()?;
                Some(seconds * 1_000_000_000 + u64::try_from(at.system.tv_nsec()).ok()?)
            }
            _ => None,
        })
    }

    fn send_copies(
        &self,
        to: Recipient,
        mut send: impl FnMut(SocketAddrV4) -> io::Result<usize>,
    ) -> Result<(), NetworkFull> {
        let one = match to {
            Recipient::Everyone => None,
            Recipient::One(at) => Some(SocketAddrV4::new(at.address.into(), at.port)),
        };
        let all = one
            .as_ref()
            .map_or(&self.everyone[..], std::slice::from_ref);
        for (index, to) in all.iter().enumerate() {
            if let Err(error) = send(*to)
                && error.kind() == io::ErrorKind::WouldBlock
                && index == 0
            {
                return Err(NetworkFull);
            }
        }
        Ok(())
    }

    /// Copies the next datagram of another station; `None` if there is none. Never blocks. What
    /// does not fit is cut off.
    pub fn receive(&self, bytes: &mut [u8]) -> Option<UdpHeard> {
        // A participant that leaves tells everyone, after its last samples to one. Of time the
        // earliest copy counts, which the group has.
        let order = match self.channel {
            Channel::Topics => [0, 1],
            Channel::Time => [1, 0],
        };
        for index in order {
            let socket = self.sockets()[index];
            while let Ok((len, from)) = socket.recv_from(bytes) {
                if let SocketAddr::V4(from) = from
                    && from != self.at
                {
                    return Some(UdpHeard {
                        len,
                        from: address(from),
                        socket: index,
                    });
                }
            }
        }
        None
    }
}

/// Stamps in software, when a datagram leaves, without the datagram.
const fn left_stamps() -> TimestampingFlag {
    TimestampingFlag::SOF_TIMESTAMPING_TX_SOFTWARE
        .union(TimestampingFlag::SOF_TIMESTAMPING_SOFTWARE)
        .union(TimestampingFlag::SOF_TIMESTAMPING_OPT_TSONLY)
}

const fn address(of: SocketAddrV4) -> NetworkAddress {
    NetworkAddress {
        address: of.ip().octets(),
        port: of.port(),
    }
}

/// Opens a socket on a port that the stations of this machine share.
fn shared(port: u16) -> io::Result<UdpSocket> {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_reuse_address(true)?;
    socket.set_nonblocking(true)?;
    socket.bind(&SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, port).into())?;
    Ok(socket.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::UNIX_EPOCH;

    #[test]
    fn a_place_comes_back_as_it_was_written_and_no_other_text_is_one() {
        for text in ["0@127.0.0.1", "230@192.0.2.2"] {
            assert_eq!(text.parse::<UdpPlace>().unwrap().to_string(), text);
        }
        for text in ["", "3", "231@127.0.0.1", "3@lo", "-1@127.0.0.1", "3@::1"] {
            assert_eq!(text.parse::<UdpPlace>(), Err(InvalidPlace), "{text}");
        }
    }

    /// RTPS 9.6.1: a participant of another vendor finds these ports by the domain.
    #[test]
    fn stations_take_the_ports_of_their_domain_one_after_the_other() {
        // An address of this test alone.
        let interface = Ipv4Addr::new(127, 77, 1, 1);
        let place = UdpPlace::new(230, interface).unwrap();
        for (channel, ports) in [
            (Channel::Topics, [64_910, 64_912]),
            (Channel::Time, [65_140, 65_141]),
        ] {
            let opened = ports.map(|_| UdpChannel::open(place, channel).unwrap());
            for (channel, port) in opened.iter().zip(ports) {
                let address = interface.octets();
                assert_eq!(channel.address(), NetworkAddress { address, port });
            }
            let rest: Vec<_> = (2..STATIONS)
                .map(|_| UdpChannel::open(place, channel))
                .collect();
            assert!(rest.iter().all(Result::is_ok));
            let full = UdpChannel::open(place, channel).unwrap_err();
            assert_eq!(full.kind(), io::ErrorKind::AddrInUse);
        }
    }

    /// D-4, S-2: of topics what is sent to one comes first, of time what is sent to everyone.
    #[test]
    fn each_channel_has_its_order() {
        let interface = Ipv4Addr::new(127, 77, 1, 3);
        let place = UdpPlace::new(229, interface).unwrap();
        for (channel, order) in [(Channel::Topics, [1, 2, 1]), (Channel::Time, [1, 1, 2])] {
            let [from, to] = [(); 2].map(|()| UdpChannel::open(place, channel).unwrap());
            from.send(Recipient::Everyone, &[1]).unwrap();
            // On the loopback interface each station also gets a copy of its own.
            from.send(Recipient::One(to.address()), &[2]).unwrap();
            let mut bytes = [0; 4];
            let mut heard = vec![];
            while to.receive(&mut bytes).is_some() {
                heard.push(bytes[0]);
            }
            assert_eq!(heard, order, "{channel:?}");
        }
    }

    /// S-2: the kernel tells when a datagram left. A second one has a stamp of its own, and the
    /// stamps of copies are not taken for it.
    #[test]
    fn a_datagram_tells_when_it_left() {
        let interface = Ipv4Addr::new(127, 77, 1, 2);
        let place = UdpPlace::new(230, interface).unwrap();
        let [from, to] = [(); 2].map(|()| UdpChannel::open(place, Channel::Time).unwrap());
        let now = || UNIX_EPOCH.elapsed().unwrap().as_nanos() as u64;
        for to_one in [true, false] {
            let recipient = match to_one {
                true => Recipient::One(to.address()),
                false => Recipient::Everyone,
            };
            let before = now();
            let left = from
                .send_stamped(recipient, &[7])
                .unwrap()
                .expect("a stamp");
            assert!((before..=now()).contains(&left), "{before} {left}");
            let mut bytes = [0; 4];
            assert!(to.receive(&mut bytes).is_some() && bytes[0] == 7);
            assert_eq!(from.left_at(), None);
        }
    }
}
