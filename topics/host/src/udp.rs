//! UDP below a participant: the sockets of the channel for topics.

use rustix::event::{PollFd, PollFlags, poll};
use std::io;
use std::time::Duration;
use tandem_board::{Channel, NetworkAddress, Recipient};
use tandem_board_udp::{UdpChannel, UdpPlace};
use tandem_topics::Outlet;

/// The longest datagram of UDP.
const LONGEST: usize = 65_507;

/// The sockets of one participant.
#[derive(Debug)]
pub struct Udp {
    channel: UdpChannel,
    bytes: Vec<u8>,
}

impl Udp {
    /// Opens the sockets of the next free participant of a place. Joins the address of discovery
    /// if the interface has multicast.
    ///
    /// # Errors
    /// No port of the domain is free, or the interface does not exist.
    pub fn open(place: UdpPlace) -> io::Result<Self> {
        Ok(Self {
            channel: UdpChannel::open(place, Channel::Topics)?,
            bytes: vec![0; LONGEST],
        })
    }

    /// Returns where it hears.
    pub const fn at(&self) -> NetworkAddress {
        self.channel.address()
    }

    /// Waits for a datagram, at most for this time.
    ///
    /// # Errors
    /// A signal has arrived, or a socket is broken.
    pub fn wait(&self, time: Duration) -> io::Result<()> {
        let sockets = self.channel.sockets();
        let mut sockets = sockets.map(|socket| PollFd::new(socket, PollFlags::IN));
        let time = time.try_into().map_err(io::Error::other)?;
        poll(&mut sockets, Some(&time))?;
        Ok(())
    }

    /// Returns the next datagram; `None` if none has arrived.
    pub fn receive(&mut self) -> Option<Vec<u8>> {
        let heard = self.channel.receive(&mut self.bytes)?;
        Some(self.bytes[..heard.len].to_vec())
    }
}

impl Outlet for Udp {
    fn send(&mut self, to: Recipient, message: &[u8]) {
        // What cannot be sent is lost, as on the wire.
        let _lost = self.channel.send(to, message);
    }
}
