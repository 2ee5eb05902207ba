//! A port that tells when its messages arrive and leave, by the kernel's stamps.

use std::io::{self, IoSlice, IoSliceMut};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::os::fd::{AsFd, AsRawFd};
use std::time::{SystemTime, UNIX_EPOCH};

use nix::cmsg_space;
use nix::ifaddrs::getifaddrs;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::socket::sockopt::Timestamping;
use nix::sys::socket::{
    ControlMessageOwned, LinkAddr, MsgFlags, TimestampingFlag, Timestamps, bind, recvmsg, sendmsg,
    setsockopt,
};
use socket2::{Domain, InterfaceIndexOrAddress, Protocol, SockAddr, Socket, Type};
use tandem_board::{Duration, Instant};
use tandem_timesync::gptp::{EventId, PortIdentity, PtpProfile, TimeOutlet};

/// The EtherType of PTP.
const PTP: u16 = 0x88F7;
/// Destination, source, EtherType.
const ETHERNET_HEADER: usize = 14;
/// Those of Ethernet, IPv4 and UDP.
const UDP_HEADERS: usize = 42;
/// For messages that no bridge forwards: all of 802.1AS, those of the peer delay of IEEE 1588.
const LINK_LOCAL: [u8; 6] = [0x01, 0x80, 0xC2, 0x00, 0x00, 0x0E];
const FORWARDED: [u8; 6] = [0x01, 0x1B, 0x19, 0x00, 0x00, 0x00];
/// The groups for UDP: IEEE 1588-2019, C.3.
const GROUP: Ipv4Addr = Ipv4Addr::new(224, 0, 1, 129);
const PEER_GROUP: Ipv4Addr = Ipv4Addr::new(224, 0, 0, 107);
const EVENT_PORT: u16 = 319;
const GENERAL_PORT: u16 = 320;
/// Longer than any message that matters.
const LONGEST: usize = 256;

/// What carries the messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Transport {
    /// Frames of EtherType 0x88F7. On an interface that filters groups in hardware, let it receive
    /// them all: `ip link set dev X allmulticast on`.
    Ethernet,
    /// UDP over IPv4, ports 319 and 320.
    Udp,
}

/// What has arrived at a port.
#[derive(Debug)]
pub enum PtpArrival {
    /// A message, and when it arrived.
    Message(Vec<u8>, Instant),
    /// When an event message left.
    Sent(EventId, Instant),
}

/// Returns the local time: the machine's clock.
#[must_use]
pub fn now() -> Instant {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    Instant::from_ns(since.map_or(0, |since| since.as_nanos() as u64))
}

/// A port on one network interface.
#[derive(Debug)]
pub struct TimePort {
    transport: Transport,
    profile: PtpProfile,
    mac: [u8; 6],
    /// The interface's number.
    index: usize,
    /// For events; with UDP another one for general messages.
    sockets: Vec<Socket>,
    /// How many messages could not be sent.
    pub unsent: u32,
}

impl TimePort {
    /// Opens a port. It needs the right to open raw sockets, or ports below 1,024.
    ///
    /// # Errors
    /// If the interface is missing or has no MAC address, or the sockets cannot be opened.
    pub fn open(interface: &str, profile: PtpProfile, transport: Transport) -> io::Result<Self> {
        let missing =
            || io::Error::new(io::ErrorKind::NotFound, format!("no interface {interface}"));
        let is_it = |it: &nix::ifaddrs::InterfaceAddress| it.interface_name == interface;
        let mut addresses = getifaddrs()?.filter(is_it);
        let link = addresses.find_map(|it| it.address?.as_link_addr().copied());
        let link = link.ok_or_else(missing)?;
        let mut port = Self {
            transport,
            profile,
            mac: link.addr().ok_or_else(missing)?,
            index: link.ifindex(),
            sockets: Vec::new(),
            unsent: 0,
        };
        match transport {
            Transport::Ethernet => port.open_ethernet(&link)?,
            Transport::Udp => {
                port.open_udp(interface, EVENT_PORT)?;
                port.open_udp(interface, GENERAL_PORT)?;
            }
        }
        let flags = TimestampingFlag::SOF_TIMESTAMPING_SOFTWARE
            | TimestampingFlag::SOF_TIMESTAMPING_RX_SOFTWARE
            | TimestampingFlag::SOF_TIMESTAMPING_TX_SOFTWARE;
        setsockopt(&port.sockets[0], Timestamping, &flags)?;
        Ok(port)
    }

    fn open_ethernet(&mut self, link: &LinkAddr) -> io::Result<()> {
        let protocol = Protocol::from(i32::from(PTP.to_be()));
        let socket = Socket::new(Domain::PACKET, Type::RAW, Some(protocol))?;
        // The address names the interface alone; the socket has its protocol already.
        bind(socket.as_raw_fd(), link)?;
        self.sockets.push(socket);
        Ok(())
    }

    fn open_udp(&mut self, interface: &str, port: u16) -> io::Result<()> {
        let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
        let index = InterfaceIndexOrAddress::Index(self.index as u32);
        socket.set_reuse_address(true)?;
        socket.bind_device(Some(interface.as_bytes()))?;
        socket.bind(&SockAddr::from(SocketAddrV4::new(
            Ipv4Addr::UNSPECIFIED,
            port,
        )))?;
        for group in [GROUP, PEER_GROUP] {
            socket.join_multicast_v4_n(&group, &index)?;
        }
        socket.set_multicast_loop_v4(false)?;
        self.sockets.push(socket);
        Ok(())
    }

    /// Returns the identity that the interface's MAC address gives.
    #[must_use]
    pub const fn identity(&self) -> PortIdentity {
        PortIdentity::from_mac(self.mac)
    }

    /// Waits for an arrival, at most for `span`.
    ///
    /// # Errors
    /// If a socket fails, as when its interface is removed.
    pub fn wait(&mut self, span: Duration) -> io::Result<Option<PtpArrival>> {
        for round in 0..2 {
            for socket in &self.sockets {
                // Times of sending first: an answer may be here already.
                for flags in [MsgFlags::MSG_ERRQUEUE, MsgFlags::empty()] {
                    if let Some(arrival) = self.receive(socket, flags)? {
                        return Ok(Some(arrival));
                    }
                }
            }
            if round == 0 {
                let fds = self
                    .sockets
                    .iter()
                    .map(|it| PollFd::new(it.as_fd(), PollFlags::POLLIN));
                let ms = u16::try_from(span.as_us().div_ceil(1_000)).unwrap_or(u16::MAX);
                match poll(&mut fds.collect::<Vec<_>>(), PollTimeout::from(ms)) {
                    Ok(_) | Err(nix::errno::Errno::EINTR) => {}
                    Err(error) => return Err(error.into()),
                }
            }
        }
        Ok(None)
    }

    fn receive(&self, socket: &Socket, flags: MsgFlags) -> io::Result<Option<PtpArrival>> {
        let mut bytes = [0; LONGEST];
        let mut control = cmsg_space!(Timestamps, [u8; 64]);
        let mut parts = [IoSliceMut::new(&mut bytes)];
        let flags_now = flags | MsgFlags::MSG_DONTWAIT;
        let fd = socket.as_raw_fd();
        let received = match recvmsg::<LinkAddr>(fd, &mut parts, Some(&mut control), flags_now) {
            Ok(received) => received,
            Err(nix::errno::Errno::EAGAIN | nix::errno::Errno::EINTR) => return Ok(None),
            Err(error) => return Err(error.into()),
        };
        let len = received.bytes;
        let at = received.cmsgs()?.find_map(|it| match it {
            ControlMessageOwned::ScmTimestampsns(stamps) => {
                let seconds = u64::try_from(stamps.system.tv_sec()).ok()?;
                let ns = u64::try_from(stamps.system.tv_nsec()).ok()?;
                Some(Instant::from_ns(seconds * 1_000_000_000 + ns))
            }
            _ => None,
        });
        let is_ethernet = self.transport == Transport::Ethernet;
        let is_ours = received
            .address
            .is_none_or(|it| !is_ethernet || it.ifindex() == self.index);
        let is_sent = flags == MsgFlags::MSG_ERRQUEUE;
        let header = match (self.transport, is_sent) {
            (Transport::Ethernet, _) => ETHERNET_HEADER,
            (Transport::Udp, true) => UDP_HEADERS,
            (Transport::Udp, false) => 0,
        };
        let message = bytes.get(header..len).unwrap_or_default();
        Ok(match at {
            Some(at) if is_sent => EventId::of(message).map(|event| PtpArrival::Sent(event, at)),
            // A general message needs no stamp.
            _ if is_ours && !is_sent => {
                let at = at.unwrap_or_else(now);
                Some(PtpArrival::Message(message.to_vec(), at))
            }
            _ => None,
        })
    }

    fn try_send(&self, message: &[u8], is_event: bool) -> io::Result<()> {
        let kind = message.first().map_or(0, |byte| byte & 0xF);
        let is_peer = matches!(kind, 0x2 | 0x3 | 0xA);
        match self.transport {
            Transport::Ethernet => {
                let is_local = is_peer || self.profile.sdo == 1;
                let to = if is_local { LINK_LOCAL } else { FORWARDED };
                let ether_type = PTP.to_be_bytes();
                let parts = [&to[..], &self.mac, &ether_type, message].map(IoSlice::new);
                let fd = self.sockets[0].as_raw_fd();
                sendmsg::<LinkAddr>(fd, &parts, &[], MsgFlags::MSG_DONTWAIT, None)?;
            }
            Transport::Udp => {
                let group = if is_peer { PEER_GROUP } else { GROUP };
                let (socket, port) = match is_event {
                    true => (&self.sockets[0], EVENT_PORT),
                    false => (&self.sockets[1], GENERAL_PORT),
                };
                socket.send_to(message, &SockAddr::from(SocketAddrV4::new(group, port)))?;
            }
        }
        Ok(())
    }
}

impl TimeOutlet for TimePort {
    fn send(&mut self, message: &[u8], event: Option<EventId>) {
        if self.try_send(message, event.is_some()).is_err() {
            self.unsent = self.unsent.wrapping_add(1);
        }
    }
}
