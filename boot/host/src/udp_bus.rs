//! CAN over UDP multicast, compatible with python-can's `udp_multicast`: each frame is a datagram
//! with one msgpack map.

use serde::de::IgnoredAny;
use serde::{Deserialize, Serialize};
use socket2::{Domain, Protocol, Socket, Type};
use std::io;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use tandem_board::{CanFrame, CanId};

/// The default group of python-can.
pub const GROUP: Ipv4Addr = Ipv4Addr::new(239, 74, 163, 2);
/// Its port.
pub const PORT: u16 = 43113;

#[derive(Serialize)]
struct Sent<'a> {
    timestamp: f64,
    arbitration_id: u32,
    is_extended_id: bool,
    is_remote_frame: bool,
    is_error_frame: bool,
    channel: Option<()>,
    dlc: u8,
    data: &'a serde_bytes::Bytes,
    is_fd: bool,
    bitrate_switch: bool,
    error_state_indicator: bool,
}

#[derive(Deserialize)]
struct Heard {
    arbitration_id: u32,
    is_extended_id: bool,
    is_remote_frame: bool,
    is_error_frame: bool,
    #[serde(rename = "channel")]
    _channel: IgnoredAny,
    data: serde_bytes::ByteBuf,
    is_fd: bool,
}

/// One end of the bus.
#[derive(Debug)]
pub struct UdpBus {
    socket: UdpSocket,
    group: SocketAddrV4,
    own: io::Result<SocketAddr>,
    sender: UdpSocket,
}

impl UdpBus {
    /// Joins a group. Other processes of this machine may join the same group.
    ///
    /// # Errors
    /// An error of the operating system, usually because there is no route to the group. Its
    /// text says what to do.
    pub fn join(group: Ipv4Addr, port: u16) -> io::Result<Self> {
        Self::open(group, port).map_err(|error| {
            let why = format!(
                "CAN over UDP multicast, {group}:{port}: {error}; `ip link set lo up multicast on` and \
                 `ip route add 224.0.0.0/4 dev lo` give this machine a route (docs/boot.md)"
            );
            io::Error::new(error.kind(), why)
        })
    }

    fn open(group: Ipv4Addr, port: u16) -> io::Result<Self> {
        let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
        socket.set_reuse_address(true)?;
        let group = SocketAddrV4::new(group, port);
        socket.bind(&group.into())?;
        let socket = UdpSocket::from(socket);
        socket.join_multicast_v4(group.ip(), &Ipv4Addr::UNSPECIFIED)?;
        // Connect the socket: its address then identifies this end's own frames.
        let sender = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
        sender.connect(group)?;
        Ok(Self {
            socket,
            group,
            own: sender.local_addr(),
            sender,
        })
    }

    /// Sends a frame.
    ///
    /// # Errors
    /// An error of the operating system.
    pub fn send(&self, frame: &CanFrame) -> io::Result<()> {
        self.sender.send(&encode(frame)?).map(drop)
    }

    /// Waits for the next data frame of another end; returns `None` after the time `within`. Skips
    /// everything else.
    ///
    /// # Errors
    /// An error of the operating system.
    pub fn receive(&self, within: Duration) -> io::Result<Option<CanFrame>> {
        let end = std::time::Instant::now() + within;
        self.next_foreign(|| {
            let left = end.saturating_duration_since(std::time::Instant::now());
            if left.is_zero() {
                return Ok(false);
            }
            self.socket.set_read_timeout(Some(left))?;
            Ok(true)
        })
    }

    /// Makes [`UdpBus::poll`] and all sending return at once. Do not call [`UdpBus::receive`] then.
    ///
    /// # Errors
    /// An error of the operating system.
    pub fn set_polled(&self) -> io::Result<()> {
        self.socket.set_nonblocking(true)?;
        self.sender.set_nonblocking(true)
    }

    /// Returns the next data frame of another end that has arrived. Skips everything else.
    ///
    /// # Errors
    /// An error of the operating system.
    pub fn poll(&self) -> io::Result<Option<CanFrame>> {
        self.next_foreign(|| Ok(true))
    }

    /// Returns the next data frame of another end. Before each datagram it asks `goes_on` whether
    /// to take one.
    fn next_foreign(
        &self,
        mut goes_on: impl FnMut() -> io::Result<bool>,
    ) -> io::Result<Option<CanFrame>> {
        let mut bytes = [0; 2048];
        while goes_on()? {
            let (length, from) = match self.socket.recv_from(&mut bytes) {
                Ok(received) => received,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(None),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                Err(error) => return Err(error),
            };
            if let Some(frame) = self.decode_foreign(&bytes[..length], from) {
                return Ok(Some(frame));
            }
        }
        Ok(None)
    }

    /// Decodes a datagram; `None` for this end's own.
    fn decode_foreign(&self, bytes: &[u8], from: SocketAddr) -> Option<CanFrame> {
        let is_own = self.own.as_ref().is_ok_and(|own| *own == from);
        if is_own { None } else { decode(bytes) }
    }

    /// Returns the group and its port.
    #[must_use]
    pub const fn group(&self) -> SocketAddrV4 {
        self.group
    }
}

pub(crate) fn encode(frame: &CanFrame) -> io::Result<Vec<u8>> {
    let (arbitration_id, is_extended_id) = match frame.id() {
        CanId::Standard(id) => (u32::from(id), false),
        CanId::Extended(id) => (id, true),
    };
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    let message = Sent {
        timestamp: now.unwrap_or_default().as_secs_f64(),
        arbitration_id,
        is_extended_id,
        is_remote_frame: false,
        is_error_frame: false,
        channel: None,
        dlc: frame.data().len() as u8,
        data: serde_bytes::Bytes::new(frame.data()),
        is_fd: frame.is_fd(),
        bitrate_switch: false,
        error_state_indicator: false,
    };
    rmp_serde::to_vec_named(&message).map_err(io::Error::other)
}

/// Decodes a data frame; `None` if it is another one, or none.
pub(crate) fn decode(bytes: &[u8]) -> Option<CanFrame> {
    let heard: Heard = rmp_serde::from_slice(bytes).ok()?;
    let id = if heard.is_extended_id {
        CanId::Extended(heard.arbitration_id)
    } else {
        CanId::Standard(u16::try_from(heard.arbitration_id).ok()?)
    };
    let is_data = !heard.is_remote_frame && !heard.is_error_frame;
    CanFrame::new(id, heard.is_fd, &heard.data)
        .ok()
        .filter(|_| is_data)
}
