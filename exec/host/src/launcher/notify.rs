//! The socket on which processes report. The kernel says who has sent a datagram.

use std::io::{self, IoSliceMut};
use std::os::fd::{AsFd, AsRawFd as _, BorrowedFd};
use std::os::linux::net::SocketAddrExt as _;
use std::os::unix::net::{SocketAddr, UnixDatagram};

use nix::sys::socket::{
    ControlMessageOwned, MsgFlags, UnixCredentials, recvmsg, setsockopt, sockopt,
};
use tandem_board::Instant;

use crate::supervisor::ProcessReport;

/// The longest datagram; a longer one is cut.
const LONGEST: usize = 4096;

#[derive(Debug)]
pub(super) struct NotifySocket {
    socket: UnixDatagram,
}

/// What a datagram holds.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Datagram {
    pub(super) reports: Vec<ProcessReport>,
    pub(super) status: Option<String>,
}

impl NotifySocket {
    pub(super) fn open(name: &str) -> io::Result<Self> {
        let address = SocketAddr::from_abstract_name(name.as_bytes())?;
        let socket = UnixDatagram::bind_addr(&address)?;
        socket.set_nonblocking(true)?;
        setsockopt(&socket, sockopt::PassCred, &true)?;
        Ok(Self { socket })
    }

    /// Returns the next datagram and the process that has sent it.
    pub(super) fn receive(&self, now: Instant) -> Option<(u32, Datagram)> {
        let mut bytes = [0; LONGEST];
        let mut parts = [IoSliceMut::new(&mut bytes)];
        let mut space = nix::cmsg_space!(UnixCredentials);
        let fd = self.socket.as_raw_fd();
        let flags = MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_CMSG_CLOEXEC;
        let received = recvmsg::<()>(fd, &mut parts, Some(&mut space), flags).ok()?;
        let sender = received.cmsgs().ok()?.find_map(|message| match message {
            ControlMessageOwned::ScmCredentials(sender) => u32::try_from(sender.pid()).ok(),
            _ => None,
        });
        let length = received.bytes;
        // Without a sender it is from another namespace of processes: from none of ours.
        Some((sender.unwrap_or(0), parse(bytes.get(..length)?, now)))
    }
}

impl AsFd for NotifySocket {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

/// Reads the lines of a datagram. Lines that are unknown or wrong are left out.
fn parse(bytes: &[u8], now: Instant) -> Datagram {
    let mut found = Datagram::default();
    let Ok(text) = std::str::from_utf8(bytes) else {
        return found;
    };
    let field = |name: &str| text.lines().find_map(|line| line.strip_prefix(name));
    let at = field("MONOTONIC_USEC=").and_then(|us| us.parse::<u64>().ok());
    // A time of the future is not believed; the supervisor would wait for it.
    let at = at.map_or(now, |us| {
        Instant::from_ns(us.saturating_mul(1_000)).min(now)
    });
    for line in text.lines() {
        let report = match line.split_once('=') {
            Some(("READY", "1")) => Some(ProcessReport::Ready),
            Some(("WATCHDOG", "1")) => Some(ProcessReport::Alive),
            Some(("STOPPING", "1")) => Some(ProcessReport::Stopping),
            Some(("X_TANDEM_CHECKPOINT", number)) => {
                let number = number.parse().ok();
                number.map(|number| ProcessReport::Checkpoint(number, at))
            }
            Some(("STATUS", status)) => {
                let printable = status.chars().filter(|it| !it.is_control());
                found.status = Some(printable.collect());
                None
            }
            _ => None,
        };
        found.reports.extend(report);
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_a_datagram_are_reports_and_the_rest_is_left_out() {
        let now = Instant::from_ns(9_000_000);
        let text = b"READY=1\nSTATUS=is\x1b fine\nX_TANDEM_CHECKPOINT=7\nMONOTONIC_USEC=5\n\
            WATCHDOG=0\nWATCHDOG=1\nX_TANDEM_CHECKPOINT=x\nfoo";
        let found = parse(text, now);
        let reports = [
            ProcessReport::Ready,
            ProcessReport::Checkpoint(7, Instant::from_ns(5_000)),
            ProcessReport::Alive,
        ];
        assert_eq!(found.reports, reports);
        assert_eq!(found.status.as_deref(), Some("is fine"));
        let future = parse(b"X_TANDEM_CHECKPOINT=7\nMONOTONIC_USEC=99999999", now);
        assert_eq!(future.reports, [ProcessReport::Checkpoint(7, now)]);
        assert_eq!(parse(b"READY=1\n\xff", now), Datagram::default());
    }
}
