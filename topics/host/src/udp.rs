//! UDP below a participant: the ports of a domain, multicast where the machine has it, and peers.

use rustix::event::{PollFd, PollFlags, poll};
use socket2::{Domain, Protocol, Socket, Type};
use std::io;
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::time::Duration;
use tandem_topics::{Destination, Locator, Outlet};

/// Address of discovery. (RTPS 9.6.1.4.1)
const EVERYONE: Ipv4Addr = Ipv4Addr::new(239, 255, 0, 1);
/// Ports of a domain begin here. (RTPS 9.6.1.1)
const PORTS: u16 = 7_400;
const PORTS_OF_A_DOMAIN: u16 = 250;
/// Ports for unicast begin this much above.
const UNICAST: u16 = 10;
/// How many participants of this machine find each other without multicast.
const PARTICIPANTS: u16 = 10;
/// The longest datagram of UDP.
const LONGEST: usize = 65_507;

/// The sockets of one participant.
#[derive(Debug)]
pub struct Udp {
    /// Where participants announce themselves to all.
    discovery: UdpSocket,
    /// Where this one hears.
    unicast: UdpSocket,
    at: Locator,
    everyone: Vec<SocketAddrV4>,
    bytes: Vec<u8>,
}

fn shared(address: Ipv4Addr, port: u16) -> io::Result<UdpSocket> {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_reuse_address(true)?;
    socket.set_nonblocking(true)?;
    socket.bind(&SocketAddrV4::new(address, port).into())?;
    Ok(socket.into())
}

impl Udp {
    /// Opens the sockets of the next free participant of a domain (0 to 230) on an interface of
    /// this machine. Joins the address of discovery if the interface has multicast.
    ///
    /// # Errors
    ///
    /// No port of the domain is free, or the interface does not exist.
    pub fn open(domain: u16, interface: Ipv4Addr) -> io::Result<Self> {
        let base = PORTS + PORTS_OF_A_DOMAIN * domain;
        let discovery = shared(Ipv4Addr::UNSPECIFIED, base)?;
        let has_multicast = discovery.join_multicast_v4(&EVERYONE, &interface).is_ok();
        let ports = (0..PARTICIPANTS).map(|index| base + UNICAST + 2 * index);
        let mut bound = Err(io::ErrorKind::AddrInUse.into());
        for port in ports.clone() {
            bound = UdpSocket::bind(SocketAddrV4::new(interface, port));
            if !matches!(&bound, Err(error) if error.kind() == io::ErrorKind::AddrInUse) {
                break;
            }
        }
        let unicast = bound?;
        unicast.set_nonblocking(true)?;
        let port = unicast.local_addr()?.port();
        let others = ports.filter(|other| *other != port);
        let mut everyone: Vec<_> = others
            .map(|port| SocketAddrV4::new(interface, port))
            .collect();
        if has_multicast {
            socket2::SockRef::from(&unicast).set_multicast_if_v4(&interface)?;
            everyone.push(SocketAddrV4::new(EVERYONE, base));
        }
        let at = Locator {
            address: interface.octets(),
            port,
        };
        Ok(Self {
            discovery,
            unicast,
            at,
            everyone,
            bytes: vec![0; LONGEST],
        })
    }

    /// Returns where it hears.
    pub const fn at(&self) -> Locator {
        self.at
    }

    /// Waits for a datagram, at most for this time.
    ///
    /// # Errors
    ///
    /// A signal has arrived, or a socket is broken.
    pub fn wait(&self, time: Duration) -> io::Result<()> {
        let mut sockets =
            [&self.discovery, &self.unicast].map(|socket| PollFd::new(socket, PollFlags::IN));
        let time = time.try_into().map_err(io::Error::other)?;
        poll(&mut sockets, Some(&time))?;
        Ok(())
    }

    /// Returns the next datagram; `None` if none has arrived.
    pub fn receive(&mut self) -> Option<Vec<u8>> {
        let len = [&self.unicast, &self.discovery]
            .into_iter()
            .find_map(|socket| socket.recv(&mut self.bytes).ok())?;
        Some(self.bytes[..len].to_vec())
    }
}

impl Outlet for Udp {
    fn send(&mut self, to: Destination, message: &[u8]) {
        let one = match to {
            Destination::Everyone => None,
            Destination::At(at) => Some(SocketAddrV4::new(at.address.into(), at.port)),
        };
        let all: &[SocketAddrV4] = match &one {
            None => &self.everyone,
            Some(one) => std::slice::from_ref(one),
        };
        for address in all {
            // What cannot be sent is lost, as on the wire.
            let _lost = self.unicast.send_to(message, address);
        }
    }
}
