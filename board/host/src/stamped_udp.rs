//! The sockets of a station on a channel, with the times of its datagrams on the board's clock.

use std::io;
use std::net::UdpSocket;
use std::os::fd::{AsFd, AsRawFd as _};
use std::sync::{Mutex, PoisonError};

use tandem_board::{Channel, Datagram, Instant, NetworkAddress, NetworkFull, Recipient};
use tandem_board_udp::{UdpChannel, UdpPlace};

use crate::clock;

/// Reads the time at which the kernel received the datagram that was last read from a socket, and
/// makes the kernel note these times. (Linux: asm-generic/sockios.h)
const SIOCGSTAMPNS: libc::Ioctl = 0x8907;

/// A station on a channel, for the process of core 0 and for those beside a run.
///
/// Both times are the kernel's, translated from its real-time clock, or that of the call if the
/// kernel has noted none. The time of sending is that of the first copy.
#[derive(Debug)]
pub struct StampedUdp {
    udp: UdpChannel,
    /// The time of the newest datagram of each socket.
    received: Mutex<[Instant; 2]>,
}

impl StampedUdp {
    /// Opens the sockets of the next free station of a place.
    ///
    /// # Errors
    /// As [`UdpChannel::open`].
    pub fn open(place: UdpPlace, channel: Channel) -> io::Result<Self> {
        let udp = UdpChannel::open(place, channel)?;
        for socket in udp.sockets() {
            received_at(socket);
        }
        Ok(Self {
            udp,
            received: Mutex::default(),
        })
    }

    /// Returns where this station hears.
    #[must_use]
    pub const fn address(&self) -> NetworkAddress {
        self.udp.address()
    }

    /// Sends a datagram; never blocks. Returns when it left: not after it arrived anywhere.
    ///
    /// # Errors
    /// [`NetworkFull`] if the socket's buffer is full.
    pub fn send(&self, to: Recipient, bytes: &[u8]) -> Result<Instant, NetworkFull> {
        // Before the call: on the loopback interface the datagram has arrived when it returns.
        let called = clock::now();
        let left = self.udp.send_stamped(to, bytes)?;
        let left = left.and_then(|left| Some(on_board_clock(left)?[0]));
        Ok(left.map_or(called, |left| left.max(called)))
    }

    /// Copies the next datagram of another station; `None` if there is none. Never blocks.
    pub fn receive(&self, bytes: &mut [u8]) -> Option<Datagram> {
        let heard = self.udp.receive(bytes)?;
        let noted = received_at(self.udp.sockets()[heard.socket]);
        let now = clock::now();
        let mut received = self.received.lock().unwrap_or_else(PoisonError::into_inner);
        let last = &mut received[heard.socket];
        // The kernel's real-time clock may have been set since.
        *last = noted.unwrap_or(now).max(*last).min(now);
        Some(Datagram {
            len: heard.len,
            from: heard.from,
            at: *last,
        })
    }

    /// Waits for a datagram until this time, or until a signal.
    pub fn wait(&self, until: Instant) {
        let sockets = self.udp.sockets().map(AsFd::as_fd);
        // After an error the caller finds no datagram.
        let _ = clock::wait_for(sockets, until.since(clock::now()));
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
    let at_ns = u64::try_from(at.tv_sec).ok()? * 1_000_000_000 + u64::try_from(at.tv_nsec).ok()?;
    Some(on_board_clock(at_ns)?[1])
}

/// Returns the earliest and the latest time on the board's clock for a moment that has just passed,
/// by the kernel's real-time clock: UTC since 1970, ns.
fn on_board_clock(at_ns: u64) -> Option<[Instant; 2]> {
    let (around, utc_ns) = clock::with_utc()?;
    let age = utc_ns.saturating_sub(at_ns);
    Some(around.map(|now| Instant::from_ns(now.as_ns().saturating_sub(age))))
}
